"""The code of a file without what no number depends on, for digests that change only when numbers may."""

from __future__ import annotations

import ast
import inspect
import io
import tokenize
from collections.abc import Collection, Iterator
from functools import cache
from pathlib import Path
from types import ModuleType


@cache
def bare(file: Path, skipped: Collection[str] = frozenset()) -> str:
    """Return the code of a file line by line, without comments, docstrings, imports and what is `skipped`.

    `skipped` are names of functions, and of what is assigned; they must be hashable together, as a frozenset is.
    """
    text = file.read_text()
    lines = text.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(text)):
        for silent in _silent(node, skipped):
            lines[silent.lineno - 1 : silent.end_lineno] = [""] * ((silent.end_lineno or 0) - silent.lineno + 1)
    return "\n".join(line.rstrip() for line in lines if line.strip())


def _silent(node: ast.AST, skipped: Collection[str]) -> Iterator[ast.stmt]:
    """Yield what no number depends on in a node of a file: imports, docstrings, functions and names skipped."""
    if isinstance(node, ast.Import | ast.ImportFrom) or (isinstance(node, ast.FunctionDef) and node.name in skipped):
        yield node
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id in skipped:
        yield node
    if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
        yield node.body[0]


def file_of(owner: type | ModuleType) -> Path | None:
    """Return the file that a class or a module is written in, None for one of a notebook."""
    try:
        return Path(inspect.getfile(owner)).resolve()
    except (OSError, TypeError):
        return None
