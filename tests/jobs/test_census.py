"""`landscape census` and `gs.census`: what they leave, go on from, and refuse."""

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gradscape as gs
from gradscape.jobs import census as module
from gradscape.jobs.census import CensusJob, open_census
from gradscape.jobs.scene import SceneSpec
from gradscape.landscapes.measures.census import MEASURES
from gradscape.landscapes.storage.records import read_json

from ..command import Said

HOW = {"slices": 4, "resolution": 8}
SCENE = SceneSpec("ackley", device="cpu", options={"dim": 3})


@pytest.mark.drawn
def test_a_census_is_written_read_and_drawn(tmp_path: Path) -> None:
    found = CensusJob.open(SCENE, **HOW, out=tmp_path / "made").run()
    assert found.losses.shape == (4, 8, 8)
    assert list(found.table().index) == list(MEASURES)
    assert sorted(found.order) == [0, 1, 2, 3]
    assert found.words["gradients noisy"].value + found.words["gradients good"].value == 1
    again = open_census(tmp_path / "made")
    assert (
        again.record()
        == found.record()
        == {name: value for name, value in read_json(tmp_path / "made/census.json").items() if name != "checksum"}
    )
    assert (tmp_path / "made/census.png").read_bytes().startswith(b"\x89PNG")


def test_a_stopped_census_goes_on_with_the_next_slice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = CensusJob.open(SCENE, **HOW, out=tmp_path / "whole").run()
    surveyed, survey = [], module._survey

    def stop_at_the_third(*args: object) -> object:
        if len(surveyed) == 2:
            raise KeyboardInterrupt
        surveyed.append(args[1])
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
    with pytest.raises(ValueError, match="so it takes 6 along an axis; got 4"):
        CensusJob.open(SCENE, slices=4, resolution=4)
    CensusJob.open(SCENE, **HOW, out=tmp_path / "made")
    with pytest.raises(ValueError, match="resolution: wanted 9, found 8"):
        CensusJob.open(SCENE, slices=4, resolution=9, out=tmp_path / "made")


def test_the_verb_and_python_say_the_same(run: Callable[..., Said], tmp_path: Path) -> None:
    said = run(
        *[
            "census",
            "ackley",
            "--set",
            "dim=3",
            "--slices",
            "4",
            "--resolution",
            "8",
            "--device",
            "cpu",
            "--out",
            "made",
            "--json",
        ],
        cwd=tmp_path,
    )
    assert said.returncode == 0, said.stderr
    assert "slices that it fits" in said.stderr
    found = gs.census("ackley", slices=4, resolution=8, out=tmp_path / "called", device="cpu", options={"dim": 3})
    for name in ("slices", "words", "parts"):
        assert json.loads(said.stdout)[name] == found.record()[name]
