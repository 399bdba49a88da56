"""Import what an environment's class is in: a module by its name, or somebody's file by its path."""

from __future__ import annotations

import ast
import hashlib
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.util import decode_source, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

IN_FILE = re.compile(r".+\.py:\w+", re.DOTALL)  # FILE.py:NAME
BINDS_UNSEEN = re.compile(r"import\s*\(?\s*\*|\b(globals|locals|vars|setattr|exec|eval|__dict__|modules)\b")


def import_named(name: str) -> ModuleType:
    """Import a module by its name, or a file by its path, once; what a file raises is said with its name.

    A file finds modules beside it, as a program does. Raises ImportError for a module and ValueError for a file.
    """
    if not name.endswith(".py"):
        return import_module(name)
    known = f"gradscape_file_{hashlib.sha256(name.encode()).hexdigest()[:12]}"
    if known not in sys.modules:
        try:
            sys.modules[known] = _load_file(known, name)
        except SystemExit as error:
            raise ValueError(
                f"{name} called sys.exit({'' if error.code is None else repr(error.code)}) while it was imported; let "
                'it do that as a program only, under `if __name__ == "__main__":`'
            ) from error
        except Exception as error:
            raise ValueError(f"{name} cannot be imported: {type(error).__name__}: {error}") from error
    return sys.modules[known]


def _load_file(known: str, path: str) -> ModuleType:
    spec = spec_from_file_location(known, path)
    assert spec is not None  # of a path that ends in .py there is one,
    assert spec.loader is not None  # which is loaded
    module = module_from_spec(spec)
    if (beside := str(Path(path).parent)) not in sys.path:
        sys.path.append(beside)
    sys.modules[known] = module  # dataclasses look there for their own module
    try:
        spec.loader.exec_module(module)
    finally:
        del sys.modules[known]
    return module


def refuse_absent_name(file: Path, name: str, path: str) -> None:
    """Raise ValueError where a file has no such name in it, with those it defines; `path` is what it was called.

    The file is read, not run. A file that may bind names which it does not spell is left to whoever imports it.
    """
    try:
        text = decode_source(file.read_bytes())
        there = [one for one in _defined(ast.parse(text)) if not one.startswith("_")]
    except (SyntaxError, ValueError):
        return  # which the import says better
    if BINDS_UNSEEN.search(text) or re.search(rf"\b{name}\b", text):
        return
    raise ValueError(f"{path} holds no {name}; it has {', '.join(there) or 'no name at all'}")


def _defined(module: ast.Module) -> Iterator[str]:
    """Yield what a module calls its classes, functions and values, one after the other."""
    for statement in module.body:
        if isinstance(statement, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield statement.name
        elif isinstance(statement, ast.Assign | ast.AnnAssign):
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            yield from (node.id for one in targets for node in ast.walk(one) if isinstance(node, ast.Name))
