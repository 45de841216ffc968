"""Checks of what a caller hands in: every error names the parameter, its value and the rule.

A rule stands where a parameter is declared: a type, one of the types of this file, or a shape. ::

    @checked
    def simulate(K: Annotated[Tensor, "R n_u n_o"], problem: LQR, num_steps: Natural) -> Tensor:

What is ``checked`` applies the rules of its signature before it does anything; a dataclass, those
of its fields. In a call a letter of a shape means the same size everywhere; the attribute ``sizes``
of an object gives letters, too. What every step of a training calls is not checked: its arrays come
from what was.

Libraries for this were tried: pydantic refuses NumPy's whole numbers and does not see shapes,
beartype with jaxtyping takes True for a number and refuses 1 for 1.0, and neither sees NaN in a
tensor or one seed named twice.
"""

from __future__ import annotations

import difflib
import functools
import inspect
import math
import operator
import reprlib
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from numbers import Integral, Real
from typing import Annotated, Any, TypeVar

import numpy as np

Function = TypeVar("Function", bound=Callable[..., Any])


def check_count(
    name: str, value: object, minimum: int | None = 1, maximum: int | None = None
) -> None:
    """A whole number within the bounds, which may be None; raises TypeError or ValueError."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{name} = {value!r}: must be a whole number, not {type(value).__name__}")
    check_number(name, value, least=minimum, most=maximum)


def check_number(
    name: str,
    value: object,
    *,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
) -> None:
    """A finite real number, within the bounds that are given."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} = {value!r}: must be a number, not {type(value).__name__}")
    if not math.isfinite(value):
        raise ValueError(f"{name} = {value!r}: must be finite")
    for bound, holds, rule in (
        (above, operator.gt, "greater than"),
        (least, operator.ge, "at least"),
        (below, operator.lt, "less than"),
        (most, operator.le, "at most"),
    ):
        if bound is not None and not holds(value, bound):
            raise ValueError(f"{name} = {value!r}: must be {rule} {bound}")


def check_choice(name: str, value: object, choices: Iterable[str]) -> None:
    """One of ``choices``; the error suggests the nearest."""
    choices = list(choices)
    if not isinstance(value, str) or value not in choices:
        nearest = difflib.get_close_matches(str(value), choices, n=1)
        hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
        raise ValueError(f"{name} = {value!r}: must be one of {', '.join(choices)}{hint}")


def check_choices(name: str, values: object, choices: Sequence[str]) -> None:
    """A list of some of ``choices``, each once."""
    rule = partial(check_choice, choices=choices)
    _check_list(name, values, f"some of {', '.join(choices)}", rule)


def check_counts(name: str, values: object, minimum: int = 1, maximum: int | None = None) -> None:
    """A list of different whole numbers within the bounds, not empty."""
    rule = partial(check_count, minimum=minimum, maximum=maximum)
    _check_list(name, values, "whole numbers", rule)


def check_numbers(name: str, values: object, length: int = 1, **bounds: float) -> None:
    """A list of at least so many different finite numbers within the bounds."""
    _check_list(
        name, values, "numbers", lambda name, value: check_number(name, value, **bounds), length
    )


def _check_list(
    name: str, values: object, of: str, rule: Callable[[str, object], None], length: int = 1
) -> None:
    """A list of at least so many different values that fit the rule."""
    if isinstance(values, str | bytes) or not isinstance(values, Sequence):
        raise TypeError(f"{name} = {values!r}: must be a list of {of}")
    if len(values) < length:
        raise ValueError(f"{name} = {values!r}: must be at least {length} long")
    for index, value in enumerate(values):
        rule(f"{name}[{index}]", value)
    if len(set(values)) < len(values):
        raise ValueError(f"{name} = {values!r}: must not name a value twice")


def check_checkpoints(checkpoints: Iterable[int], end: int) -> None:
    """None after the end."""
    for index, checkpoint in enumerate(checkpoints):
        check_count(f"checkpoints[{index}]", checkpoint, minimum=0, maximum=end)


Count = Annotated[int, check_count]
Natural = Annotated[int, partial(check_count, minimum=0)]
Finite = Annotated[float, check_number]
Positive = Annotated[float, partial(check_number, above=0)]
NonNegative = Annotated[float, partial(check_number, least=0)]
Probability = Annotated[float, partial(check_number, least=0, most=1)]
Seed = Annotated[int, partial(check_count, minimum=0, maximum=2**32 - 1)]  # as NumPy's oldest
Seeds = Annotated[Sequence[int], partial(check_counts, minimum=0, maximum=2**32 - 1)]


def one_of(choices: Iterable[str]) -> Callable[[str, object], None]:
    """The rule of a parameter ``Annotated[str, one_of(choices)]``."""
    return partial(check_choice, choices=choices)


def checked(function: Function) -> Function:
    """The same function, or dataclass, which first applies the rules of its signature."""
    if isinstance(function, type):
        function.__init__ = _with_rules(function.__init__, function)  # type: ignore[misc]
        return function
    return _with_rules(function, function)


def _with_rules(function: Function, declared_by: Callable[..., Any]) -> Function:
    signature = inspect.getfullargspec(function)

    @functools.wraps(function)
    def entry(*arguments: Any, **named: Any) -> Any:
        rules = _rules(declared_by)
        by_place = zip(signature.args, arguments, strict=False)
        others = rules.get(signature.varkw or "", Any)
        _check_all(
            [(name, value, rules.get(name, Any)) for name, value in by_place]
            + [(name, value, rules.get(name, others)) for name, value in named.items()]
        )
        return function(*arguments, **named)

    return typing.cast(Function, entry)


def check_array(name: str, value: Any, shape: str, sizes: dict[str, Any]) -> None:
    """Finite real numbers of a shape such as ``"R n_x 2"``; ``...`` are any axes, at one end.

    ``sizes`` says how long the axes are that have a letter, and learns the new ones. Of a list
    the length counts. All tensors must have the same type of floating point numbers.
    """
    own = tuple(value.shape) if hasattr(value, "shape") else (len(value),)
    axes = shape.replace("...", "").split()
    if shape.startswith("..."):
        seen = own[max(len(own) - len(axes), 0) :]
    else:
        seen = own[: len(axes)] if shape.endswith("...") else own
    known = {axis: int(axis) for axis in axes if axis.isdigit()} | sizes
    wanted = ", ".join(str(known.get(axis, axis)) for axis in axes)
    fits = [known.setdefault(axis, n) == n for axis, n in zip(axes, seen, strict=False)]
    if len(seen) != len(axes) or not all(fits):
        raise ValueError(f"{name}: has shape {own}, must have [{shape}] = [{wanted}]")
    if 0 in own:
        raise ValueError(f"{name}: has shape {own}, must not be empty")
    sizes |= known
    if hasattr(value, "dtype"):
        _check_numbers(name, value, sizes)


def _check_numbers(name: str, value: Any, sizes: dict[str, Any]) -> None:
    array = isinstance(value, np.ndarray)
    if not (value.dtype.kind in "fiub" if array else value.dtype.is_floating_point):
        raise TypeError(f"{name}: holds {value.dtype}, must hold real numbers")
    if not bool((np.isfinite(value) if array else value.isfinite()).all()):
        raise ValueError(f"{name}: holds NaN or infinite values, must be finite")
    if array or value.dim() == 0:  # a number takes the type of what it meets
        return
    if sizes.setdefault("dtype", value.dtype) != value.dtype:
        raise TypeError(f"{name}: holds {value.dtype}, must hold {sizes['dtype']} as the others")


# What a type means as a rule; of other classes a value must be an instance.
SIMPLE: dict[Any, tuple[str, Callable[[Any], bool]]] = {
    bool: ("True or False", lambda value: isinstance(value, bool | np.bool_)),
    Callable: ("a function", callable),
    type: ("a class", lambda value: isinstance(value, type)),
    Sequence: ("a list", lambda value: isinstance(value, Sequence) and not isinstance(value, str)),
}
NUMBERS: dict[Any, Callable[..., None]] = {
    int: partial(check_count, minimum=None),
    float: check_number,
}


@functools.cache
def _rules(function: Callable[..., Any]) -> dict[str, Any]:
    """Of the parameters; what is returned may have a type that is not imported."""
    if isinstance(function, type):  # each field by the names of the module that declares it
        return typing.get_type_hints(function, include_extras=True)
    own = {name: rule for name, rule in function.__annotations__.items() if name != "return"}
    declared = types.SimpleNamespace(__annotations__=own)
    return typing.get_type_hints(declared, function.__globals__, include_extras=True)


def _check_all(given: Iterable[tuple[str, object, Any]]) -> None:
    """Check ``(name, value, rule)`` of one call; what gives sizes comes first."""
    sizes: dict[str, Any] = {}
    for name, value, rule in sorted(given, key=lambda one: not hasattr(type(one[1]), "sizes")):
        _check(name, value, rule, sizes)
        sizes |= getattr(value, "sizes", {})


def _check(name: str, value: Any, rule: Any, sizes: dict[str, Any]) -> None:
    """Whether a value is what its annotation says."""
    kind: Any = typing.get_origin(rule) or rule
    parts: tuple[Any, ...] = typing.get_args(rule)
    if kind is Annotated:
        if isinstance(parts[1], str):
            _check(name, value, parts[0], sizes)
        for condition in parts[1:]:
            if isinstance(condition, str):
                check_array(name, value, condition, sizes)
            else:
                condition(name, value)
    elif kind in (typing.Union, types.UnionType):
        _check_one_of(name, value, parts, sizes)
    elif kind in NUMBERS:
        NUMBERS[kind](name, value)
    else:
        _check_kind(name, value, kind)
        if kind in (Sequence, list, tuple) and parts:
            for index, one in enumerate(value):
                _check(f"{name}[{index}]", one, parts[0], sizes)
        elif kind in (Mapping, dict) and parts:
            for key, one in value.items():
                _check(f"{name}[{key!r}]", one, parts[1], sizes)


def _check_kind(name: str, value: object, kind: Any) -> None:
    if kind is Any:
        return
    what, holds = SIMPLE.get(kind, (f"of type {kind.__name__}", lambda one: isinstance(one, kind)))
    if not holds(value):
        found = f"{name} = {reprlib.repr(value)}"
        raise TypeError(f"{found}: must be {what}, not {type(value).__name__}")


def _check_one_of(name: str, value: object, rules: Sequence[Any], sizes: dict[str, Any]) -> None:
    """The first rule that fits counts; if none does, the one of the value's own type says why."""
    if value is None and type(None) in rules:
        return
    errors: list[Exception] = []
    for rule in rules:
        if rule is type(None):
            continue
        try:
            return _check(name, value, rule, sizes)
        except (TypeError, ValueError) as error:
            errors.append(error)
    raise min(errors, key=lambda error: isinstance(error, TypeError))
