"""`study extremes` on schemes whose stability is known in closed form."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

import gradscape as gs
from gradscape.envs.base import Environment, Fidelity, MaterialRange, Work
from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.space import ParameterSpace
from gradscape.studies import stability
from gradscape.studies.extremes import ExtremesRecord, Limit, spread_points
from gradscape.studies.kept import describe_margins
from gradscape.studies.samples import Sample

WIDTH = 0.05


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gradscape.landscapes.draw.figures.page.save", lambda figure, path: path.touch())


@dataclass(frozen=True)
class Stiff:
    """`k` [N/m] of the spring, of 1 kg."""

    k: float = 100.0


class Spring(Environment):
    """A spring by semi-implicit Euler: x grows without bound where dt > 2 / sqrt(k / m), and not below."""

    name = "spring-of-test"
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "standard": Fidelity("standard", dt=0.02, precision="float64"),
        "reference": Fidelity("reference", dt=0.001, precision="float64"),
    }
    Options: ClassVar[type[Any]] = Stiff
    contact_stiffness: ClassVar[str] = "k"
    steps: ClassVar[int] = 4000
    space = ParameterSpace({"start": (0.5, 1.0, "m")})

    def work(self) -> Work:
        return Work(self.steps, "step")

    def _evaluate(self, x: Tensor, *, grad: bool) -> Evaluation:
        gain = self._gain(self.fidelity.dt, self.options.k)
        return Evaluation.from_results(gain * x[:, 0], torch.full_like(x, gain) if grad else None)

    def _gain(self, dt: float, k: float) -> float:
        """Return x at the end of one that began at 1 at rest; infinite beyond 1e30, as a step's number is beyond it."""
        step = np.array([[1 - k * dt**2, dt], [-k * dt, 1.0]])
        with np.errstate(all="ignore"):
            ends = np.linalg.matrix_power(step, self.steps) @ np.array([1.0, 0.0])
        return float(ends[0]) if abs(ends[0]) < 1e30 else math.inf


class Decay(Spring):
    """A decay at rate k by explicit Euler, x (1 - k dt)^n: it grows where dt > 2 / k."""

    name = "decay-of-test"

    def _gain(self, dt: float, k: float) -> float:
        growth = abs(1 - k * dt)
        return (1 - k * dt) ** self.steps if growth <= 1 else math.inf


class Patchy(Spring):
    """Stable up to 0.05 s, and again from 0.2 to 0.7 s."""

    name = "patchy-of-test"
    contact_stiffness: ClassVar[str] = ""

    def _gain(self, dt: float, k: float) -> float:
        return 1.0 if dt <= 0.05 or 0.2 <= dt <= 0.7 else math.inf


class Harmless(Patchy):
    """Never fails."""

    name = "harmless-of-test"

    def _gain(self, dt: float, k: float) -> float:
        return 1.0


class Polite(Patchy):
    """Explodes politely: beyond 0.1 s its losses are finite, and a thousand times too large."""

    name = "polite-of-test"

    def _gain(self, dt: float, k: float) -> float:
        return 1.0 if dt <= 0.1 else 1000.0


class Fenced(Patchy):
    """Raises where the start is beyond 3 m, refuses what is beyond 20 m."""

    name = "fenced-of-test"
    beyond_box = True

    def _evaluate(self, x: Tensor, *, grad: bool) -> Evaluation:
        if float(x.abs().max()) > 20:
            raise ValueError("the start is beyond 20 m")
        if float(x.abs().max()) > 3:
            raise RuntimeError("the start is beyond 3 m")
        return Evaluation.from_results(x[:, 0], torch.ones_like(x) if grad else None)


class Hurried(Patchy):
    """Its own step of 0.02 s fails; 0.004 s does not."""

    name = "hurried-of-test"

    def _gain(self, dt: float, k: float) -> float:
        return 1.0 if dt <= 0.004 else math.inf


class Ranged(Harmless):
    """Restitution from 0 to 1, stable up to 0.9."""

    name = "ranged-of-test"
    material_range: ClassVar[MaterialRange] = MaterialRange("k", 0.0, 1.0)

    def _gain(self, dt: float, k: float) -> float:
        return 1.0 if k <= 0.9 else math.inf


def turn(
    kind: type[Environment], tmp_path: Path, *settings: str, pairs: tuple[str, ...] = (), **how: Any
) -> ExtremesRecord:
    how = {"points": 4, "precisions": ["float64"], "width": WIDTH, "device": "cpu", **how}
    return gs.study("extremes", kind, settings=settings, pairs=pairs, out=tmp_path / "study", **how)


def limit_of(found: ExtremesRecord, setting: str, end: str = "largest") -> Limit:
    (limit,) = (one for one in found.limits if (one.setting, one.end) == (setting, end))
    return limit


def assert_bracketed(limit: Limit, truth: float) -> None:
    assert limit.stable is not None
    assert limit.failed is not None
    low, high = sorted((limit.stable, limit.failed))
    assert low <= truth * (1 + 1e-3)  # a spring a little beyond its limit grows too slowly to be seen
    assert truth <= high * (1 + 1e-3)
    assert high / low <= 1 + WIDTH


@pytest.mark.parametrize(
    ("kind", "step", "stiffness"), [(Spring, 2 / math.sqrt(100.0), 4 / 0.02**2), (Decay, 2 / 100.0, 2 / 0.02)]
)
def test_the_largest_step_and_stiffness_are_those_of_the_closed_form(
    kind: type[Environment], step: float, stiffness: float, tmp_path: Path
) -> None:
    found = turn(kind, tmp_path, "dt", "k")
    assert_bracketed(limit_of(found, "dt"), step)
    assert_bracketed(limit_of(found, "k"), stiffness)
    assert limit_of(found, "k", "smallest").failed is None
    assert {limit.beyond for limit in found.limits} == {"NONFINITE", ""}
    assert limit_of(found, "dt").margin == pytest.approx(0.02 / step, rel=WIDTH + 1e-3)


def test_the_boundary_of_a_map_goes_with_the_root_of_the_stiffness(tmp_path: Path) -> None:
    (found,) = turn(Spring, tmp_path, "dt", pairs=("dt:k",), grid=6).maps
    assert len(found.boundary) >= 3
    for k, stable, failed in found.boundary:
        assert stable <= 2 / math.sqrt(k) * (1 + 1e-3)
        assert 2 / math.sqrt(k) <= failed * (1 + 1e-3)
        assert failed / stable <= 1 + WIDTH
    cells = np.array([cell.stable for cell in found.cells]).reshape(len(found.ys), len(found.xs))
    for row, k in zip(cells, found.ys, strict=True):
        assert row.tolist() == [dt < 2 / math.sqrt(k) * (1 + 1e-3) for dt in found.xs]


def test_islands_beyond_the_first_failure_are_reported(tmp_path: Path) -> None:
    limit = limit_of(turn(Patchy, tmp_path, "dt"), "dt")
    assert_bracketed(limit, 0.05)
    assert limit.islands == ((pytest.approx(0.32), pytest.approx(0.64)),)


def test_what_never_fails_is_stable_up_to_the_last_that_was_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = turn(Harmless, tmp_path, "dt")
    limit = limit_of(found, "dt")
    assert (limit.failed, limit.beyond) == (None, "")
    assert limit.stable == pytest.approx(64 * 0.02)
    (said,) = describe_margins(Harmless(device="cpu"))
    assert "standard's step is stable, and so is one 64 times as long; all losses are within 10%" in said
    assert "(float64; warp on cpu, 4 points" in said
    assert "when standard had" not in said
    monkeypatch.setattr(Harmless, "fidelities", {"standard": replace(Harmless.fidelities["standard"], dt=0.01)})
    (said,) = describe_margins(Harmless(device="cpu"))
    assert said.endswith(", when standard had dt 0.02)")


def test_finite_losses_that_are_wrong_are_called_so(tmp_path: Path) -> None:
    limit = limit_of(turn(Polite, tmp_path, "dt"), "dt")
    assert limit.failed is None
    assert [cell.outcome for cell in limit.scanned] == ["accurate"] * 3 + ["inaccurate"] * 4
    assert limit.accurate is not None
    assert limit.wrong is not None
    assert limit.accurate <= 0.1 <= limit.wrong
    assert limit.wrong / limit.accurate <= 1 + WIDTH
    x = Polite.space.from_unit(spread_points(1, 4, 0))[:, 0].numpy()
    wrong = 999 * x.max() / np.subtract(*np.percentile(x, (95, 5)))
    assert limit.scanned[-1].error == pytest.approx(wrong)


def test_an_error_is_a_status_of_its_points_and_a_value_error_a_refusal(tmp_path: Path) -> None:
    found = turn(Fenced, tmp_path, "box")
    limit = limit_of(found, "box")
    assert_bracketed(limit, (3 - 0.75) / 0.25)  # of a box from 0.5 to 1
    assert limit.beyond == "ERROR"
    outcomes = {cell.values[0]: cell for cell in limit.scanned}
    assert outcomes[16.0].outcome == "ERROR"
    assert 0 < outcomes[16.0].share < 1
    assert outcomes[16.0].why == "RuntimeError: the start is beyond 3 m"
    assert outcomes[128.0 / 2].outcome == "ERROR"
    assert outcomes[64.0].stable is False


def test_a_refused_setting_is_listed_with_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Environment) -> None:
        if self.fidelity.dt > 0.3:
            raise ValueError("it takes steps up to 0.3 s")

    monkeypatch.setattr(Harmless, "_setup", refuse)
    found = turn(Harmless, tmp_path, "dt")
    assert_bracketed(limit_of(found, "dt"), 0.3)
    assert limit_of(found, "dt").beyond == "refused"
    assert {one.why for one in found.refused} == {"it takes steps up to 0.3 s"}


def test_a_scene_whose_own_step_fails_has_a_limit_below_it(tmp_path: Path) -> None:
    limit = limit_of(turn(Hurried, tmp_path, "dt"), "dt")
    assert_bracketed(limit, 0.004)
    assert limit.margin is not None
    assert limit.margin > 1


def test_a_setting_that_may_be_zero_is_bisected_by_differences(tmp_path: Path) -> None:
    limit = limit_of(turn(Ranged, tmp_path, "k", options={"k": 0.5}), "k")
    assert limit.stable is not None
    assert limit.failed is not None
    assert limit.stable <= 0.9 <= limit.failed
    assert limit.failed - limit.stable <= WIDTH
    assert limit_of(turn(Ranged, tmp_path, "k", options={"k": 0.5}), "k", "smallest").stable == 0.0


def test_a_stopped_study_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = turn(Spring, tmp_path / "whole", "dt", "k")
    ask, asked = stability.ask, list[int]()

    def stopped(env: Any, x: Tensor, **how: Any) -> Sample:
        if len(asked) == 9:
            raise KeyboardInterrupt
        asked.append(1)
        return ask(env, x, **how)

    monkeypatch.setattr("gradscape.studies.extremes.ask", stopped)
    with pytest.raises(KeyboardInterrupt, match="9 settings are kept"):
        turn(Spring, tmp_path, "dt", "k")
    kept = {file: file.read_bytes() for file in (tmp_path / "study/pieces").iterdir()}
    monkeypatch.setattr("gradscape.studies.extremes.ask", ask)
    again = turn(Spring, tmp_path, "dt", "k")
    assert again.limits == whole.limits
    assert kept == {file: file.read_bytes() for file in kept}
    monkeypatch.setattr("gradscape.studies.extremes.ask", None)  # all is there: nothing is asked
    assert turn(Spring, tmp_path, "dt", "k") == again


def test_a_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    found = turn(Spring, tmp_path, pairs=("dt:k",), grid=3)
    assert from_json(ExtremesRecord, to_json(found)) == found
    assert list(found.table().index.names) == ["setting", "end", "precision"]


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"settings": ("speed",)}, "spring-of-test has settings dt, k; got speed"),
        ({"pairs": ("dt",)}, "--pairs takes two settings, such as dt:box"),
        ({"precisions": ["half"]}, "--precisions takes float32, float64; got half"),
        ({"width": 0.0}, "--width takes a share between 0 and 1"),
        ({"tolerance": -1.0}, "--tolerance takes a share of the losses' spread"),
        ({"reference": "exact"}, "has fidelities standard, reference as its reference; got 'exact'"),
    ],
)
def test_what_cannot_be_is_refused(how: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=said):
        gs.study("extremes", Spring, out=tmp_path / "study", **how)
    assert not (tmp_path / "study").exists()


def test_a_ball_s_penalty_contact_is_right_up_to_the_limit_of_its_spring_and_wrong_beyond(tmp_path: Path) -> None:
    """Semi-implicit Euler in a contact of stiffness ke and damping kd: ke dt^2 + 2 kd dt = 4 m is the last stable step.

    Beyond, each contact adds energy, though every loss is finite; a contact, half a period, of less than two steps is
    no more accurate either way.
    """
    ke, kd = 4e3, 10.0
    how = {"precisions": ["float64"], "fidelity": Fidelity("coarse", dt=1 / 240, precision="float64"), "device": "cpu"}
    how |= {"options": {"horizon": 0.25, "ke": ke, "kd": kd}}
    limit = limit_of(gs.study("extremes", "bounce", points=8, settings=["dt"], out=tmp_path / "ball", **how), "dt")  # type: ignore[arg-type]
    last = (-kd + math.sqrt(kd**2 + 4 * ke)) / ke
    assert limit.failed is None  # explodes politely
    assert limit.accurate is not None
    assert 0.25 * last < limit.accurate < last
    assert all(cell.outcome == "inaccurate" for cell in limit.scanned if cell.values[0] > last)


def test_half_of_a_sample_are_corners_at_most() -> None:
    x = spread_points(3, 16, seed=0)
    corners = ((x == 0) | (x == 1)).all(dim=1)
    assert x.shape == (16, 3)
    assert corners[:8].all()
    assert not corners[8:].any()
    assert len({tuple(row) for row in x.tolist()}) == 16
