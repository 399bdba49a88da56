"""The house: what stands where, how long functions get, what public ones say they raise, and what tests mirror."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("api", "commands", "envs", "gallery", "jobs", "landscapes", "optim", "studies")
SOURCES = sorted([ROOT / "cli.py", *(file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py"))])
LONGEST = 40  # lines of a function, but for its signature, its docstring and functions within it
Function = ast.FunctionDef | ast.AsyncFunctionDef


def test_no_function_is_longer_than_one_reads_at_once() -> None:
    long = {
        f"{file.relative_to(ROOT)} {node.name}": length
        for file in SOURCES
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, Function) and (length := _lines(node)) > LONGEST
    }
    # One step of a flight with all that it may meet: a Warp function, whose parts would be as many arguments.
    assert long.keys() == {"envs/engines/balls/impacts.py move"}


@pytest.mark.parametrize("folder", [*FOLDERS, "cli.py"])
def test_public_functions_that_raise_say_so(folder: str) -> None:
    """Those of commands/ are the verbs, whose docstrings are their help."""
    silent = [
        f"{file.relative_to(ROOT)}:{node.lineno} {node.name}"
        for file in SOURCES
        if file.relative_to(ROOT).parts[0] == folder != "commands"
        for node in _public_functions(ast.parse(file.read_text()))
        if _raises(node) and "aise" not in (ast.get_docstring(node) or "") and "efuse" not in _docstring(node)
    ]
    assert silent == []


def _lines(node: Function) -> int:
    """Return how many lines the statements of a function take, without those of functions within it."""
    body = node.body[ast.get_docstring(node) is not None :]
    within = [one for one in _children(node) if isinstance(one, Function)]
    inner = sum((one.end_lineno or 0) - one.lineno + 1 + len(one.decorator_list) for one in within)
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 - inner if body else 0


def _children(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes within a node, functions included but not what is within these."""
    for child in ast.iter_child_nodes(node):
        yield child
        if not isinstance(child, Function):
            yield from _children(child)


def _docstring(node: Function) -> str:
    return ast.get_docstring(node) or ""


def _public_functions(tree: ast.Module) -> Iterator[Function]:
    """Yield the functions of a module, and the methods of its public classes, that have no underscore."""
    for node in tree.body:
        if isinstance(node, Function) and not node.name.startswith("_"):
            yield node
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from (one for one in node.body if isinstance(one, Function) and not one.name.startswith("_"))


def _raises(node: Function) -> bool:
    """Whether an error is raised in a function itself; one that is raised again is not its own."""
    return any(isinstance(one, ast.Raise) and one.exc is not None for one in _own(node))


def _own(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, Function | ast.Lambda):
            yield child
            yield from _own(child)
