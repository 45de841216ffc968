"""Which code an executed notebook depends on: a hash of our modules, comments and docstrings aside.

It decides whether a notebook is executed again, and nothing about results.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import io
import tokenize
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"ipo": ROOT / "ipo", "experiments": ROOT / "notebooks" / "experiments"}


def module_path(name: str) -> Path | None:
    """The file of one of our modules, such as ``ipo.worlds.door``; None for other modules."""
    package, *parts = name.split(".")
    if package not in PACKAGES:
        return None
    path = PACKAGES[package].joinpath(*parts)
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


def imported_modules(source: str) -> set[str]:
    """Names of our modules that a piece of code imports, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {name for name in names if module_path(name)}


def source_hash(modules: Iterable[str]) -> str:
    """Hash of the named modules of ours and of all that they import."""
    pending, seen = set(modules), {}
    while pending:
        name = pending.pop()
        source = module_path(name).read_text(encoding="utf-8")
        seen[name] = _code_only(source)
        pending |= imported_modules(source) - seen.keys()
    text = "\n".join(f"# {name}\n{seen[name]}" for name in sorted(seen))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@functools.cache
def _code_only(source: str) -> str:
    """The source without docstrings, comments, blank lines and trailing spaces.

    Works on the text and not on ``ast.dump``, whose format changes between Python versions.
    """
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None:
            text = node.body[0]
            lines[text.lineno - 1 : text.end_lineno] = [""] * (text.end_lineno - text.lineno + 1)
    return "\n".join(line.rstrip() for line in lines if line.strip())
