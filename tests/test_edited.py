"""A simulator that was edited does not continue with what was stored before: it is refused with both numbers."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

import gradscape as gs
from gradscape import Environment, Evaluation, Fidelity, ParameterSpace, Plane
from gradscape.envs.functions import Branin
from gradscape.envs.records import ModelPart
from gradscape.jobs.slice import SliceJob
from gradscape.jobs.watch import Stopped
from gradscape.landscapes.identity import StoreMismatchError
from gradscape.landscapes.sampling.refine import Refinement

from .processes import alone, landscape
from .watches import Stop

pytestmark = pytest.mark.e2e

SPACE = ParameterSpace({"x": (-1, 1), "y": (-1, 1)})
DIMS = ("x", "y")
Loss = Callable[[Tensor], Tensor]
BOTH = r"{} of {} whose losses have changed: \S+ then, \S+ now, at x = \(\S+, \S+\); .*--out.*--force"


def plain(x: Tensor) -> Tensor:
    return x[:, 0] + x[:, 1] ** 2


def edited(x: Tensor) -> Tensor:
    return 100 * x[:, 0] + x[:, 1] ** 2


def loss_of(fn: Loss) -> Any:
    return gs.from_torch(fn, SPACE, name="loss")


def bits(folder: Path) -> dict[str, bytes]:
    """Return the content of every file of a store."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


PLANE = Plane.through(SPACE, SPACE.center, DIMS, resolution=24)


def half(objective: Any, out: Path, **how: Any) -> None:
    """Sample a half of a slice."""
    with pytest.raises(Stopped):
        SliceJob.of(objective, PLANE, command="", out=out, **how).run(Stop(100))


# --- slices ---


def with_slope(x: np.ndarray[Any, Any], slope: float) -> Any:
    return x[:, 0] + x[:, 1], np.stack([np.full(len(x), slope), np.ones(len(x))], axis=1)


def sloped(slope: float) -> Any:
    return gs.from_numpy(partial(with_slope, slope=slope), SPACE, name="loss")


CHANGES = {
    "losses": (loss_of(plain), loss_of(edited), BOTH.format("slice", "loss")),
    "a little": (loss_of(plain), loss_of(lambda x: plain(x) * (1 + 1e-9)), "losses have changed"),
    "gradients": (sloped(2.0), sloped(1.0), r"gradients have changed: gradient by x 2 then, 1 now"),
    "status": (
        loss_of(lambda x: plain(x) * torch.nan),
        loss_of(plain),
        "points end differently: NONFINITE then, OK now",
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_finished_slice_of_an_edited_function_is_refused_with_both_numbers(tmp_path: Path, change: str) -> None:
    before, after, said = CHANGES[change]
    where: dict[str, Any] = {"resolution": 8, "out": tmp_path / "cut", "gradients": change != "status"}
    gs.slice(before, DIMS, **where)
    gs.slice(before, DIMS, **where)
    kept = (tmp_path / "cut/slice.zarr.zip").read_bytes()
    with pytest.raises(StoreMismatchError, match=said) as refused:
        gs.slice(after, DIMS, **where)
    assert str(tmp_path / "cut") in str(refused.value)
    assert (tmp_path / "cut/slice.zarr.zip").read_bytes() == kept
    gs.slice(after, DIMS, **where, force=True)
    gs.slice(after, DIMS, **where)


@pytest.mark.parametrize("refine", [None, 0.01])
def test_a_slice_that_was_stopped_half_way_is_not_filled_up_by_an_edited_function(
    tmp_path: Path, refine: float | None
) -> None:
    how = {"refinement": Refinement(refine) if refine else None}
    half(gs.from_torch(lambda x: (8 * plain(x)).sin(), SPACE, name="loss"), tmp_path / "cut", **how)
    kept = bits(tmp_path / "cut")
    where = {"dims": DIMS, "resolution": 24, "out": tmp_path / "cut", "refine": refine}
    with pytest.raises(StoreMismatchError, match=BOTH.format("slice", "loss")):
        gs.slice(gs.from_torch(lambda x: (9 * plain(x)).sin(), SPACE, name="loss"), **where)
    assert bits(tmp_path / "cut") == kept
    gs.slice(gs.from_torch(lambda x: (8 * plain(x)).sin(), SPACE, name="loss"), **where)


@pytest.mark.parametrize("gradients", [0, 1, 4])
def test_a_function_whose_names_alone_changed_goes_on(tmp_path: Path, gradients: int) -> None:
    def renamed(points: Tensor) -> Tensor:
        first, second = points[:, 0], points[:, 1]
        return first + second**2

    half(loss_of(plain), tmp_path / "cut", gradients=gradients)
    found = gs.slice(loss_of(renamed), DIMS, resolution=24, out=tmp_path / "cut", gradients=gradients)
    whole = gs.slice(loss_of(plain), DIMS, resolution=24, gradients=gradients)
    np.testing.assert_array_equal(found.data["loss"], whole.data["loss"])


def test_a_function_that_differs_at_every_call_goes_on_within_its_noise(tmp_path: Path) -> None:
    random = torch.Generator().manual_seed(0)

    def noisy(x: Tensor) -> Tensor:
        return plain(x) + 0.05 * torch.randn(len(x), generator=random, dtype=torch.float64)

    for seed in range(20):
        gs.slice(loss_of(noisy), DIMS, resolution=8, out=tmp_path / f"{seed}")
        gs.slice(loss_of(noisy), DIMS, resolution=8, out=tmp_path / f"{seed}")
    with pytest.raises(StoreMismatchError, match="losses have changed"):
        gs.slice(loss_of(lambda x: 100 * noisy(x)), DIMS, resolution=8, out=tmp_path / "0")


def test_rounding_that_a_batch_or_a_simulator_amplifies_goes_on(tmp_path: Path) -> None:
    """One sums in float32 in an order that the batch decides, the other amplifies the last digit a million times."""

    def single(x: Tensor) -> Tensor:
        terms = x.float() @ torch.linspace(-1, 1, 2 * 501).reshape(2, 501) + 0.1
        return ((terms.flip(1) if len(x) % 2 else terms).cumsum(1)[:, -1] ** 2).double() / 3

    def chaotic(moved: float) -> Callable[[Tensor], Tensor]:
        def fn(x: Tensor) -> Tensor:
            value = (x.sum(dim=1) / 4 + 0.5) * (1 + moved)
            for _ in range(20):
                value = 3.99 * value * (1 - value)
            return value

        return fn

    gs.slice(loss_of(single), DIMS, resolution=9, out=tmp_path / "single")
    gs.slice(loss_of(single), DIMS, resolution=9, out=tmp_path / "single")
    gs.slice(loss_of(chaotic(0.0)), DIMS, resolution=8, out=tmp_path / "chaotic")
    gs.slice(loss_of(chaotic(2.0**-51)), DIMS, resolution=8, out=tmp_path / "chaotic")
    with pytest.raises(StoreMismatchError, match="losses have changed"):
        gs.slice(loss_of(chaotic(1e-4)), DIMS, resolution=8, out=tmp_path / "chaotic")


def test_workers_fill_nothing_up_that_is_another_functions(tmp_path: Path) -> None:
    half(loss_of(plain), tmp_path / "cut")
    kept = bits(tmp_path / "cut")
    job = SliceJob.of(loss_of(edited), PLANE, command="", out=tmp_path / "cut")
    with ThreadPoolExecutor(2) as executor, pytest.raises(StoreMismatchError, match="losses have changed"):
        replace(job, executor=executor).run()
    assert bits(tmp_path / "cut") == kept


def test_a_report_of_a_slice_refuses_an_edited_function(tmp_path: Path) -> None:
    cut = gs.slice(loss_of(plain), DIMS, resolution=8, out=tmp_path / "cut")
    cut.report(points=2)
    with pytest.raises(StoreMismatchError, match="losses have changed"):
        type(cut)(cut.data, cut.folder, lambda: loss_of(edited)).report(points=2)


# --- every study of an environment ---


@dataclass(frozen=True)
class Soft:
    """`ke` counts for nothing."""

    ke: float = 8.0


class Throw(Environment):
    """A bowl whose curvature is edited by the tests, as no digest of its text could tell."""

    name: ClassVar[str] = "throw"
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=0.1, precision="float64"),
        "standard": Fidelity("standard", dt=0.05, precision="float64"),
        "reference": Fidelity("reference", dt=0.01, precision="float64"),
    }
    Options: ClassVar[type[Any]] = Soft
    model_parts: ClassVar[tuple[ModelPart, ...]] = (ModelPart("softness", {"ke": 4.0}, "half as soft"),)
    space = SPACE
    curvature: ClassVar[float] = 1.0

    def _evaluate(self, x: Tensor, *, grad: bool) -> Evaluation:
        loss = self.curvature * (x**2).sum(dim=1) + x[:, 0] + self.fidelity.dt
        slope = 2 * self.curvature * x + torch.tensor([1.0, 0.0], dtype=torch.float64)
        return Evaluation.from_results(loss, slope if grad else None)


STUDIES: dict[str, Callable[[Path], Any]] = {
    "slice": lambda out: gs.slice(Throw, DIMS, resolution=6, out=out),
    "refined": lambda out: gs.slice(Throw, DIMS, resolution=17, refine=0.05, out=out),
    "sweep": lambda out: gs.sweep(Throw, DIMS, over="smoothing", frames=2, resolution=4, out=out),
    "optimize": lambda out: gs.optimize(Throw, "random", budget=4, out=out),
    "race": lambda out: gs.race(Throw, ["random", "descents"], budget=6, seeds=2, out=out),
    "pairs": lambda out: gs.pairs(Throw, samples=2, out=out),
    "hessian": lambda out: gs.hessian(Throw, out=out),
    "census": lambda out: gs.census(Throw, slices=1, resolution=6, out=out),
    "fidelity": lambda out: gs.study("fidelity", Throw, points=2, settings=["precision"], out=out),
    "convergence": lambda out: gs.study("convergence", Throw, points=2, out=out),
    "model": lambda out: gs.study("model", Throw, points=2, out=out),
    "mixed": lambda out: gs.study("mixed", Throw, points=2, time_limit=0.01, out=out),
    "extremes": lambda out: gs.study("extremes", Throw, points=2, settings=["dt"], precisions=["float64"], out=out),
}


@pytest.mark.parametrize("study", STUDIES)
def test_the_same_call_after_an_edit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, study: str) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gradscape.studies.own_folder.user_data_path", lambda name: tmp_path / "user" / name)
    for name in ("REPETITION", "LARGEST", "MIN_SECONDS", "BATCH_SECONDS"):
        monkeypatch.setattr(f"gradscape.studies.samples.{name}", 0.002)
    out = tmp_path / "made"
    STUDIES[study](out)
    STUDIES[study](out)
    kept = {name: content for name, content in bits(out).items() if name.endswith(".npz") or ".zarr" in name}
    assert kept
    monkeypatch.setattr(Throw, "curvature", 3.0)
    with pytest.raises(StoreMismatchError, match=r"throw whose losses have changed: \S+ then, \S+ now") as refused:
        STUDIES[study](out)
    assert str(out) in str(refused.value)
    assert {name: bits(out)[name] for name in kept} == kept
    assert bits(out).keys() >= kept.keys()


def overlaid(out: Path, again: bool) -> Any:
    cut = gs.open_slice(out / "cut", env=Throw) if again else gs.slice(Throw, DIMS, resolution=6, out=out / "cut")
    run = gs.open_run(out / "run") if again else gs.optimize(Throw, "random", budget=4, out=out / "run")
    return gs.overlay(cut, run, through="best", out=out / ("again" if again else "over"))


EXTENDED: dict[str, tuple[Callable[[Path, bool], Any], str]] = {
    "run": (
        lambda out, again: gs.optimize(Throw, "descents", budget=20 if again else 6, out=out),
        r"contains a run of throw whose losses have changed",
    ),
    "race": (
        lambda out, again: gs.race(Throw, ["random"], budget=4, seeds=2 if again else 1, out=out),
        "losses have changed",
    ),
    "league": (
        lambda out, again: gs.league([Throw], ["random"], budget=4, seeds=1, out=out),
        r"throw@draft: StoreMismatchError: .* whose losses have changed",
    ),
    "overlay": (overlaid, "losses have changed"),
}


@pytest.mark.parametrize("what", EXTENDED)
def test_nothing_is_extended_by_an_edited_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    call, said = EXTENDED[what]
    call(tmp_path / "made", False)
    monkeypatch.setattr(Throw, "curvature", 3.0)
    with pytest.raises(ValueError, match=said):
        call(tmp_path / "made", True)
    monkeypatch.undo()
    call(tmp_path / "made", True)


def test_a_card_goes_on_with_the_same_engines_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    how: dict[str, Any] = {"resolution": 3, "device": "cpu", "out": tmp_path / "card"}
    gs.card(["control"], **how)
    gs.card(["control"], **how)
    evaluate = Branin._evaluate

    def halved(env: Branin, x: Tensor, *, grad: bool) -> Evaluation:
        found = evaluate(env, x, grad=grad)
        return Evaluation(found.loss / 2, found.grad, found.status)

    monkeypatch.setattr(Branin, "_evaluate", halved)
    with pytest.raises(StoreMismatchError, match="a study of branin whose losses have changed"):
        gs.card(["control"], **how)


# --- files that are edited between two commands ---

MINE = """
from pathlib import Path
import torch
from gradscape import Environment, Evaluation, ParameterSpace
from helper import soft as force


class Throw(Environment):
    name = "mine"
    space = ParameterSpace({"x": (-1, 1), "y": (-1, 1)})

    def _evaluate(self, x, *, grad):
        x = x.requires_grad_(grad)
        mass = float(Path(__file__).with_name("mass.txt").read_text())
        loss = mass * force(x) + x[:, 0] + 0.5 * x[:, 1]
        slope = torch.autograd.grad(loss.sum(), x)[0] if grad else None
        return Evaluation.from_results(loss.detach(), slope)
"""
HELPER = "def soft(x):\n    return (x**2).sum(dim=1)\n"
COMMANDS = (
    "slice my.py:Throw --dims 0 1 --resolution 6 --out cut",
    "optimize my.py:Throw --method random --budget 4 --out run",
)


@pytest.mark.parametrize("edited_file", ["helper.py", "mass.txt"])
def test_an_edit_of_what_a_class_uses_is_noticed_where_it_changes_a_number(tmp_path: Path, edited_file: str) -> None:
    """Between two commands: of an imported module within a second, or of a data file."""

    def edit(name: str, before: str, after: str) -> None:
        file = tmp_path / name
        written = file.stat().st_mtime_ns
        assert before in file.read_text()
        file.write_text(file.read_text().replace(before, after))
        os.utime(file, ns=(written, written))

    for name, content in {"my.py": MINE, "helper.py": HELPER, "mass.txt": "1.0"}.items():
        (tmp_path / name).write_text(content)
    commands = COMMANDS if edited_file == "helper.py" else COMMANDS[:1]
    for step in range(3):
        if step == 1:
            edit("helper.py", "x", "points")
        if step == 2:
            edit(edited_file, *{"helper.py": ("**2", "**3"), "mass.txt": ("1.0", "2.0")}[edited_file])
        for command in commands:
            done = alone(partial(landscape, *command.split()), tmp_path)
            assert done.returncode == (2 if step == 2 else 0), done.stderr
            assert ("are done already" in done.stderr) is (step == 1)
            assert ("of mine whose losses have changed:" in done.stderr) is (step == 2)
            assert step < 2 or done.stderr.strip().count("\n") == 0
