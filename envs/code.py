"""Which code an environment's numbers come from, as a digest that changes when they may.

It is taken of the scene's own file and of every file of this folder that it imports, directly or not, without their
comments, docstrings and import lines. Other scenes, the other engine, and what no loss depends on do not count: a file
that says `COMPUTES_LOSSES = False`, and the hooks by which scenes are drawn and described. Nor do settings count that a
record holds beside the digest: fidelities, and by which options parts of the model are left out.

Code that was measured to compute the same numbers as older code, to the last bit, has the digest of that:
`python -m benchmarks.same_numbers` writes `same_numbers.json`.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

from ..landscapes.code import bare, file_of
from .engines import find_engine

COMPUTES_LOSSES = False  # of this file too

HERE = Path(__file__).resolve().parent
SAME_NUMBERS = HERE / "same_numbers.json"
# Hooks of a scene that no loss depends on.
DESCRIBING = frozenset({"about", "episode", "events", "memory", "work", "_energy", "_observe"})
COMPILING = frozenset({"_compile_ahead"})  # earlier than it would be, and the same
DRAWING = frozenset({"_parts", "_surroundings", "_body_names", "_view", "_watch", "_length_scale"})
SETTINGS = frozenset({"fidelities", "model_parts"})  # records say which they are of
NO_LOSS = DESCRIBING | DRAWING | COMPILING | SETTINGS


@cache
def code_digest(kind: type, engine: str = "warp") -> str:
    """Return a digest of the code that the numbers of an environment's class come from, on an engine.

    It is that of the oldest code that computes the same numbers, as far as that was measured.
    """
    own = own_digest(kind, engine)
    return _numbers_of().get((getattr(kind, "name", ""), own), own)


@cache
def _numbers_of() -> dict[tuple[str, str], str]:
    """Return digests of older code by scene and the digest of code that computes the same numbers of it."""
    kept = json.loads(SAME_NUMBERS.read_text())
    return {(scene, one["code"]): str(one["numbers_of"]) for scene, one in kept.items()}


@cache
def own_digest(kind: type, engine: str = "warp") -> str:
    """Return a digest of the code itself, whatever older code computed the same numbers."""
    family = kind.own_classes() if hasattr(kind, "own_classes") else (kind,)
    own = dict.fromkeys(file for one in family if (file := file_of(one)))
    ours = [file for file in own if file.is_relative_to(HERE)]
    others = [file for file in own if not file.is_relative_to(HERE)]
    texts = [bare(file, NO_LOSS) for file in (*find_files(ours, HERE, engine), *others)] or [repr(family)]
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:12]


def find_files(start: Iterable[Path], folder: Path, engine: str) -> list[Path]:
    """Return the files of a folder that some of its files compute with: themselves, and what they import."""
    found: set[Path] = set()
    left = list(start)
    while left:
        file = left.pop()
        if file not in found and computes_losses(file):
            found.add(file)
            left += find_imports(file, folder, engine)
    return sorted(found)


@cache
def computes_losses(file: Path) -> bool:
    """Say whether losses depend on a file: they do unless it says `COMPUTES_LOSSES = False`."""
    return not any(
        isinstance(node, ast.Assign)
        and any(isinstance(target, ast.Name) and target.id == "COMPUTES_LOSSES" for target in node.targets)
        and isinstance(node.value, ast.Constant)
        and node.value.value is False
        for node in ast.parse(file.read_text()).body
    )


@cache
def find_imports(file: Path, folder: Path, engine: str) -> tuple[Path, ...]:
    """Return the files of a folder that one of them imports while it runs."""
    found = []
    for node in _walk_running(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            package = [file, *file.parents][node.level]
            home = package.joinpath(*node.module.split(".")) if node.module else package
            places = [home, *(home / name.name for name in node.names)]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "_engine":
            kind = str(getattr(node.args[0], "value", ""))
            solvers = find_engine(engine).solvers
            places = [folder.joinpath("engines", *solvers[kind].split("."))] if kind in solvers else []
        else:
            continue
        for place in places:
            for one in (place.with_suffix(".py"), place / "__init__.py"):
                if one.is_file() and one.is_relative_to(folder):
                    found.append(one)
    return tuple(found)


def _walk_running(node: ast.AST) -> Iterator[ast.AST]:
    """Walk a tree, but for what only type checkers see."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and isinstance(child.test, ast.Name) and child.test.id == "TYPE_CHECKING":
            continue
        yield child
        yield from _walk_running(child)
