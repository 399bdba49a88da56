"""`landscape report`: what it prints, leaves, refuses and goes on from."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from gradscape import measure_report
from gradscape.envs.registry import entries
from gradscape.gallery.figures import read_figures
from gradscape.gallery.words import paper_words

from .command import Said

Run = Callable[..., Said]


@pytest.fixture
def cut(run: Run, tmp_path: Path) -> Path:
    run("slice", "branin", "--dims", "0", "1", "--resolution", "24", "--out", "cut", cwd=tmp_path)
    return tmp_path / "cut"


def test_a_slice_is_reported_in_numbers_and_words(run: Run, cut: Path, tmp_path: Path) -> None:
    done = run("report", "cut", "--points", "2", "--out", "told", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert record == {**json.loads((tmp_path / "told/report.json").read_text()), "folder": "told"}
    assert record["losses"]["notable"] == 3  # Branin's minima
    assert record["verdict"]["words"] == ["smooth with local minima", "gradients good"]
    assert record["noise"]["again"] == record["noise"]["batch"] == 0
    assert record["paper"] is None
    assert "with gradients: about" in done.stderr
    named = json.loads((tmp_path / "told/measures.json").read_text())
    assert named["Local minima deeper than 1 % of the range"] == "3"
    assert (tmp_path / "told/gradient-quality.png").read_bytes().startswith(b"\x89PNG")
    again = run("report", "cut", "--points", "2", "--out", "told", cwd=tmp_path)
    assert "there already" in again.stderr
    assert "smooth with local minima: minima deeper than 1 % of the range: 3" in again.stdout
    other = run("report", "cut", "--points", "3", "--out", "told", cwd=tmp_path)
    assert other.returncode == 2
    assert "holds a report of other settings" in other.stderr


def test_an_environment_without_figures_is_sampled_first(run: Run, tmp_path: Path) -> None:
    done = run("report", "beale", "--points", "2", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert record["env"] == "beale"
    assert (tmp_path / record["folder"] / "report.json").exists()
    assert "576 episodes with gradients to compute" in done.stderr


def test_all_makes_a_table_with_the_papers_words(run: Run, tmp_path: Path) -> None:
    line = ("bounce", "--axis", "x", "--resolution", "20", "--out", "data/bounce-x")
    plane = ("slice", "pinball-2", "--dims", "0", "1", "--resolution", "5", "--out", "data/pinball-2-0-1")
    for cut in (line, plane):
        run(*cut, "--fidelity", "draft", "--device", "cpu", cwd=tmp_path)
    command = ("report", "--all", "--data", "data", "--points", "2", "--out", "all", "--device", "cpu")
    done = run(*command, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert [record["name"] for record in summary["reports"]] == ["bounce-x", "pinball-2-0-1"]
    assert summary["environments"]["pinball-2"]["slices"] == 1
    assert set(summary["environments"]["pinball-2"]["paper"]) == set(paper_words()["pinball-2"].words)
    table = (tmp_path / "all/report.md").read_text().splitlines()
    assert len({line.count("|") for line in table}) == 1
    assert table[2].startswith("| bounce-x |")
    shutil.rmtree(tmp_path / "all/pinball-2-0-1")
    again = run(*command, cwd=tmp_path)
    assert "all/bounce-x is there already" in again.stderr
    assert (tmp_path / "all/pinball-2-0-1/report.json").exists()
    assert "pinball-2-0-1" in again.stdout


def test_a_stopped_report_says_what_is_kept(
    run: Run, cut: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(measure_report, "_character", stop)
    done = run("report", "cut", "--out", "told", cwd=tmp_path)
    assert done.returncode == 130
    assert "stopped: 0 of 1 reports are kept" in done.stderr


def test_a_slice_of_other_code_is_reported_with_a_warning(
    run: Run, cut: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = measure_report.identity_of
    monkeypatch.setattr(measure_report, "identity_of", lambda env: {**ours(env), "code": "changed"})
    done = run("report", "cut", "--points", "2", "--out", "told", cwd=tmp_path)
    assert "warning: cut was sampled otherwise (code" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "a slice's folder, an environment, or --all"),
        (["branin", "--all"], "a slice's folder, an environment, or --all"),
        (["brannin"], "did you mean branin?"),
        (["--all", "--data", "nowhere"], "holds no figures yet"),
        (["branin", "--points", "1"], "--points"),
    ],
)
def test_bad_input_is_refused(run: Run, tmp_path: Path, arguments: list[str], said: str) -> None:
    done = run("report", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr


def test_a_slice_without_gradients_is_refused(run: Run, tmp_path: Path) -> None:
    run("slice", "branin", "--dims", "0", "1", "--resolution", "5", "--no-gradients", "--out", "cut", cwd=tmp_path)
    done = run("report", "cut", cwd=tmp_path)
    assert done.returncode == 2
    assert "cut: report needs a slice with gradients" in done.stderr


def test_a_folder_of_other_files_is_left_alone(run: Run, cut: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("precious")
    done = run("report", "cut", "--out", "mine", cwd=tmp_path)
    assert done.returncode == 2
    assert "holds other files" in done.stderr


def test_the_paper_is_quoted_on_every_environment_it_shows() -> None:
    said = paper_words()
    assert set(said) <= set(entries())
    assert {figure.env for figure in read_figures()} <= set(said)
