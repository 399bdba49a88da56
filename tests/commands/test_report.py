"""`landscape report`: what it prints, leaves, refuses and continues from."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gradscape.envs.functions import Function
from gradscape.gallery.files import DATA
from gradscape.gallery.paper import read_paper
from gradscape.jobs import report as job
from gradscape.jobs.report import PaperWords, Report, environments_markdown
from gradscape.landscapes.convert import from_json
from gradscape.landscapes.measures.discontinuities import Jump, Jumps
from gradscape.landscapes.measures.following import Following, ScaleCosine
from gradscape.landscapes.statistics import Estimate, exactly
from gradscape.landscapes.storage.records import read_json, write_record

from ..command import Run, make


@pytest.fixture(scope="module")
def sampled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a slice of Branin's function."""
    return make(tmp_path_factory.mktemp("sampled"), "slice branin --dims 0 1 --resolution 24 --out cut")


@pytest.fixture
def cut(sampled: Path, tmp_path: Path) -> Path:
    return shutil.copytree(sampled / "cut", tmp_path / "cut")


@pytest.mark.drawn
def test_a_slice_is_reported_in_numbers_and_words(run: Run, cut: Path, tmp_path: Path) -> None:
    done = run.ok("report cut --points-per-axis 2 --out told --json")
    record = done.json
    assert record == {**read_json(tmp_path / "told/report.json"), "folder": "told"}
    assert record["profile"]["losses"]["notable"] == 3  # Branin's minima
    assert record["profile"]["verdict"]["words"] == ["smooth with local minima", "gradients follow"]
    assert record["profile"]["noise"]["again"] == record["profile"]["noise"]["batch"] == 0
    assert record["paper"] is None
    assert "with gradients: about" in done.stderr
    assert re.search(r"s, plus 1\.0 s to measure 576 samples; [\d.]+ [MG]B of memory\n", done.stderr)
    named = read_json(tmp_path / "told/measures.json")
    assert named["Local minima deeper than 1 % of the range"] == "3"
    assert (tmp_path / "told/gradient-quality.png").read_bytes().startswith(b"\x89PNG")
    file = tmp_path / "told/report.json"
    write_record(file, {**read_json(file), "device": "cuda"})
    again = run("report cut --points-per-axis 2 --out told")
    assert "told: the report exists already, measured on cuda" in again.stderr
    assert "smooth with local minima: 3 minima and " in again.stdout
    assert "a loss at every sample\n" in again.stdout
    run.refuse("report cut --points-per-axis 3 --out told", said="contains another report (points 2 there, 3 now)")


def test_a_stopped_report_says_what_is_kept_and_that_the_slice_is_of_another_model(
    run: Run, cut: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(job, "measure", stop)
    monkeypatch.setattr(Function, "model_version", 99)
    done = run("report cut --out told")
    assert done.returncode == 130
    assert "stopped: 0 of 1 reports are kept" in done.stderr
    assert "warning: cut was sampled differently (model_version 1 then, 99 now" in done.stderr


def test_features_over_all_parameters_are_added_to_a_report_that_is_there(run: Run, cut: Path, tmp_path: Path) -> None:
    words = "report cut --points-per-axis 2 --out told"
    first = run.json(words)
    assert first["features"] is None
    without, planned = (run.json(f"plan {words}{more}") for more in ("", " --features"))
    assert (planned["gradients"] - without["gradients"], planned["episodes"] - without["episodes"]) == (100, 612)
    done = run.ok(f"{words} --features")
    assert "features over all 2 parameters: 512 episodes and 100 with gradients: about" in done.stderr
    assert re.search(r"Explained by a linear model +│ 19 ± 23 %", done.stdout)
    kept = read_json(tmp_path / "told/report.json")
    assert kept["profile"] == first["profile"]
    assert kept["features"]["points"] == 100
    assert kept["features"]["exploratory"]["ela_meta"]["quad_w_interact_adj_r2"] == pytest.approx(0.98, abs=0.01)
    again = run.ok(f"{words} --features")
    assert "episodes" not in again.stderr
    assert "Explained by a linear model" in again.stdout


def test_an_environment_without_figures_is_sampled_first(run: Run, tmp_path: Path) -> None:
    done = run.ok("report beale --points-per-axis 2 --json")
    record = done.json
    assert record["env"] == "beale"
    assert (tmp_path / record["folder"] / "report.json").exists()
    assert "576 episodes with gradients to compute" in done.stderr


def test_all_makes_a_table_with_the_papers_words(run: Run, tmp_path: Path) -> None:
    line = ("bounce", "--axis", "x", "--resolution", "20", "--out", "data/bounce-x")
    plane = ("slice", "pinball-2", "--dims", "0", "1", "--resolution", "5", "--out", "data/pinball-2-0-1")
    for cut in (line, plane):
        run(*cut, "--fidelity", "draft", "--device", "cpu")
    command = ("report", "--all", "--data", "data", "--points-per-axis", "2", "--out", "all", "--device", "cpu")
    summary = run.json(*command)
    assert [record["name"] for record in summary["reports"]] == ["bounce-x", "pinball-2-0-1"]
    assert summary["environments"]["pinball-2"]["slices"] == 1
    assert set(summary["environments"]["pinball-2"]["paper"]) == set(read_paper().words["pinball-2"].words)
    table = (tmp_path / "all/report.md").read_text().splitlines()
    assert len({line.count("|") for line in table}) == 1
    assert table[2].startswith("| bounce-x |")
    shutil.rmtree(tmp_path / "all/pinball-2-0-1")
    again = run(*command)
    assert "all/bounce-x: the report exists already" in again.stderr
    assert (tmp_path / "all/pinball-2-0-1/report.json").exists()
    assert "pinball-2-0-1" in again.stdout
    measured = environments_markdown([from_json(Report, record) for record in summary["reports"]]).splitlines()
    assert len({line.count("|") for line in measured}) == 1
    assert measured[3].startswith("| `pinball-2` | 1 |")


def test_one_slice_that_fails_does_not_lose_the_others(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("bounce-x", "bounce-y"):  # quick ones, in the places of figures
        run("slice", "branin", "--dims", "0", "1", "--resolution", "4", "--out", f"data/{name}")
    measure, calls = job.measure, iter((True, False))

    def failing(*parts: Any) -> object:
        if next(calls):
            raise RuntimeError("out of\nmemory")
        return measure(*parts)

    monkeypatch.setattr(job, "measure", failing)
    command = ("report", "--all", "--data", "data", "--points-per-axis", "2", "--out", "all")
    done = run(*command, "--json")
    assert done.returncode == 1
    assert "not reported: bounce-x: RuntimeError: out of memory" in done.stderr.splitlines()
    summary = done.json
    assert [record["name"] for record in summary["reports"]] == ["bounce-y"]
    assert list(summary["failed"]) == ["bounce-x"]
    monkeypatch.setattr(job, "measure", measure)
    again = run.ok(*command)
    assert "all/bounce-y: the report exists already" in again.stderr
    assert "bounce-x" in again.stdout


def test_a_report_beside_its_slice_is_copied_unless_it_is_another(run: Run, cut: Path, tmp_path: Path) -> None:
    run("report cut --points-per-axis 2 --out told")
    for file in (tmp_path / "told").iterdir():
        shutil.copyfile(file, cut / file.name)
    same = run("report cut --points-per-axis 2 --out same")
    assert "same: the report is copied from cut" in same.stderr
    assert "episodes" not in same.stderr
    for file in (tmp_path / "told").iterdir():
        assert (tmp_path / "same" / file.name).read_bytes() == file.read_bytes()
    other = run("report cut --points-per-axis 3 --out other")
    assert "copied" not in other.stderr
    assert json.loads((tmp_path / "other/report.json").read_text())["key"]["points"] == 3


def judged(known: Report, minima: float, cosine: float, jump: float, word: str | None) -> Report:
    """Return a report with other numbers, held against words of the paper's."""
    interval, one = Estimate(cosine, cosine, cosine), exactly(0.0)
    scales = tuple(ScaleCosine(scale, scale, 36, 36, interval, (0.0, 0.0, 0.0), one) for scale in (0.01, 0.05))
    jumps = Jumps((Jump((0.0, 0.0), jump, None),) if jump else (), 0.02, 2.0, 24, 1, 24, 0, 0, 0, 1, 0, 20)
    surface = replace(
        known.profile.verdict.surface, minima=exactly(minima), turns=(exactly(1.5), exactly(minima / 2)),
        level=exactly(0.0), word=word, at_least=False,
    )  # fmt: skip
    following = Following(scales, 36, one, one, one, one)
    verdict = replace(known.profile.verdict, surface=surface, jumps=jumps, following=following)
    paper = PaperWords(verdict.compare_words(("rugged", "gradients follow")), "")
    return replace(known, profile=replace(known.profile, verdict=verdict), paper=paper)


def test_a_row_of_an_environment_spans_its_slices_and_says_whether_the_paper_agrees() -> None:
    known = Report.read(DATA / "fluid-8-9")
    two = [judged(known, 2, 0.75, 0.0, "rugged"), judged(known, 12, 0.95, 0.5, "rugged")]
    row = environments_markdown(two).splitlines()[2]
    assert row == (
        "| `fluid` | 2 | 2 to 12 | 1.5 to 6.0 | 0 to 25 % | 0.75 to 0.95 | 0.75 to 0.95 | "
        "rugged, discontinuous (1 of 2), gradients follow (1 of 2), gradients follow loosely (1 of 2) | "
        "rugged, gradients follow (1 of 2) | in part |"
    )
    assert environments_markdown(two[1:]).endswith("| yes |\n")
    assert environments_markdown([judged(known, 0, 0.0, 0.0, None)]).endswith("| no |\n")


@pytest.mark.parametrize("cut", [["rastrigin", "--set", "dim=5"], ["branin"]])
def test_a_function_whose_box_is_its_own_is_asked_beyond_it(run: Run, cut: list[str]) -> None:
    run.ok("slice", *cut, "--dims", "0", "1", "--resolution", "12", "--out", "cut")
    report = run.json("report cut --out told")
    beyond = report["profile"]["beyond_the_box"]
    assert beyond["cut"] == 0 < beyond["asked"]
