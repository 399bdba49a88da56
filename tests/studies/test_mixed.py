"""The search of mixed variants, on a scene whose costs and errors are known formulas: its optimum is found by hand."""

import itertools
import json
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

import gradscape as gs
from gradscape.envs import registry
from gradscape.envs.base import Environment, Fidelity, Work
from gradscape.jobs.scene import SceneSpec
from gradscape.jobs.study import StudyJob
from gradscape.landscapes import cost
from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.records import read_json
from gradscape.studies import mixed, samples
from gradscape.studies.claims import CLAIMS, Shortfall
from gradscape.studies.mixed import MixedRecord, fidelity_line, neighbours, next_values
from gradscape.studies.samples import Comparison, Sample, compare
from gradscape.studies.variants import StudyOptions, Variant

from ..clock import Clock
from ..command import Run

CLOCK = Clock()
POINTS = 32


@dataclass(frozen=True)
class TradingOptions:
    """How stiff the contact is, which lets steps be larger where it is soft, and how far gradients are bent."""

    ke: float = 8.0
    bent: float = 0.0


class Trading(Environment):
    """A bowl whose loss is off by 5 dt^2 ke / 8 + 4 / cells^2 + 1e-3 (8 - ke).

    A point takes 2^-10 cells^2 / dt seconds, which the clock adds up exactly, so that variants of the same work tie
    every time. Fails in half of the box at dt of `stable` or more.
    """

    name = "trading"
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=1 / 10, resolution=6),
        "standard": Fidelity("standard", dt=1 / 50, resolution=16),
        "reference": Fidelity("reference", dt=1 / 2000, resolution=512, precision="float64"),
    }
    Options: ClassVar[type[Any]] = TradingOptions
    space = ParameterSpace.box(["x0", "x1"], 0.0, 1.0)
    stable: ClassVar[float] = 0.15

    def work(self) -> Work:
        return Work(round(1 / self.fidelity.dt) * self.fidelity.resolution**2, "cell-step")

    def _evaluate(self, x: Tensor, *, grad: bool) -> Evaluation:
        dt, ke = self.fidelity.dt, self.options.ke
        slower = 1.5 if self.fidelity.precision == "float64" else 1.0
        CLOCK.sleep(len(x) * 2**-10 * self.work().count * slower)
        off = 5 * dt**2 * ke / 8 + 4 / self.fidelity.resolution**2 + 1e-3 * abs(8 - ke)
        loss = x.square().sum(dim=1) + off * (1 + x[:, 0] * torch.cos(40 * x[:, 1]))
        loss[(x[:, 0] > 0.5) & (dt >= self.stable)] = torch.nan
        slope = 2 * x + self.options.bent * off * x.new_tensor([-20.0, 20.0])
        return Evaluation.from_results(loss, slope if grad else None)


@pytest.fixture(autouse=True)
def timed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time by the clock of the scene."""
    CLOCK.now = 0.0
    for module in (samples, cost, mixed):
        monkeypatch.setattr(module, "time", CLOCK)
    monkeypatch.setattr(samples, "RESAMPLES", 29)
    monkeypatch.setattr("gradscape.studies.mixed.free_memory", lambda: None)
    monkeypatch.setitem(registry.entries(), "trading", registry.Entry("trading", f"{__name__}:Trading"))


def search(folder: Path, **how: Any) -> MixedRecord:
    options = how.pop("options", {})
    how.setdefault("time_limit", 1e9)  # of the clock of the scene
    scene = SceneSpec("trading", device="cpu", options=options)
    found = StudyJob.open("mixed", scene, StudyOptions(points=POINTS, **how), out=folder).run()
    assert isinstance(found, MixedRecord)
    return found


def sample(env: Environment, x: Tensor) -> Sample:
    found = env.evaluate(x, grad=True)
    assert found.grad is not None
    return Sample(found.loss.numpy(), found.grad.numpy(), found.status.numpy(), 1.0, 1.0, 1)


@cache
def every_value(stable: float, options: tuple[tuple[str, float], ...]) -> list[tuple[int, int, Comparison]]:
    """Return (steps per second, cells, comparison) of all grids that there are: what tests of a claim share."""
    assert Trading.stable == stable
    x, own = Trading.space.sobol(POINTS, seed=0), dict(options)
    reference = sample(Trading(fidelity="reference", **own), x)
    found = []
    for count, fine in itertools.product((7, 10, 15, 22, 33, 50, 75, 110, 170), (4, 6, 8, 10, 12, 16, 20, 24, 32)):
        one = Fidelity("one", dt=1 / count, resolution=fine)
        found.append((count, fine, compare(sample(Trading(fidelity=one, **own), x), reference, seed=0)))
    return found


def optimum(claim: str, *, chaotic: bool = False, **options: float) -> tuple[float, int]:
    """Return steps per second and cells of the least work that keeps a claim, of all grids that there are."""
    (promise,) = (one for one in CLAIMS if one.name == claim)
    able = [
        (count * fine**2, count, fine)
        for count, fine, found in every_value(Trading.stable, tuple(sorted(options.items())))
        if Shortfall.of(found, promise, chaotic=chaotic).kept
    ]
    return min(able)[1:]


def settings(found: MixedRecord, number: int) -> tuple[float, int]:
    chosen = found.variant(str(found.choices[number].variant)).fidelity
    return round(1 / chosen.dt), chosen.resolution


def test_the_known_optimum_is_found_and_nothing_dearer_than_the_limit_is_measured(tmp_path: Path) -> None:
    found = search(tmp_path / "s")
    assert found.complete
    assert all(one.kept for one in found.choices)
    assert settings(found, 0) == optimum("draft")
    assert settings(found, 1) == optimum("standard")
    assert {settings(found, 0), settings(found, 1)}.isdisjoint({(10, 6), (50, 16)})  # neither is what it is today
    limit = 4 * found.variant("standard").seconds
    assert all(one.seconds <= 1.001 * limit for one in found.measured.variants if one.name != "reference")
    assert len(found.measured.variants) + len(found.dismissed) < 81  # grids, without their float64
    assert read_json(tmp_path / "s/mixed.json") == json.loads(json.dumps(to_json(found)))
    assert from_json(MixedRecord, to_json(found)) == found
    assert eval(found.lines[0].split(":", 1)[1].rstrip(","), {"Fidelity": Fidelity}).dt == 1 / settings(found, 0)[0]


def test_a_variant_that_fails_is_given_up_at_the_first_points_and_never_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps of 1/7 s would keep what draft promises; where half of the box fails at them, the next ones are taken."""
    monkeypatch.setattr(Trading, "stable", 0.12)
    found = search(tmp_path / "s")
    assert {one.why for one in found.dismissed if one.name.startswith("dt 142.9 ms")} == {"fails at 50% of 16 points"}
    assert all(one.comparison.diverged == 0 for one in found.measured.variants)
    assert settings(found, 0) == optimum("draft")


@pytest.mark.slow
@pytest.mark.drawn
def test_the_verb_prints_both_names_draws_and_goes_on_after_a_stop(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["study", "mixed", "trading", "--points", str(POINTS), "--device", "cpu", "--json", "--time-limit", "1e9"]
    whole = run.ok(*words, "--out", "whole")
    for said in ("draft today", "standard today", "the cheapest that keeps it", '"draft": Fidelity("draft", dt=1 / '):
        assert said in whole.stderr
    assert (tmp_path / "whole/mixed.png").read_bytes().startswith(b"\x89PNG")
    measure, count = samples.measure, 0

    def stopped(env: Any, x: Tensor, **how: Any) -> Sample:
        nonlocal count
        count += 1
        if count == 6:
            raise KeyboardInterrupt
        return measure(env, x, **how)

    monkeypatch.setattr(samples, "measure", stopped)
    done = run(*words, "--out", "half")
    assert (done.returncode, done.stdout) == (130, "")
    assert "variants are kept in half" in done.stderr
    kept = sorted(path.name for path in (tmp_path / "half/pieces").iterdir())
    assert kept
    count = -10_000
    resumed = run.json(*words, "--out", "half")
    ours, theirs = resumed, whole.json
    names = [[one["name"] for one in record["measured"]["variants"]] for record in (ours, theirs)]
    assert names[0] == names[1]
    assert [one["variant"] for one in ours["choices"]] == [one["variant"] for one in theirs["choices"]]
    monkeypatch.setattr(samples, "measure", None)  # nothing is measured a third time
    assert run.json(*words, "--out", "half")["choices"] == ours["choices"]


def test_a_budget_ends_the_search_and_says_so(tmp_path: Path) -> None:
    found = search(tmp_path / "s", time_limit=1e-6)
    assert not found.complete
    assert [one.name for one in found.measured.variants][:3] == ["reference", "draft", "standard"]
    assert len(found.measured.variants) + len(found.dismissed) == 4  # one, which took longer than that
    assert {found.choices[0].variant, found.choices[0].kept} == {"draft", False}


def test_where_the_limit_leaves_none_the_nearest_is_taken(tmp_path: Path) -> None:
    found = search(tmp_path / "s", max_cost=1.0)
    draft = found.choices[0]
    assert not draft.kept
    cheap = [one for one in found.measured.variants if one.seconds <= draft.today_seconds]
    short = {one.name: Shortfall.of(one.comparison, draft.claim).value for one in cheap}
    assert draft.variant == min(short, key=lambda name: short[name])
    assert draft.shortfall == short[draft.variant] > 1


@pytest.mark.slow
def test_gradients_count_unless_the_motion_is_chaotic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    finer = Trading.fidelities | {"draft": Fidelity("draft", dt=1 / 10, resolution=8)}
    monkeypatch.setattr(Trading, "fidelities", finer)
    bent = {"bent": 0.4}
    strict = search(tmp_path / "strict", options=bent)
    loose = search(tmp_path / "loose", options=bent, chaotic=True)
    assert settings(strict, 0) == optimum("draft", **bent)
    assert settings(loose, 0) == optimum("draft", chaotic=True, **bent)
    assert strict.choices[0].kept
    assert loose.choices[0].kept
    assert strict.choices[0].seconds > loose.choices[0].seconds  # type: ignore[operator]
    assert loose.chaotic


@pytest.mark.slow
def test_an_option_that_makes_it_cheaper_is_told_but_not_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Trading, "contact_stiffness", "ke")
    found = search(tmp_path / "s")
    own = asdict(TradingOptions())
    assert all(found.variant(str(one.variant)).options == own and one.kept for one in found.choices)
    assert [settings(found, number) for number in (0, 1)] == [optimum("draft"), optimum("standard")]
    assert found.with_options
    for one in found.with_options:
        (same,) = (other for other in found.choices if other.claim == one.claim)
        assert found.variant(str(one.variant)).options["ke"] < 8
        assert one.kept
        assert one.seconds < same.seconds  # type: ignore[operator]


def test_an_option_of_accuracy_is_tried_by_its_listed_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Trading, "accuracy_options", {"ke": (2.0, 4.0, 16.0)})
    env = Trading(fidelity="standard")
    found = [one.options["ke"] for one in neighbours(Variant.of(env), Variant.of(env), env) if one.options["ke"] != 8]
    assert found == [4.0, 16.0]


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"max_cost": 0.0}, "--max-cost takes a positive number"),
        ({"time_limit": float("inf")}, "--time-limit takes a positive number"),
        ({"settings": ("dt",)}, "study mixed takes points, seed, max_cost, time_limit, chaotic; got settings"),
    ],
)
def test_what_cannot_be_is_refused(how: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=said):
        search(tmp_path / "s", **how)


def test_a_scene_without_the_names_is_refused() -> None:
    with pytest.raises(ValueError, match="draft and standard besides their reference; branin has exact"):
        gs.study("mixed", "branin")


@pytest.mark.parametrize("scene", ["cartpole", "pinball-2", "flip", "fluid", "torus", "swing-velocity", "bounce"])
def test_neighbours_are_one_value_off_and_can_be_made(scene: str) -> None:
    env = gs.make(scene, fidelity="standard", device="cpu")
    standard = Variant.of(env)
    found = neighbours(standard, standard, env)
    assert len({one.key() for one in found}) == len(found) >= 2
    for one in found:
        made = one.make(env)
        assert abs(made.nearest_dt(made.fidelity.dt) - made.fidelity.dt) < 1e-12
        back = neighbours(one, standard, env)
        assert standard.key() in {other.key() for other in back}  # a notch up and one down is where it began
    changed = [
        {key for key, value in asdict(one.fidelity).items() if value != asdict(standard.fidelity)[key]} for one in found
    ]
    assert all(len(keys - {"name"}) <= 1 for keys in changed)


def test_grids_are_a_series_through_the_middle() -> None:
    assert next_values(50, 50, 1.5, round, least=1) == [33, 75]
    assert next_values(60, 50, 1.5, round, least=1) == [50, 75]
    assert next_values(1, 2, 1.5, round, least=1) == [2]
    assert next_values(0, 0, 1.5, round, least=1) == []
    assert next_values(16.0, 2.0, 2.0, float, least=0.25, most=16.0) == [8.0]


@pytest.mark.parametrize(
    ("fidelity_", "step", "line"),
    [
        (Fidelity("x", dt=1 / 240), 0.0, '"draft": Fidelity("draft", dt=1 / 240),'),
        (
            Fidelity("x", dt=0.002 / 9, resolution=32, particles=1200, precision="float64"),
            0.002,
            '"draft": Fidelity("draft", dt=0.002 / 9, resolution=32, particles=1_200, precision="float64"),',
        ),
        (Fidelity("x", dt=0.0033, sampling=1.26), 0.0, '"draft": Fidelity("draft", dt=0.0033, sampling=1.26),'),
    ],
)
def test_the_line_of_python_makes_the_same_fidelity(fidelity_: Fidelity, step: float, line: str) -> None:
    assert fidelity_line(fidelity_, "draft", step) == line
    made = eval(line.split(":", 1)[1].rstrip(","), {"Fidelity": Fidelity})
    assert {**asdict(made), "name": "x", "dt": 0} == {**asdict(fidelity_), "dt": 0}
    assert made.dt == pytest.approx(fidelity_.dt, rel=1e-12)
