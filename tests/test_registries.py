"""Environments and methods of other packages: found by entry point, imported only when made, refused on clashes."""

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch

from gradscape.envs import registry as envs
from gradscape.envs.engines import ENGINES, Engine
from gradscape.optim import registry as optim

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

OPTIMIZER = '''
"""A search of another package."""

import torch

from gradscape.optim.base import Kind, NoOptions, Optimizer, Proposal


class Corners(Optimizer):
    """Ask for the lower corner, then for the upper one, and so on."""

    name = "corners"
    Options = NoOptions

    def _setup(self):
        self.side = -1.0

    def _ask(self):
        return Proposal(torch.full((1, self.space.dim), self.side, dtype=torch.float64), Kind.POPULATION)

    def _tell(self, z, loss, grad):
        self.side = -self.side
'''

MODULE = "gradscape_test_other"


@dataclass(frozen=True)
class Registry:
    """One of the two: what lists it and finds a class, the code of another package, and one of our names."""

    module: Any
    listed: Any
    find: Callable[[str], Any]
    code: str
    clash: str

    def install(self, folder, points: Mapping[str, str]) -> None:
        """Write a package whose entry points are given as {name: target}."""
        (folder / f"{MODULE}.py").write_text(self.code)
        info = folder / "other_of_mine-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-of-mine\nVersion: 1.0\n")
        lines = [f"[{self.module.GROUP}]", *(f"{name} = {target}" for name, target in points.items())]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


REGISTRIES = {
    "environment": Registry(envs, envs.entries, envs.environment_class, ENVIRONMENT, "fluid"),
    "method": Registry(optim, optim.methods, optim.optimizer_class, OPTIMIZER, "random"),
}


@pytest.fixture(params=REGISTRIES)
def kind(request):
    return request.param


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Return a function that puts a package on the path which registers things of a kind."""

    def install(kind, points):
        REGISTRIES[kind].install(tmp_path, points)
        monkeypatch.syspath_prepend(str(tmp_path))
        REGISTRIES[kind].listed.cache_clear()
        return REGISTRIES[kind]

    yield install
    monkeypatch.undo()
    for one in REGISTRIES.values():
        one.listed.cache_clear()
    sys.modules.pop(MODULE, None)


def test_another_packages_environment_is_listed_then_made(package):
    package("environment", {"my-arm": f"{MODULE}:Arm"})
    entry = envs.entries()["my-arm"]
    assert (entry.target, entry.model) == (f"{MODULE}:Arm", "registered by other-of-mine")
    assert MODULE not in sys.modules  # listing imports nothing

    arm = envs.make("my-arm")
    x = arm.space.uniform(5, seed=0)
    torch.testing.assert_close(arm.evaluate(x).loss, x.square().sum(dim=1))
    assert torch.autograd.gradcheck(arm, (x.requires_grad_(),))
    assert envs.environment_class("my-arm") is type(arm)


def test_another_packages_method_is_listed_then_searches_by_the_command(package, run, tmp_path):
    package("method", {"corners": f"{MODULE}:Corners"})
    method = optim.methods()["corners"]
    assert (method.target, method.summary) == (f"{MODULE}:Corners", "registered by other-of-mine")
    assert MODULE not in sys.modules  # listing imports nothing
    assert "other-of-mine" in run("methods", cwd=tmp_path).stdout
    assert "lower corner" in run("methods", "corners", cwd=tmp_path).stdout
    done = run(*["optimize", "branin", "--method", "corners", "--budget", "5", "--json"], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["kinds"]["population"] == 5
    done = run(*["race", "branin", "--methods", "corners,random", "--budget", "4", "--seeds", "2"], cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("target", ["gradscape_no_such_module:Arm", f"{MODULE}:Leg"])
def test_an_entry_point_that_leads_nowhere_is_refused_with_its_target(package, kind, target):
    registry = package(kind, {"one": target})
    with pytest.raises(ValueError, match=f"one is registered as {target}, which cannot be imported"):
        registry.find("one")


def test_an_entry_point_of_another_name_than_its_class_is_refused(package):
    package("method", {"edges": f"{MODULE}:Corners"})
    with pytest.raises(ValueError, match="whose name is 'corners'; give entry point and class the same name"):
        optim.optimizer_class("edges")


def test_a_name_that_is_taken_is_refused_with_both_owners(package, kind):
    ours = {entry.name: entry.target for entry in REGISTRIES[kind].module.BUILTIN}
    registry = package(kind, {REGISTRIES[kind].clash: f"{MODULE}:Other"})
    with pytest.raises(ValueError, match=f"two {kind}s are called '{registry.clash}'") as refusal:
        registry.listed()
    assert ours[registry.clash] in str(refusal.value)
    assert f"{MODULE}:Other" in str(refusal.value)


def test_names_and_classes_agree(kind):
    registry = REGISTRIES[kind]
    assert len({entry.name for entry in registry.module.BUILTIN}) == len(registry.module.BUILTIN)
    for entry in registry.module.BUILTIN:
        found = registry.find(entry.name)
        assert found.name == entry.name
        assert f"{found.__module__}:{found.__name__}" == entry.target


@pytest.mark.parametrize(("module", "function"), [("envs", "entries"), ("optim", "methods")])
def test_listing_loads_no_engine_and_no_library(module, function):
    script = (
        f"import sys; from gradscape.{module}.registry import {function}; {function}(); "
        "print(*({'torch', 'warp', 'botorch', 'numpy', 'cma'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_an_engine_without_wheels_for_this_python_says_so_and_what_to_do(monkeypatch):
    gone = Engine("taichi", {"mpm": "nowhere.mpm"}, newest_python=(3, 10))
    monkeypatch.setitem(ENGINES, "taichi", gone)
    with pytest.raises(ValueError, match=r"^fluid cannot run on engine taichi here: Taichi has no wheels past") as said:
        envs.make("fluid", engine="taichi", device="cpu")
    here = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert str(said.value).endswith(
        f"3.10, but this is Python {here}; use engine warp, or install gradscape with Python 3.10"
    )
    monkeypatch.setitem(ENGINES, "taichi", replace(gone, newest_python=(3, 99)))
    with pytest.raises(ValueError, match=r"here: No module named 'gradscape.envs.engines.nowhere'$"):
        envs.make("fluid", engine="taichi", device="cpu")
