"""The parameters that papermill hands to a notebook, for those of the book and your own."""

from __future__ import annotations

import ast
import difflib
import itertools
from collections.abc import Sequence


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
