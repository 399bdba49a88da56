"""`landscape census` and `gs.census`: what they leave, continue from, and refuse."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.envs.base import Environment
from gradscape.jobs import census as module
from gradscape.jobs.census import CensusJob
from gradscape.jobs.scene import SceneSpec
from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.measures.census import MEASURES, Census, CensusDesign, survey
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.storage.records import read_json

from ..command import Run

HOW = {"slices": 4, "resolution": 8}
SCENE = SceneSpec("ackley", device="cpu", options={"dim": 3})


@pytest.mark.drawn
def test_a_census_is_written_read_and_drawn(tmp_path: Path) -> None:
    found = CensusJob.open(SCENE, **HOW, out=tmp_path / "made").run()
    assert found.losses.shape == (4, 8, 8)
    assert list(found.table().index) == list(MEASURES)
    assert sorted(found.order) == [0, 1, 2, 3]
    grades = [found.words[word] for word in ("gradients follow", "gradients follow loosely", "gradients do not follow")]
    assert sum(one.value for one in grades) == 1
    assert all(one.low < one.high for one in grades)
    record = read_json(tmp_path / "made/census.json")
    assert to_json(from_json(Census, record)) == to_json(found) == {k: v for k, v in record.items() if k != "checksum"}
    with np.load(tmp_path / "made/census.npz") as arrays:
        low, whole, loss = arrays["low"], arrays["high"] - arrays["low"], arrays["loss"].astype(float)
        off = low[:, None, None] + whole[:, None, None] * loss - found.losses
        assert (np.abs(off).max(axis=(1, 2)) < 3e-4 * whole).all()
        assert [(float(a), float(b)) for a, b in zip(low, arrays["high"], strict=True)] == [
            pytest.approx(one.range, rel=1e-6) for one in found.slices
        ]
    assert (tmp_path / "made/census.png").read_bytes().startswith(b"\x89PNG")


def test_a_stopped_census_goes_on_with_the_next_slice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = CensusJob.open(SCENE, **HOW, out=tmp_path / "whole").run()
    surveyed, survey = [], module._survey

    def stop_at_the_third(*args: object) -> object:
        if len(surveyed) == 2:
            raise KeyboardInterrupt
        surveyed.append(args[1])  # one slice: as many of its pairs of samples are looked into as a batch has points
        return survey(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "_survey", stop_at_the_third)
    with pytest.raises(BaseException, match="2 of 4 slices are kept"):
        CensusJob.open(SCENE, **HOW, out=tmp_path / "stopped").run()
    monkeypatch.setattr(module, "_survey", survey)
    job = CensusJob.open(SCENE, **HOW, out=tmp_path / "stopped")
    assert [task.piece for task in job.left()] == ["slice-2", "slice-3"]
    found = job.run()
    assert np.array_equal(found.losses, whole.losses)
    assert found.slices == whole.slices


def test_workers_find_the_same(tmp_path: Path) -> None:
    here = CensusJob.open(SCENE, **HOW, out=tmp_path / "here").run()
    with ThreadPoolExecutor(2) as executor:
        job = CensusJob.open(SCENE, **HOW, out=tmp_path / "there")
        there = replace(job, executor=executor).run()
    assert there.slices == here.slices


def test_another_fidelity_is_told_apart_from_other_slices(tmp_path: Path) -> None:
    scene = SceneSpec("bounce", device="cpu", options={"horizon": 0.5})
    found = CensusJob.open(scene, slices=4, resolution=6, also="standard", out=tmp_path / "made").run()
    assert found.other == "standard"
    known = [one.fidelity for one in found.parts.values() if np.isfinite(one.fidelity)]
    assert known
    assert all(share >= 0 for share in known)


def test_what_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="so it takes --resolution of at least 6; got 4"):
        CensusJob.open(SCENE, slices=4, resolution=4)
    CensusJob.open(SCENE, **HOW, out=tmp_path / "made")
    with pytest.raises(ValueError, match="resolution: wanted 9, found 8"):
        CensusJob.open(SCENE, slices=4, resolution=9, out=tmp_path / "made")


def test_the_verb_and_python_say_the_same(run: Run, tmp_path: Path) -> None:
    said = run.ok("census ackley --set dim=3 --slices 4 --resolution 8 --device cpu --out made --json")
    assert "share of slices" in said.stderr
    found = gs.census("ackley", slices=4, resolution=8, out=tmp_path / "called", device="cpu", options={"dim": 3})
    for name in ("slices", "words", "parts"):
        assert said.json[name] == to_json(found)[name]


def test_gradients_at_every_second_sample_change_no_measure(tmp_path: Path) -> None:
    scene = replace(SCENE, name="levy")  # of which, other than of Ackley's, even samples do not mirror odd ones
    every = CensusJob.open(scene, **HOW, out=tmp_path / "every").run()
    job = CensusJob.open(scene, **HOW, gradients=2, out=tmp_path / "second")
    assert job.design.samples == (48, 16)
    second = job.run()
    assert np.array_equal(second.losses, every.losses)
    for one, other in zip(second.slices, every.slices, strict=True):
        assert one.measures == other.measures
        assert one.measures[MEASURES.index("cosine")] is not None
    assert second.gradients == 2
    with pytest.raises(ValueError, match="gradients"):
        CensusJob.open(scene, **HOW, out=tmp_path / "second")


def test_gradients_are_at_three_samples_along_each_axis_and_more(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"to a third of the resolution, 2; got 3"):
        CensusJob.open(SCENE, **HOW, gradients=3, out=tmp_path / "made")


def test_slices_surveyed_abreast_are_those_surveyed_alone_in_fewer_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = replace(SCENE, name="levy")
    env, asked = scene.make(), list[int]()
    design = CensusDesign.draw(env.space, 4, along="pairs", resolution=8, seed=0)
    group = [(f"slice-{number}", design.plane(*place)) for number, place in enumerate(design.places)]
    how = partial(survey, deviation=0.0, seed=0, gradients=2)
    alone = [module._survey(env, [one], how)[0] for one in group]
    evaluate = type(env).evaluate

    def count(self: Environment, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        asked.append(len(x))
        return evaluate(self, x, grad=grad)

    monkeypatch.setattr(type(env), "evaluate", count)
    together = module._survey(env, group, how)
    batches, asked[:] = len(asked), []
    for one in group:
        module._survey(env, [one], how)
    assert [piece for piece, _ in together] == [piece for piece, _ in group]
    assert batches < len(asked) / 3
    for (_, found), (_, wanted) in zip(together, alone, strict=True):
        same = set(wanted) - {"episodes"}  # of which each slice has an even share
        assert all(np.array_equal(found[key], wanted[key], equal_nan=found[key].dtype.kind == "f") for key in same)
    sums = [sum(int(one["episodes"]) for _, one in pieces) for pieces in (together, alone)]
    assert sums[0] == sums[1]


def test_what_a_slice_raises_ends_all_of_its_group() -> None:
    env = SCENE.make()
    design = CensusDesign.draw(env.space, 4, along="pairs", resolution=8, seed=0)
    group = [(f"slice-{number}", design.plane(*place)) for number, place in enumerate(design.places)]
    with pytest.raises(TypeError, match="deviation"):
        module._survey(env, group, partial(survey, seed=0))
