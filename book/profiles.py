"""Which notebooks a build executes, and with which parameters: all checked before any work."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import papermill
import yaml

from chapters import Notebook
from messages import BuildError, listed

NOTHING = type(None)
# What a profile may give in the place of a notebook's value of a type.
ALLOWED = {bool: {bool}, int: {int}, float: {int, float}, str: {str, NOTHING}, list: {list}}


def load_notebooks(root: Path, profile: str, folder: Path) -> list[Notebook]:
    """The notebooks of the table of contents with the parameters of a profile, all checked."""
    toc = read_yaml(root, "_toc.yml")
    names = [name for name in toc_entries(toc) if (root / f"notebooks/{name}.ipynb").exists()]
    parameters = load_profile(root, profile)
    if unknown := parameters.keys() - set(names):
        raise BuildError(
            f"notebooks/profiles/{profile}.yml names {listed(unknown)}, "
            f"but the notebooks in _toc.yml are {listed(names)}"
        )
    notebooks = [Notebook(name, root, parameters.get(name, {}), folder) for name in names]
    for notebook in notebooks:
        check_parameters(notebook, f"notebooks/profiles/{profile}.yml gives {notebook.name}")
    return notebooks


def read_yaml(root: Path, name: str) -> Any:
    """A file of the project."""
    try:
        return yaml.safe_load((root / name).read_bytes())
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        raise BuildError(f"{name}{line}: is no YAML: {error}") from error


def toc_entries(toc: object) -> Iterator[str]:
    """The pages that a table of contents names, at any depth."""
    if isinstance(toc, dict):
        for key, value in toc.items():
            if key in ("root", "file"):
                yield value
            else:
                yield from toc_entries(value)
    elif isinstance(toc, list):
        for item in toc:
            yield from toc_entries(item)


def load_profile(root: Path, profile: str) -> dict:
    """Notebook name -> parameters, from notebooks/profiles/<profile>.yml."""
    known = {path.stem for path in (root / "notebooks" / "profiles").glob("*.yml")}
    if profile not in known:
        raise BuildError(f"There is no profile {profile!r}; the profiles are {listed(known)}")
    name = f"notebooks/profiles/{profile}.yml"
    parameters = read_yaml(root, name) or {}
    mappings = [parameters, *parameters.values()] if isinstance(parameters, dict) else [parameters]
    if not all(isinstance(mapping, dict) for mapping in mappings):
        raise BuildError(f"{name} must map notebooks to parameters, as `lqr: {{num_runs: 3}}`")
    return parameters


def check_parameters(notebook: Notebook, gives: str) -> None:
    """Papermill passes on whatever it is given, and only warns of an unknown parameter."""
    known = papermill.inspect_notebook(str(notebook.source))
    if unknown := notebook.parameters.keys() - known.keys():
        raise BuildError(
            f"{gives} the parameter {listed(unknown)}, "
            f"but its `parameters` cell has {listed(known)}"
        )
    for name, value in notebook.parameters.items():
        default = known[name]["default"]
        kind = type_of(default)
        if type(value) not in ALLOWED.get(kind, {type(value)}):
            raise BuildError(
                f"{gives} {name} = {value!r}: must be of type {kind.__name__}, as {default} is"
            )


def type_of(expression: str) -> type | None:
    """Of the value of a literal; None for other expressions."""
    match ast.parse(expression, mode="eval").body:
        case ast.Constant(value=value):
            return type(value)
        case ast.List():
            return list
    return None
