"""Which code an environment's numbers come from, as a digest that changes when they may.

It is taken of the scene's own file and of every file of this folder that it imports, directly or not, without their
comments, docstrings and import lines. Other scenes, the other engine, and what no loss depends on do not count.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import io
import tokenize
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .base import Environment

HERE = Path(__file__).resolve().parent
# What scenes import that computes no loss: the contract, their list, devices and threads, what is observed and drawn.
NO_LOSS = frozenset({"about", "episode", "events", "memory", "work", "_energy", "_observe"})  # hooks of a scene
NO_NUMBERS = (
    *("base.py", "code.py", "registry.py", "engines/runtime.py"),
    *("observation.py", "outlines.py", "plasticine_look.py"),
)


@cache
def code_digest(kind: type[Environment], engine: str = "warp") -> str:
    """Return a digest of the code that the numbers of an environment's class come from, on an engine."""
    from .base import Environment

    family = kind.__mro__[: kind.__mro__.index(Environment)] if issubclass(kind, Environment) else (kind,)
    own = dict.fromkeys(file for one in family if (file := _file(one)))
    ours = [file for file in own if file.is_relative_to(HERE)]
    others = [file for file in own if not file.is_relative_to(HERE)]
    texts = [*map(bare, reached(ours, HERE, engine)), *map(bare, others)] or [repr(family)]
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:12]


def reached(start: Iterable[Path], folder: Path, engine: str) -> list[Path]:
    """Return the files of a folder that some of its files import, directly or not, themselves included."""
    found: set[Path] = set()
    left = list(start)
    while left:
        file = left.pop()
        if file not in found and file.relative_to(folder).as_posix() not in NO_NUMBERS:
            found.add(file)
            left += imported(file, folder, engine)
    return sorted(found)


@cache
def bare(file: Path) -> str:
    """Return the code of a file that a loss may depend on, line by line, without comments and docstrings."""
    text = file.read_text()
    lines = text.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(text)):
        for silent in _silent(node):
            lines[silent.lineno - 1 : silent.end_lineno] = [""] * ((silent.end_lineno or 0) - silent.lineno + 1)
    return "\n".join(line.rstrip() for line in lines if line.strip())


def _silent(node: ast.AST) -> Iterator[ast.stmt]:
    """Yield what no loss depends on in a node of a file: imports, docstrings, hooks that compute none."""
    if isinstance(node, ast.Import | ast.ImportFrom) or (isinstance(node, ast.FunctionDef) and node.name in NO_LOSS):
        yield node
    if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
        yield node.body[0]


def _file(kind: type) -> Path | None:
    """Return the file a class is written in, None for one of a notebook."""
    try:
        return Path(inspect.getfile(kind)).resolve()
    except (OSError, TypeError):
        return None


@cache
def imported(file: Path, folder: Path, engine: str) -> tuple[Path, ...]:
    """Return the files of a folder that one of them imports while it runs."""
    found = []
    for node in _running(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            package = [file, *file.parents][node.level]
            home = package.joinpath(*node.module.split(".")) if node.module else package
            places = [home, *(home / name.name for name in node.names)]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "_engine":
            kind = str(getattr(node.args[0], "value", ""))
            places = [folder / "engines" / (kind if engine == "warp" else f"{engine}_{kind}")]
        else:
            continue
        for place in places:
            for one in (place.with_suffix(".py"), place / "__init__.py"):
                if one.is_file() and one.is_relative_to(folder):
                    found.append(one)
    return tuple(found)


def _running(node: ast.AST) -> Iterator[ast.AST]:
    """Walk a tree, but for what only type checkers see."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and isinstance(child.test, ast.Name) and child.test.id == "TYPE_CHECKING":
            continue
        yield child
        yield from _running(child)
