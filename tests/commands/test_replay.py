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
