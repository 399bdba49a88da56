"""`landscape study convergence`: what it finds of scenes whose convergence is known, keeps and refuses."""

from pathlib import Path
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from gradscape.envs import registry
from gradscape.envs.base import Environment, Episode, Fidelity, Work
from gradscape.landscapes.convert import from_json
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.records import read_json
from gradscape.studies import samples
from gradscape.studies.convergence import ConvergenceRecord, find_refinements

from ..command import Run, Said


class Second(Environment):
    """A bowl off by (1 + x0) dt^2, whose motion goes round in circles."""

    name = "second"
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=0.1),
        "standard": Fidelity("standard", dt=0.05),
        "reference": Fidelity("reference", dt=0.01, precision="float64"),
    }
    designed_order: ClassVar[dict[str, float]] = {"dt": 2.0}
    space = ParameterSpace.box(["x0", "x1"], 0.0, 1.0)
    rate: ClassVar[float] = 0.0

    def work(self) -> Work:
        return Work(round(1 / self.fidelity.dt), "step")

    def episode(self, x: Tensor) -> Episode:
        time = torch.linspace(0, 1, 51, dtype=torch.float64)
        grown = x[0] * torch.exp(self.rate * time)
        places = torch.stack([grown, x[1] * time.cos(), x[1] * time.sin()], dim=1)
        return Episode(time, {"body": places[:, None]})

    def _evaluate(self, x: Tensor, *, grad: bool) -> Evaluation:
        dt = self.fidelity.dt
        loss = x.square().sum(dim=1) + (1 + x[:, 0]) * dt**2
        return Evaluation.from_results(loss, 2 * x + dt**2 * x.new_tensor([1.0, 0.0]) if grad else None)


class Wild(Second):
    """The same losses, noisy by the step, of a motion in which neighbours part a millionfold."""

    name = "wild"
    rate: ClassVar[float] = 14.0

    def _evaluate(self, x: Tensor, *, grad: bool) -> Evaluation:
        loss = torch.sin(1e9 * x[:, 0] * self.fidelity.dt) + x[:, 1]
        loss = loss + (10.0 if self.fidelity.name == "draft" else 0.0)
        return Evaluation.from_results(loss, torch.ones_like(x) if grad else None)


@pytest.fixture(autouse=True)
def registered(few_resamples: None, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("REPETITION", 0.002), ("LARGEST", 0.002)):
        monkeypatch.setattr(samples, name, value)
    for kind in (Second, Wild):
        monkeypatch.setitem(registry.entries(), kind.name, registry.Entry(kind.name, f"{__name__}:{kind.__name__}"))


def study(scene: str, *more: str) -> list[str]:
    return ["study", "convergence", scene, "--points", "16", "--device", "cpu", "--out", "study", *more]


def measured(run: Run, folder: Path, scene: str) -> tuple[ConvergenceRecord, Said]:
    done = run.ok(*study(scene, "--json"), cwd=folder)
    return from_json(ConvergenceRecord, done.json), done


@pytest.mark.drawn
def test_a_scene_of_second_order_converges_and_its_limit_is_the_bowl(run: Run, tmp_path: Path) -> None:
    found, done = measured(run, tmp_path, "second")
    assert found == from_json(ConvergenceRecord, read_json(tmp_path / "study/convergence.json"))
    assert (tmp_path / "study/convergence.png").read_bytes().startswith(b"\x89PNG")
    (one,) = [one for one in found.settings if one.setting == "dt"]
    assert one.order.value == pytest.approx(2, abs=0.01)
    assert (one.verdict, one.as_designed, one.met, one.floor) == ("converges", True, True, None)
    assert "the reference is converged" in done.stderr
    x, spread = Second.space.sobol(16, seed=0), found.spread or 0.0
    for left in found.remainders:
        off = (1 + x[:, 0]) * Second.fidelities[left.name].dt ** 2 / spread
        assert left.median.value == pytest.approx(float(off.quantile(0.5)), rel=1e-5)
    assert found.divergence is not None
    assert found.divergence.chaotic == 0
    assert found.distributions is None


@pytest.mark.drawn
def test_a_chaotic_scene_is_judged_by_distributions(run: Run, tmp_path: Path) -> None:
    found, _ = measured(run, tmp_path, "wild")
    assert found.divergence is not None
    assert found.divergence.is_chaos
    assert found.divergence.rate.value == pytest.approx(14, rel=0.1)
    assert found.rule.met is False
    assert found.remainders == ()
    told = {one.name: one.told for one in found.distributions.compared} if found.distributions else {}
    assert set(told["draft"]) == {"kolmogorov", "wasserstein"}  # ten off
    assert told["reference-dt-x0.5"] == ()


def test_a_trade_off_prints_what_a_study_of_the_same_code_has_left(run: Run, tmp_path: Path) -> None:
    trade = ["study", "fidelity", "second", "--points", "4", "--settings", "dt", "--device", "cpu", "--out", "trade"]
    assert "Richardson" not in run(*trade).stderr
    measured(run, tmp_path, "second")
    said = " ".join(run(*trade).stdout.split())
    assert "the reference is converged" in said
    assert "from Richardson's limit" in said


def test_levels_go_from_coarse_to_fine_about_the_reference() -> None:
    for scene in ("fluid", "cartpole"):
        env = registry.make(scene, fidelity="reference", device="cpu")
        found = find_refinements(env)
        for setting, levels in found.items():
            widths = [width for _, width in levels]
            assert widths == sorted(set(widths), reverse=True)
            assert len(widths) > 2 or setting == "precision"
            assert "reference" in [variant.name for variant, _ in levels]
        assert ("joint" in found) == (scene == "fluid")


def test_widths_are_those_of_the_levels_fidelities() -> None:
    cells = registry.make("fluid", fidelity="reference", device="cpu").fidelity.resolution
    (grids,) = find_refinements(registry.make("fluid", fidelity="reference", device="cpu"), ["resolution"]).values()
    assert [width for _, width in grids] == [cells / one.fidelity.resolution for one, _ in grids]
    assert [width for _, width in grids] == pytest.approx([3 / 2, 1, 2 / 3, 1 / 2], abs=2 / cells)  # even cells
    cartpole = registry.make("cartpole", fidelity="reference", device="cpu")
    (steps,) = find_refinements(cartpole, ["dt"]).values()
    dt = cartpole.fidelity.dt
    assert [width for _, width in steps] == pytest.approx([4 * dt, 2 * dt, dt, dt / 2, dt / 4])
