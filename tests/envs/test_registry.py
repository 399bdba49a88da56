"""Environments of other packages: found by entry point, imported only when made, refused where names clash."""

import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from gradscape.envs.engines import ENGINES, Engine
from gradscape.envs.registry import BUILTIN, GROUP, entries, environment_class, make

ENVIRONMENT = """
import torch

from gradscape.envs.base import Environment, Fidelity
from gradscape.landscapes.objective import Evaluation, Status
from gradscape.landscapes.space import ParameterSpace


class Arm(Environment):
    name = "my-arm"
    fidelities = {"draft": Fidelity("draft", dt=0.1)}
    space = ParameterSpace.box(["shoulder", "elbow"], -1.0, 1.0, "rad")

    def _evaluate(self, x, *, grad):
        return Evaluation(x.square().sum(dim=1), 2 * x if grad else None, torch.full((len(x),), Status.OK))
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Return a function that puts a package on the path whose entry points are given as {name: target}."""

    def install(points):
        (tmp_path / "gradscape_test_arm.py").write_text(ENVIRONMENT)
        info = tmp_path / "arm_of_mine-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: arm-of-mine\nVersion: 1.0\n")
        lines = [f"[{GROUP}]", *(f"{name} = {target}" for name, target in points.items())]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        entries.cache_clear()

    yield install
    monkeypatch.undo()
    entries.cache_clear()
    sys.modules.pop("gradscape_test_arm", None)


def test_another_packages_environment_is_listed_then_made(package):
    package({"my-arm": "gradscape_test_arm:Arm"})
    entry = entries()["my-arm"]
    assert (entry.target, entry.model) == ("gradscape_test_arm:Arm", "registered by arm-of-mine")
    assert "gradscape_test_arm" not in sys.modules  # listing imports nothing

    arm = make("my-arm")
    x = arm.space.uniform(5, seed=0)
    torch.testing.assert_close(arm.evaluate(x).loss, x.square().sum(dim=1))
    assert torch.autograd.gradcheck(arm, (x.requires_grad_(),))
    assert environment_class("my-arm") is type(arm)


@pytest.mark.parametrize("target", ["gradscape_no_such_module:Arm", "gradscape_test_arm:Leg"])
def test_an_entry_point_that_leads_nowhere_is_refused_with_its_target(package, target):
    package({"my-arm": target})
    with pytest.raises(ValueError, match=f"my-arm is registered as {target}, which cannot be imported"):
        make("my-arm")


def test_a_name_that_is_taken_is_refused_with_both_owners(package):
    package({"fluid": "gradscape_test_arm:Arm"})
    with pytest.raises(ValueError, match="two environments are called 'fluid'") as refusal:
        entries()
    assert "gradscape.envs.mpm.fluid:Fluid" in str(refusal.value)
    assert "gradscape_test_arm:Arm" in str(refusal.value)


def test_names_and_classes_agree():
    assert len({entry.name for entry in BUILTIN}) == len(BUILTIN)
    for entry in BUILTIN:
        cls = environment_class(entry.name)
        assert cls.name == entry.name
        assert f"{cls.__module__}:{cls.__name__}" == entry.target


def test_listing_loads_no_engine():
    script = (
        "import sys; from gradscape.envs.registry import entries; entries(); "
        "print(*({'torch', 'warp', 'botorch', 'numpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_an_engine_without_wheels_for_this_python_says_so_and_what_to_do(monkeypatch):
    gone = Engine("taichi", {"mpm": "nowhere.mpm"}, newest_python=(3, 10))
    monkeypatch.setitem(ENGINES, "taichi", gone)
    with pytest.raises(ValueError, match=r"^fluid cannot run on engine taichi here: Taichi has no wheels past") as said:
        make("fluid", engine="taichi", device="cpu")
    here = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert str(said.value).endswith(
        f"3.10, and this is Python {here}; take engine warp, or install gradscape with Python 3.10"
    )
    monkeypatch.setitem(ENGINES, "taichi", replace(gone, newest_python=(3, 99)))
    with pytest.raises(ValueError, match=r"here: No module named 'gradscape.envs.engines.nowhere'$"):
        make("fluid", engine="taichi", device="cpu")
