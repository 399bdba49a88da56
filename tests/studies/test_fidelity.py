"""`landscape study fidelity` and `--tolerance`: what they leave, say, continue from and refuse."""

import json
import weakref
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

import gradscape
from gradscape.envs import registry
from gradscape.envs.base import Environment, Fidelity, Work
from gradscape.landscapes import cost
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.records import read_json, write_record
from gradscape.landscapes.verification import POINTS
from gradscape.studies import samples, variants
from gradscape.studies.fidelity import SETTINGS, list_variants

from ..clock import Clock
from ..command import Run

CLOCK = Clock()
CUT = ["slice", "converging", "--device", "cpu", "--dims", "0", "1", "--resolution", "3"]
TRADE = ["study", "fidelity", "converging", "--points", "16", "--device", "cpu", "--out", "trade"]


class Converging(Environment):
    """A bowl whose loss is off by (1 + x0) dt^2, in float32 by 1e-7 more, in 1e-3 / dt seconds a point.

    Refuses dt of 0.4 or more, diverges at 0.2 where x0 is large.
    """

    name = "converging"
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=0.1),
        "standard": Fidelity("standard", dt=0.05),
        "reference": Fidelity("reference", dt=1e-4, precision="float64"),
    }
    space = ParameterSpace.box(["x0", "x1"], 0.0, 1.0)

    def _setup(self) -> None:
        if self.fidelity.dt >= 0.4:
            raise ValueError(f"converging takes dt below 0.4; got {self.fidelity.dt}")

    def work(self) -> Work:
        return Work(round(1 / self.fidelity.dt), "step")

    def _evaluate(self, x: Tensor, *, grad: bool) -> Evaluation:
        dt = self.fidelity.dt
        CLOCK.sleep(len(x) * 1e-3 / dt)
        rounding = 1e-7 if self.fidelity.precision == "float32" else 0.0
        loss = x.square().sum(dim=1) + (1 + x[:, 0]) * dt**2 + rounding
        loss[(x[:, 0] > 0.5) & (dt >= 0.2)] = torch.nan
        return Evaluation.from_results(loss, 2 * x + dt**2 * x.new_tensor([1.0, 0.0]) if grad else None)


@pytest.fixture(autouse=True)
def timed(few_resamples: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Time by the clock of the scene."""
    for module in (samples, cost):
        monkeypatch.setattr(module, "time", CLOCK)
    monkeypatch.setitem(registry.entries(), "converging", registry.Entry("converging", f"{__name__}:Converging"))


def _double(found: Evaluation) -> Evaluation:
    return Evaluation(2 * found.loss, None if found.grad is None else 2 * found.grad, found.status)


def by_name(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in report["variants"]}


def study(report: dict[str, Any]) -> dict[str, Any]:
    """Return what two studies have in common, however far the clock was when they began."""

    def rounded(variant: dict[str, Any]) -> dict[str, Any]:
        found = variant["comparison"]
        seconds = {way: round(value, 9) for way, value in found["seconds"].items()}
        return {**variant, "comparison": {**found, "seconds": seconds}}

    return {
        **report,
        "variants": list(map(rounded, report["variants"])),
        "command": None,
        "folder": None,
        "provenance": None,
    }


@pytest.mark.drawn
def test_errors_and_order_of_convergence_are_those_of_the_scene(run: Run, tmp_path: Path) -> None:
    report = run.json(*TRADE)
    assert {**read_json(tmp_path / "trade/fidelity.json"), "folder": "trade"} == report
    assert (tmp_path / "trade/fidelity.png").read_bytes().startswith(b"\x89PNG")
    rows = by_name(report)
    x = Converging.space.sobol(16, seed=0)
    for name, dt in (("draft", 0.1), ("standard", 0.05), ("standard-dt-x0.5", 0.025)):
        off = (1 + x[:, 0]) * (dt**2 - 1e-8) + 1e-7
        assert rows[name]["comparison"]["loss_error"]["median"]["value"] == pytest.approx(float(off.quantile(0.5)))
        assert rows[name]["comparison"]["loss_error"]["p95"]["value"] == pytest.approx(float(off.sort().values[-1]))
        assert rows[name]["comparison"]["seconds"] == pytest.approx(
            dict.fromkeys(("forward", "with_gradient"), 1e-3 / dt)
        )
    (fit,) = report["orders"]  # of variants in float32, without the reference's own
    assert fit["variants"] == ["draft", "standard", "standard-dt-x0.5"]
    assert fit["order"] == pytest.approx(2, abs=0.01)


def test_a_study_is_printed_without_being_measured_again(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.ok(*TRADE, "--settings", "precision")
    simulate, rows = Converging._evaluate, list[int]()
    monkeypatch.setattr(Converging, "_evaluate", lambda *x, grad: rows.append(len(x[1])) or simulate(*x, grad=grad))
    done = run.ok(*TRADE, "--settings", "precision", "--figure-width-mm", "85")
    assert "fidelity-85mm.pdf, fidelity-85mm.svg" in done.stderr
    assert (tmp_path / "trade/fidelity-85mm.pdf").read_bytes().startswith(b"%PDF")
    run.ok(*TRADE, "--settings", "precision")
    assert rows == [POINTS, POINTS]  # those that are verified, each time


def test_variants_that_are_refused_or_whose_engine_gives_up_are_listed_and_those_that_diverge_are_counted(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulate = Converging._evaluate

    def short_of_memory(self: Converging, x: Tensor, *, grad: bool) -> Evaluation:
        if self.fidelity.name == "standard-float64":
            raise RuntimeError("out of memory")
        return simulate(self, x, grad=grad)

    monkeypatch.setattr(Converging, "_evaluate", short_of_memory)
    done = run(*TRADE, "--json")
    report = done.json
    refused = {one["name"]: one["why"] for one in report["refused"]}
    assert refused == {
        "draft-dt-x4": "converging takes dt below 0.4; got 0.4", "standard-float64": "out of memory"
    }  # fmt: skip
    assert "refused: draft-dt-x4: converging takes dt below 0.4; got 0.4" in done.stderr
    coarse = by_name(report)["draft-dt-x2"]
    x = Converging.space.sobol(16, seed=0)
    assert coarse["comparison"]["diverged"] == pytest.approx(float((x[:, 0] > 0.5).double().mean()))
    assert coarse["comparison"]["loss_error"]["p95"]["value"] is None


def test_a_variant_has_given_back_its_memory_when_the_next_one_is_measured(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulate, release, holding = Converging._evaluate, Environment.release, list[weakref.ref[Converging]]()
    beside = set[int]()

    def followed(self: Converging, x: Tensor, *, grad: bool) -> Evaluation:
        beside.add(sum(env() not in (None, self) for env in holding))
        if all(env() is not self for env in holding):
            self.cycle = self  # type: ignore[attr-defined]
            holding.append(weakref.ref(self))
        return simulate(self, x, grad=grad)

    def released(self: Converging) -> None:
        holding[:] = [env for env in holding if env() is not self]
        release(self)

    monkeypatch.setattr(Converging, "_evaluate", followed)
    monkeypatch.setattr(Environment, "release", released)
    assert len(run.json(*TRADE, "--settings", "precision")["variants"]) == 6
    assert beside == {0}


def test_what_is_far_slower_than_the_reference_is_given_up_at_its_first_points(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulate = Converging._evaluate

    def slower(self: Converging, x: Tensor, *, grad: bool) -> Evaluation:
        CLOCK.sleep(1e3 * len(x) * (self.fidelity.name == "draft-float64"))
        return simulate(self, x, grad=grad)

    monkeypatch.setattr(Converging, "_evaluate", slower)
    done = run(*TRADE, "--settings", "precision", "--json")
    rows = by_name(done.json)
    assert {name: row["given_up"] for name, row in rows.items() if row["given_up"]} == {"draft-float64": 1}
    assert rows["draft-float64"]["comparison"]["compared"] == 1
    assert "abandoned, at more than 3 times the reference's time: draft-float64 after 1 of 16 points" in done.stderr


def test_the_reference_is_evaluated_once_for_studies_of_every_kind(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a few of its points say other numbers now, it is evaluated again."""
    simulate, evaluated = Converging._evaluate, list[int]()

    def counted(self: Converging, x: Tensor, *, grad: bool) -> Evaluation:
        if self.fidelity.name == "reference" and grad:
            evaluated.append(len(x))
        return simulate(self, x, grad=grad)

    monkeypatch.setattr(Converging, "_evaluate", counted)
    how = ["converging", "--points", "16", "--device", "cpu", "--out"]
    first = run.json("study", "fidelity", *how, "a")
    evaluated.clear()
    done = run.ok("study", "convergence", *how, "b", "--settings", "precision")
    assert "levels to measure, the reference from stored results at 16 points" in done.stderr
    assert sum(evaluated) == 2 * POINTS  # what the study is verified by, and what the kept points are
    monkeypatch.setattr(Converging, "_evaluate", lambda *x, grad: _double(simulate(*x, grad=grad)))
    with pytest.warns(RuntimeWarning, match="losses have changed: .* it is evaluated again"):
        renewed = run.json("study", "fidelity", *how, "c")
    assert renewed["spread"] == pytest.approx(2 * first["spread"])


def test_a_dt_that_does_not_divide_the_episode_is_refused() -> None:
    env = Converging(fidelity="draft")
    base = variants.Variant.of(env)
    thirds = base.change("thirds", "dt", fidelity=Fidelity("thirds", dt=0.3))
    with pytest.raises(ValueError, match=r"with dt 0.3 s it would be 0.9 times as long"):
        thirds.make(env)
    assert base.change("halves", "dt", fidelity=Fidelity("halves", dt=0.05)).make(env).fidelity.dt == 0.05


def cells(scene: str, fidelity: str, factor: float) -> str:
    """Return the name of the variant that has so many times the cells of a fidelity, an even number."""
    own = registry.environment_class(scene).fidelities[fidelity].resolution
    return f"{fidelity}-resolution-{2 * round(own * factor / 2)}"


@pytest.mark.parametrize(
    ("scene", "wanted"),
    [
        ("bounce", {"draft-ke-x4", "draft-dt-x2", "draft-float64", "reference-float32", "draft on cuda"}),
        ("fluid", {cells("fluid", "standard", 1.5), "draft-particles-x2", "draft on taichi", "standard-dt-x2"}),
        ("table", {"standard-particles-x0.5", cells("table", "draft", 2 / 3)}),
        ("flip", {cells("flip", "standard", 2 / 3), "draft on taichi"}),
    ],
)
def test_scenes_have_the_variants_of_their_knobs(scene: str, wanted: set[str]) -> None:
    found = list_variants(registry.make(scene, fidelity="reference", device="cpu"), SETTINGS)
    names = [variant.name for variant in found]
    assert names[0] == "reference"
    assert wanted <= set(names)
    assert len({variant.key() for variant in found}) == len(found)
    assert ("draft-ke-x4" in names) == (scene == "bounce")
    particles = {one.changed for one in found} & {"particles"}
    assert bool(particles) == (scene in ("fluid", "table"))


def test_a_stopped_study_goes_on_with_the_next_variant(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "whole").mkdir()
    whole = run.json(*TRADE, cwd=tmp_path / "whole")
    measure, measured = samples.measure, []

    def stopped(env: Any, x: Tensor, **how: Any) -> samples.Sample:
        if len(measured) == 3:
            raise KeyboardInterrupt
        measured.append(env.fidelity.name)
        return measure(env, x, **how)

    monkeypatch.setattr(samples, "measure", stopped)
    done = run(*TRADE, "--json")
    assert (done.returncode, done.stdout) == (130, "")
    assert "stopped: 3 of" in done.stderr
    assert not (tmp_path / "trade/fidelity.json").exists()
    kept = {path.name: path.read_bytes() for path in (tmp_path / "trade/pieces").iterdir()}
    monkeypatch.setattr(samples, "measure", measure)
    resumed = run.json(*TRADE)
    assert study(resumed) == study(whole)
    assert kept == {name: (tmp_path / "trade/pieces" / name).read_bytes() for name in kept}


def test_a_tolerance_takes_the_quickest_fidelity_within_it(run: Run, tmp_path: Path) -> None:
    report = run.json(*TRADE)
    errors = {row["name"]: row["comparison"]["loss_error"]["p95_relative"]["value"] for row in report["variants"]}
    within = [row for row in report["variants"] if (off := errors[row["name"]]) is not None and off <= 0.02]
    wanted = min(within, key=lambda row: row["comparison"]["seconds"]["with_gradient"])
    assert len(report["variants"]) > len(within) > 1
    cut = run.ok(*CUT, "--tolerance", "2%", "--out", "cut")
    assert f"{wanted['name']}: the fastest of" in cut.stderr
    assert gradscape.open_slice(tmp_path / "cut").identity["settings"] == wanted["fidelity"]
    searched = run.json("optimize converging --device cpu --tolerance 2% --method random --budget 3")
    assert searched["fidelity"] == wanted["fidelity"]["name"]


def test_a_tolerance_that_nothing_meets_names_the_best(run: Run, tmp_path: Path) -> None:
    kept = Path(tmp_path / "data").rglob("*.json")
    run(*TRADE)
    (path,) = kept
    report = read_json(path)
    report["variants"] = [
        row for row in report["variants"] if row["name"] != "reference" and "reference" not in row["name"]
    ]
    report["identity"]["model_version"] = 0
    write_record(path, report)
    run.refuse(*CUT, "--tolerance", "1e-9", said="the best is standard-dt-x0.5")
    some = run.ok(*CUT, "--tolerance", "50%")
    assert "warning: the errors were measured by converging model 0; this is model 1" in some.stderr


def test_a_name_whose_settings_changed_since_is_not_chosen(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run(*TRADE)
    how = [*CUT, "--tolerance", "50%"]
    before = run.json(*how, "--out", "before")["fidelity"]
    monkeypatch.setattr(Converging, "fidelities", {**Converging.fidelities, "draft": Fidelity("draft", dt=0.125)})
    after = run.json(*how, "--out", "after")["fidelity"]
    assert before == "draft"
    assert after != "draft"


def test_the_gallerys_variants_of_the_same_problem_are_found_where_nothing_of_the_users_own_is(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = run.json(*TRADE)
    for kept in (tmp_path / "data").rglob("*.json"):
        kept.unlink()
    softer = json.loads(json.dumps(by_name(report)["draft"])) | {"name": "softer", "options": {"ke": 1.0}}
    softer["comparison"]["seconds"] = {"forward": 0.0, "with_gradient": 0.0}
    path = tmp_path / "data" / "studies" / "converging-cpu.fidelity.json"
    path.parent.mkdir(parents=True)
    monkeypatch.setattr("gradscape.studies.kept.resources.files", lambda package: tmp_path)
    how = [*CUT, "--tolerance", "50%"]
    write_record(path, {**report, "variants": [softer, *report["variants"]]})
    done = run.ok(*how)
    assert str(path) in done.stderr
    assert "softer: " not in done.stderr
    write_record(path, {**report, "identity": {**report["identity"], "options": {"ke": 1.0}}})
    assert "no fidelity of converging with these options is measured" in run(*how).stderr


def test_a_slice_at_a_measured_fidelity_can_be_cut_anew(run: Run, tmp_path: Path) -> None:
    run(*TRADE, "--settings", "dt")
    run(*CUT, "--tolerance", "0.0015", "--out", "cut")
    run("optimize converging --device cpu --tolerance 0.0015 --method random --budget 3 --out searched")
    assert json.loads((tmp_path / "cut/summary.json").read_text())["fidelity"] == "standard-dt-x0.5"
    run.ok("overlay cut searched --through best --device cpu --out over")


def elsewhere(report: dict[str, Any]) -> dict[str, Any]:
    """Return a report as it would be of a GPU, on which the finest variants_ are the quickest."""
    finest = {"reference": 1e-9, "standard": 1e-6}

    def of(name: str) -> dict[str, float]:
        return dict.fromkeys(("forward", "with_gradient"), finest.get(name, 1.0))

    variants_ = [
        {**row, "device": "cuda", "comparison": {**row["comparison"], "seconds": of(row["name"])}}
        for row in report["variants"]
    ]
    return {**report, "variants": variants_, "identity": {**report["identity"], "device": "cuda"}}


def test_seconds_are_those_of_the_device_that_will_run(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors measured on a GPU count here; its seconds do not: what may be quickest is timed, once, and kept."""
    report = run.json(*TRADE)
    for kept in (tmp_path / "data").rglob("*.json"):
        kept.write_text(json.dumps(elsewhere(report)))
    timed: list[str] = []

    def slow(env: gradscape.Environment) -> float:
        timed.append(env.fidelity.name)
        return variants.expected_work(env)

    monkeypatch.setattr(variants, "seconds_with_gradient", slow)
    how = [*CUT, "--json"]
    errors = {row["name"]: row["comparison"]["loss_error"]["p95_relative"]["value"] for row in report["variants"]}
    within = [name for name, off in errors.items() if off is not None and off <= 0.02]
    work = {
        row["name"]: variants.expected_work(gradscape.make("converging", fidelity=Fidelity(**row["fidelity"])))
        for row in report["variants"]
    }
    done = run(*how, "--tolerance", "2%")
    chosen = done.json["fidelity"]
    assert work[chosen] == min(work[name] for name in within)
    assert chosen not in ("reference", "standard")
    likely = {name for name in within if work[name] <= 2 * min(work[other] for other in within)}
    assert set(timed) == likely
    assert 1 < len(timed) < len(within)  # what is dearer from the outset is not tried
    assert "one at a time on cpu, timed here" in done.stderr
    timed.clear()
    assert run.json(*how, "--tolerance", "2%")["episodes"] == 0
    assert timed == []
