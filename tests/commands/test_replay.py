"""`landscape replay` and `landscape surface`: what they leave and refuse."""

import json
from pathlib import Path

import pytest

from ..command import Run


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def test_the_best_episode_of_a_run_is_replayed(run: Run) -> None:
    run.ok("optimize bounce --method random --budget 8 --out r --device cpu")
    run.ok("replay bounce --params best:r --no-film --out e --device cpu")
    assert names(Path("e")) == ["episode.json", "episode.png", "episode.rrd"]
    best = json.loads(Path("r/summary.json").read_text())
    record = json.loads(Path("e/episode.json").read_text())
    assert record["status"] == "OK"
    assert f"{record['loss']:.6g}" in json.dumps(best) or record["loss"] == pytest.approx(best["best"]["loss"])
    assert record["provenance"]["command"].startswith("landscape replay bounce --params best:r")


@pytest.mark.drawn
def test_a_slice_with_a_run_becomes_a_surface(run: Run) -> None:
    run.ok("slice bounce --dims 0 1 --resolution 5 --out cut --device cpu")
    run.ok("optimize bounce --method random --budget 4 --out r --device cpu")
    run.ok("surface cut r --out s")
    assert names(Path("s")) == ["surface.gltf", "surface.png"]
    run.ok("surface cut")
    assert len(list(Path("out").glob("surface-bounce-*"))) == 1
