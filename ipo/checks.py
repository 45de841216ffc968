"""Checks of what a caller hands in: every error names the parameter, its value and the rule."""

from __future__ import annotations

import ast
import difflib
import itertools
import math
import operator
from collections.abc import Iterable, Sequence
from numbers import Integral, Real


def check_count(name: str, value: object, minimum: int = 1) -> None:
    """A whole number of at least ``minimum``; raises TypeError or ValueError."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{name} = {value!r}: must be a whole number, not {type(value).__name__}")
    if value < minimum:
        raise ValueError(f"{name} = {value!r}: must be at least {minimum}")


def check_number(
    name: str,
    value: object,
    *,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
) -> None:
    """A real number that is not NaN, within the bounds that are given."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} = {value!r}: must be a number, not {type(value).__name__}")
    if math.isnan(value):
        raise ValueError(f"{name} = {value!r}: must not be NaN")
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
    if value not in choices:
        nearest = difflib.get_close_matches(str(value), choices, n=1)
        hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
        raise ValueError(f"{name} = {value!r}: must be one of {', '.join(choices)}{hint}")


def check_counts(name: str, values: object, minimum: int = 1) -> None:
    """A list of different whole numbers, not empty, each of at least ``minimum``."""
    if isinstance(values, str | bytes) or not isinstance(values, Sequence):
        raise TypeError(f"{name} = {values!r}: must be a list of whole numbers")
    if not values:
        raise ValueError(f"{name} = {values!r}: must not be empty")
    for index, value in enumerate(values):
        check_count(f"{name}[{index}]", value, minimum)
    if len(set(values)) < len(values):
        raise ValueError(f"{name} = {values!r}: must not name a value twice")


def check_notebook_parameters(executed: Sequence[str]) -> None:
    """Refuse a misspelt parameter of a notebook that papermill runs.

    ``executed`` is IPython's ``In``: the sources of the cells run so far. Papermill puts the
    values it was given in a cell of their own, which starts with ``# Parameters``, right
    after the cell with the defaults, and only warns of a name that the defaults do not have.
    """
    cells = [cell for cell in executed if cell.strip()]
    for defaults, injected in itertools.pairwise(cells):
        if injected.startswith("# Parameters\n"):
            known = _assigned_names(defaults)
            for name, value in _assigned_names(injected).items():
                if name not in known:
                    nearest = difflib.get_close_matches(name, known, n=1)
                    hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
                    raise ValueError(
                        f"{name} = {value}: this notebook has no such parameter; "
                        f"it has {', '.join(known)}{hint}"
                    )


def _assigned_names(source: str) -> dict[str, str]:
    """Names that a cell assigns, with the text of their values."""
    return {
        node.targets[0].id: ast.unparse(node.value)
        for node in ast.parse(source).body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
