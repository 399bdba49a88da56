"""`landscape replay`: what it leaves and refuses."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from gradscape.cli import main


@pytest.fixture
def run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], tuple[int, str]]:
    monkeypatch.chdir(tmp_path)

    def command(text: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["landscape", *text.split()])
        with pytest.raises(SystemExit) as left:
            main(text.split())
        return int(left.value.code or 0), capsys.readouterr().err

    return command


def test_the_best_episode_of_a_run_is_replayed(run: Callable[[str], tuple[int, str]]) -> None:
    assert run("optimize bounce --method random --budget 8 --out r --device cpu")[0] == 0
    code, said = run("replay bounce --params best:r --no-film --out e --device cpu")
    assert code == 0, said
    assert sorted(file.name for file in Path("e").iterdir()) == ["episode.json", "episode.png", "episode.rrd"]
    best = json.loads(Path("r/summary.json").read_text())
    record = json.loads(Path("e/episode.json").read_text())
    assert record["status"] == "OK"
    assert f"{record['loss']:.6g}" in json.dumps(best) or record["loss"] == pytest.approx(best["best"]["loss"])
    assert record["provenance"]["command"].startswith("landscape replay bounce --params best:r")
    code, said = run("replay cartpole --params best:r --no-film --device cpu")
    assert code == 2
    assert "r holds no runs of cartpole" in said


def test_what_cannot_be_replayed_is_refused(run: Callable[[str], tuple[int, str]]) -> None:
    assert "ackley has no episode to draw" in run("replay ackley")[1]
    Path("full").mkdir()
    Path("full/notes.txt").write_text("")
    code, said = run("replay bounce --out full --device cpu")
    assert (code, "full holds other files" in said) == (2, True)
