"""Import what an environment's class is in: a module by its name, or somebody's file by its path."""

from __future__ import annotations

import hashlib
import re
import sys
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

IN_FILE = re.compile(r".+\.py:\w+", re.DOTALL)  # FILE.py:Class


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
