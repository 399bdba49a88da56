"""The front door as a whole: light, typed, and the same list wherever it is written."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import gradscape

HEAVY = ("torch", "warp", "taichi", "matplotlib", "xarray", "zarr", "pandas", "rich", "botorch")


def test_importing_it_loads_nothing_heavy() -> None:
    said = subprocess.run(
        [sys.executable, "-c", f"import sys, gradscape; print([one for one in {HEAVY} if one in sys.modules])"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert said.stdout.strip() == "[]"


def test_every_name_is_there_and_says_what_it_is() -> None:
    for name in gradscape.__all__:
        assert getattr(gradscape, name) is not None
        assert name == "__version__" or (getattr(gradscape, name).__doc__ or "").strip(), name


def test_a_type_checker_sees_what_is_imported_when_used() -> None:
    tree = ast.parse(Path(str(gradscape.__file__)).read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        name.asname or name.name: str(node.module)
        for node in block.body
        if isinstance(node, ast.ImportFrom) and node.module
        for name in node.names
    }
    assert seen == gradscape._HOME_OF
    assert sorted(gradscape.__all__) == sorted([*seen, "__version__"])


def test_what_tests_assert_is_a_module_that_is_imported_when_used() -> None:
    program = "import sys, gradscape as gs; print('torch' in sys.modules); print(gs.testing.assert_gradients.__name__)"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["False", "assert_gradients"]
    assert "testing" in dir(gradscape)


def test_an_unknown_name_is_refused_with_those_there_are() -> None:
    with pytest.raises(AttributeError, match=r"has no attribute 'slize'; it has .*slice"):
        _ = gradscape.slize
