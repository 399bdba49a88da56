"""The digest of a scene's code: what changes it, and what does not."""

import importlib
import json
import shutil
from pathlib import Path

import pytest

from gradscape.envs import code
from gradscape.envs.base import Environment
from gradscape.envs.code import code_digest, computes_losses, find_files
from gradscape.envs.mpm.plasticine import Plasticine
from gradscape.envs.registry import BUILTIN, environment_class, make
from gradscape.landscapes.code import bare

SCENES = [entry.name for entry in BUILTIN]
SOFT = {name for name in SCENES if issubclass(environment_class(name), Plasticine)}
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


def test_code_that_computes_the_same_numbers_has_the_digest_of_older_code(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = environment_class("bounce")
    own = code.own_digest(kind)
    monkeypatch.setattr(code, "_numbers_of", lambda: {("bounce", own): "older"})
    assert code_digest.__wrapped__(kind) == "older"
    for scene, digest in (("bounce", "another"), ("cartpole", own)):
        monkeypatch.setattr(code, "_numbers_of", lambda key=(scene, digest): {key: "older"})
        assert code_digest.__wrapped__(kind) == own


def test_what_computes_the_same_numbers_is_said_of_the_code_that_is_here_and_names_the_oldest() -> None:
    kept = json.loads(code.SAME_NUMBERS.read_text())
    for scene, one in kept.items():
        kind = environment_class(scene)
        assert code.own_digest(kind) == one["code"], (
            f"that is not {scene}'s code: run benchmarks.same_numbers, or delete what it says"
        )
        assert code_digest(kind) == one["numbers_of"]
        assert one["numbers_of"] not in {other["code"] for other in kept.values()}


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Copy the environments, for a test to change."""
    shutil.copytree(code.HERE, tmp_path / "envs", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "envs"


def files_of(name: str, engine: str = "", folder: Path = code.HERE) -> set[str]:
    own = engine or environment_class(name).engines[0]
    return {str(file.relative_to(folder)) for file in find_files([folder / home_of(name)], folder, own)}


# What scenes import, or lies beside them, and computes no loss: it says so itself.
SILENT = {"base.py", "batching.py", "code.py", "registry.py", "observation.py", "outlines.py", "engines/runtime.py"}
SILENT |= {"installed.py", "records.py", "mpm/plasticine_look.py", "engines/mpm/kernels.py", "engines/demand.py"}
# What no scene imports.
ELSEWHERE = {"importing.py", "points.py", "engines/profiling.py", "engines/engine.py", "engines/warp.py"}
ELSEWHERE |= {"engines/warp_functions.py"}  # what it makes of a function is no scene


def home_of(name: str) -> str:
    return environment_class(name).__module__.removeprefix("gradscape.envs.").replace(".", "/") + ".py"


def test_a_scene_has_the_files_that_it_computes_with_and_no_other_scene_s() -> None:
    engine = {"solver.py", "transfers.py", "scatter.py", "columns.py", "checkpoints.py", "materials/fluid.py"}
    assert {"mpm/fluid.py", "mpm/scene.py", *(f"engines/mpm/{name}" for name in engine)} <= files_of("fluid")
    assert files_of("bounce") == {"bounce.py", "engines/balls/rigid.py", "options.py"}
    scenes, homes = {name: files_of(name) for name in SCENES}, {name: home_of(name) for name in SCENES}
    for name, files in scenes.items():
        assert set(homes.values()) & files == {homes[name]}


def test_every_file_counts_for_some_scene_or_is_known_not_to() -> None:
    every = {file.relative_to(code.HERE) for file in code.HERE.rglob("*.py") if file.name != "__init__.py"}
    ours = {str(file) for file in every if "taichi" not in file.parts}
    assert {name for name in ours if not computes_losses(code.HERE / name)} == SILENT
    assert ours - set().union(*map(files_of, SCENES)) == SILENT | ELSEWHERE


def test_another_engine_is_other_code() -> None:
    assert "engines/taichi/mpm.py" not in files_of("fluid")
    assert files_of("fluid", "taichi") >= {"engines/taichi/mpm.py", "mpm/fluid.py"}
    kind = environment_class("fluid")
    assert code_digest(kind) != code_digest(kind, "taichi")
    assert make("bounce", device="cpu").identity()["code"] == code_digest(environment_class("bounce"))


def texts(name: str, folder: Path) -> list[str]:
    return [bare(folder / one, code.NO_LOSS) for one in sorted(files_of(name, folder=folder))]


@pytest.fixture(scope="module")
def as_it_is() -> dict[str, list[str]]:
    """Return the code of every scene before a test changes its copy."""
    return {name: texts(name, code.HERE) for name in SCENES}


@pytest.mark.parametrize(
    ("file", "added", "changes"),
    [
        ("engines/balls/rigid.py", "G = 9.8", {"bounce"}),
        ("engines/balls/rigid.py", "\n# a remark\n", set()),
        ("engines/balls/rigid.py", "import math", set()),
        ("bounce.py", "def episode(): ...", set()),
        ("base.py", "G = 9.8", set()),
        ("sheets/swing.py", "def _parts(): ...", set()),
        ("sheets/swing.py", "fidelities: dict[str, int] = {}", set()),
        ("mpm/plasticine_model.py", "def fidelities(): ...", set()),
        ("engines/mpm/raster.py", "COMPUTES_LOSSES = False", set(SOFT)),
        ("sheets/lattice.py", "G = 9.8", {"swing-velocity", "swing-stiffness", "flip"}),
    ],
)
def test_a_change_is_told_to_the_scenes_it_may_matter_to(
    as_it_is: dict[str, list[str]], copy: Path, file: str, added: str, changes: set[str]
) -> None:
    (copy / file).write_text((copy / file).read_text() + added)
    assert {name for name in SCENES if texts(name, copy) != as_it_is[name]} == changes
