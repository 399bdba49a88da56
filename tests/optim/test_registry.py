"""Optimisers of other packages: found by entry point, imported only when made, refused where names clash."""

import subprocess
import sys

import pytest

from gradscape.optim.registry import BUILTIN, GROUP, methods, optimizer_class

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


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Return a function that puts a package on the path whose entry points are given as {name: target}."""

    def install(points, code=OPTIMIZER):
        (tmp_path / "gradscape_test_corners.py").write_text(code)
        info = tmp_path / "corners_of_mine-1.0.dist-info"
        info.mkdir(exist_ok=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: corners-of-mine\nVersion: 1.0\n")
        lines = [f"[{GROUP}]", *(f"{name} = {target}" for name, target in points.items())]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        methods.cache_clear()

    yield install
    monkeypatch.undo()
    methods.cache_clear()
    sys.modules.pop("gradscape_test_corners", None)


def test_another_packages_method_is_listed_then_searches_by_the_command(package, run):
    package({"corners": "gradscape_test_corners:Corners"})
    method = methods()["corners"]
    assert (method.target, method.summary) == ("gradscape_test_corners:Corners", "registered by corners-of-mine")
    assert "gradscape_test_corners" not in sys.modules  # listing imports nothing
    assert "corners-of-mine" in run("methods").stdout
    assert "lower corner" in run("methods corners").stdout
    assert run.json("optimize branin --method corners --budget 5")["kinds"]["population"] == 5
    run.ok("race branin --methods corners,random --budget 4 --seeds 2")


@pytest.mark.parametrize("target", ["gradscape_no_such_module:Corners", "gradscape_test_corners:Middle"])
def test_an_entry_point_that_leads_nowhere_is_refused_with_its_target(package, target):
    package({"corners": target})
    with pytest.raises(ValueError, match=f"corners is registered as {target}, which cannot be imported"):
        optimizer_class("corners")


def test_an_entry_point_of_another_name_than_its_class_is_refused(package):
    package({"edges": "gradscape_test_corners:Corners"})
    with pytest.raises(ValueError, match="whose name is 'corners'; give entry point and class the same name"):
        optimizer_class("edges")


def test_a_name_that_is_taken_is_refused_with_both_owners(package):
    package({"random": "gradscape_test_corners:Corners"})
    with pytest.raises(ValueError, match="two methods are called 'random'") as refusal:
        methods()
    assert "gradscape.optim.methods.random:RandomSearch" in str(refusal.value)
    assert "gradscape_test_corners:Corners" in str(refusal.value)


def test_names_and_classes_agree():
    assert len({method.name for method in BUILTIN}) == len(BUILTIN)
    for method in BUILTIN:
        kind = optimizer_class(method.name)
        assert kind.name == method.name
        assert f"{kind.__module__}:{kind.__name__}" == method.target


def test_listing_loads_no_library():
    script = (
        "import sys; from gradscape.optim.registry import methods; methods(); "
        "print(*({'torch', 'numpy', 'botorch', 'cma'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
