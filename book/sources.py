"""Which code a result depends on: a hash of ``ipo`` modules, comments and docstrings aside."""

from __future__ import annotations

import ast
import hashlib
import io
import tokenize
from collections.abc import Iterable
from pathlib import Path

PACKAGE = Path(__file__).parent


def imported_modules(source: str) -> set[str]:
    """Names of the ``ipo`` modules that a piece of code imports directly, such as ``"lqr"``."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {a.name.split(".")[1] for a in node.names if a.name.startswith("ipo.")}
        elif isinstance(node, ast.ImportFrom) and node.module == "ipo":
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ipo."):
            names.add(node.module.split(".")[1])
    return {name for name in names if (PACKAGE / f"{name}.py").exists()}


def source_hash(modules: Iterable[str]) -> str:
    """Hash of the named ``ipo`` modules and of every ``ipo`` module that they import.

    Comments, docstrings and blank lines do not count, so that a result does not become
    stale because its code was explained better.
    """
    pending, seen = set(modules), {}
    while pending:
        name = pending.pop()
        source = (PACKAGE / f"{name}.py").read_text(encoding="utf-8")
        seen[name] = _code_only(source)
        pending |= imported_modules(source) - seen.keys()
    text = "\n".join(f"# {name}\n{seen[name]}" for name in sorted(seen))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


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
