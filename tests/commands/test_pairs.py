"""`landscape pairs`: what it prints, keeps and refuses."""

import json
from pathlib import Path

from ..command import Run


def test_pairs_prints_the_command_that_slices_the_first(run: Run, tmp_path: Path) -> None:
    how = ["pairs", "rastrigin", "--set", "dim=3", "--samples", "8", "--top", "2"]
    done = run.ok(*how, "--json")
    report = done.json
    scores = [one["score"] for one in report["pairs"]]
    assert len(scores) == 3  # of which two are shown
    assert scores == sorted(scores, reverse=True)
    assert report["episodes"] == 8 * (1 + 5 * 3 + 3)
    first = " ".join(map(str, report["pairs"][0]["dims"]))
    assert f"landscape slice rastrigin --dims {first} --fidelity exact --set dim=3" in done.stderr
    shown = run(*how)
    assert "152 episodes" in shown.stdout
    assert len(json.loads((tmp_path / report["folder"] / "pairs.json").read_text())["pairs"]) == 3
