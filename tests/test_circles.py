"""No file imports another that imports it, directly or by way of more, inside a function or out of it."""

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from pathlib import Path

import gradscape

ROOT = Path(gradscape.__file__).parent


def modules(root: Path) -> dict[str, Path]:
    """Return every module of a package by its name; links are followed."""
    found = {}
    for folder in [root, *(path for path in root.iterdir() if path.is_dir())]:
        for file in folder.glob("*.py") if folder == root else folder.rglob("*.py"):
            parts = file.relative_to(root).with_suffix("").parts
            found[".".join((root.name, *parts)).removesuffix(".__init__")] = file
    return found


def running(node: ast.AST) -> Iterator[ast.AST]:
    """Walk a tree, functions included, but for what only type checkers see."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            continue
        yield child
        yield from running(child)


def imports(name: str, file: Path, known: set[str]) -> set[str]:
    """Return the modules of the package that one of them imports."""
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    found = set()
    for node in running(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")
            home = ".".join([*parents[: len(parents) - node.level + 1], *filter(None, [node.module])])
            home = home if node.level else str(node.module)
            for alias in node.names:
                inside = f"{home}.{alias.name}"
                found.add(inside if inside in known else home)
    return (found & known) - {name}


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Return the modules of one circle, each before what it imports, the first again at the end; nothing if none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(reversed(error.args[1]))
    return []


def test_no_file_imports_itself_by_way_of_others() -> None:
    files = modules(ROOT)
    assert {"gradscape.envs.engines.mpm.solver", "gradscape.optim.race", "gradscape.cli"} <= set(files)
    graph = {name: imports(name, file, set(files)) for name, file in files.items()}
    assert "gradscape.envs.records" in graph["gradscape.envs.base"]
    assert " -> ".join(circle(graph)) == ""


def test_a_circle_is_found_and_named(tmp_path: Path) -> None:
    package = tmp_path / "pack"
    (package / "inner").mkdir(parents=True)
    for file, text in {
        "__init__.py": "",
        "one.py": "def f():\n    from .inner import two",
        "inner/__init__.py": "",
        "inner/two.py": "from pack.three import x",
        "three.py": "from typing import TYPE_CHECKING\nfrom . import one\nif TYPE_CHECKING:\n    from . import four",
        "four.py": "import pack.three",
    }.items():
        (package / file).write_text(text)
    files = modules(package)
    graph = {name: imports(name, file, set(files)) for name, file in files.items()}
    found = circle(graph)
    assert set(pairwise(found)) == {
        ("pack.three", "pack.one"), ("pack.one", "pack.inner.two"), ("pack.inner.two", "pack.three")
    }  # fmt: skip
    graph["pack.one"].clear()
    assert circle(graph) == []
