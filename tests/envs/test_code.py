"""The digest of a scene's code: what changes it, and what does not."""

import importlib
import shutil
from pathlib import Path

import pytest

from gradscape.envs import code
from gradscape.envs.base import Environment
from gradscape.envs.code import bare, code_digest, imported, reached
from gradscape.envs.registry import BUILTIN, environment_class, make

SCENES = [entry.name for entry in BUILTIN]
ARM = """
from gradscape.envs.base import Environment

class Arm(Environment):
    \"\"\"An arm.\"\"\"
    # of ours
    def _evaluate(self, x, *, grad):
        return 2 * x  # twice
"""


def arm(folder: Path, text: str) -> type[Environment]:
    """Import the arm anew from a changed file."""
    (folder / "gradscape_code_arm.py").write_text(text)
    bare.cache_clear()
    importlib.invalidate_caches()
    found: type[Environment] = importlib.reload(importlib.import_module("gradscape_code_arm")).Arm
    return found


def test_a_foreign_class_has_the_digest_of_its_code_and_not_of_its_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("sys.dont_write_bytecode", True)
    first = code_digest(arm(tmp_path, ARM))
    assert (
        code_digest(arm(tmp_path, ARM.replace("An arm.", "A leg.").replace("of ours", "").replace("twice", "2")))
        == first
    )
    assert code_digest(arm(tmp_path, ARM.replace("2 * x", "3 * x"))) != first


def test_a_class_of_a_notebook_has_a_digest() -> None:
    made = type("Made", (Environment,), {"__module__": "__main__"})
    assert len(code_digest(made)) == 12


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Copy the environments, for a test to change."""
    shutil.copytree(code.HERE, tmp_path / "envs", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "envs"


def files_of(name: str, engine: str = "warp", folder: Path = code.HERE) -> set[str]:
    home = environment_class(name).__module__.removeprefix("gradscape.envs.").replace(".", "/") + ".py"
    return {str(file.relative_to(folder)) for file in reached([folder / home], folder, engine)}


def test_a_scene_has_the_files_that_it_computes_with_and_no_other_scene_s() -> None:
    assert {"fluid.py", "engines/mpm.py", "engines/transfers.py", "engines/materials/fluid.py"} <= files_of("fluid")
    assert files_of("bounce") == {"bounce.py", "engines/rigid.py", "options.py"}
    scenes = {name: files_of(name) for name in SCENES}
    homes = {name: environment_class(name).__module__.rpartition(".")[2] + ".py" for name in SCENES}
    for name, files in scenes.items():
        assert homes[name] in files
        shared = {home for home in homes.values() if home in files}
        assert shared <= {homes[name], "plasticine.py"}
    every = {str(file.relative_to(code.HERE)) for file in code.HERE.rglob("*.py") if "taichi" not in file.name}
    counted = set().union(*scenes.values())
    left = {name for name in every - counted if not name.endswith("__init__.py")}
    assert left == {*code.NO_NUMBERS, "bench.py", "importing.py", "points.py"}


def test_another_engine_is_other_code() -> None:
    assert "engines/taichi_mpm.py" not in files_of("fluid")
    assert files_of("fluid", "taichi") >= {"engines/taichi_mpm.py", "fluid.py"}
    kind = environment_class("fluid")
    assert code_digest(kind) != code_digest(kind, "taichi")
    assert make("bounce", device="cpu").identity()["code"] == code_digest(environment_class("bounce"))


@pytest.mark.parametrize(
    ("file", "added", "changes"),
    [
        ("engines/rigid.py", "G = 9.8", {"bounce"}),
        ("engines/rigid.py", "\n# a remark\n", set()),
        ("engines/rigid.py", "import math", set()),
        ("bounce.py", "def episode(): ...", set()),
        ("base.py", "G = 9.8", set()),
        ("lattice.py", "G = 9.8", {"swing-velocity", "swing-stiffness", "flip"}),
    ],
)
def test_a_change_is_told_to_the_scenes_it_may_matter_to(copy: Path, file: str, added: str, changes: set[str]) -> None:
    def texts(name: str) -> list[str]:
        return [bare(copy / one) for one in sorted(files_of(name, folder=copy))]

    before = {name: texts(name) for name in SCENES}
    (copy / file).write_text((copy / file).read_text() + added)
    for remembered in (bare, imported):
        remembered.cache_clear()
    assert {name for name in SCENES if texts(name) != before[name]} == changes
