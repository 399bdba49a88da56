"""benchmarks/base_points.py: the point through which a figure's losses come nearest to the paper's."""

from pathlib import Path

import pytest
import torch
from benchmarks.base_points import Candidate, distance, main, names_of, search, write_choice

import gradscape as gs
from gradscape.envs.pinball import Pinball
from gradscape.gallery.figures import Figure, read_figures
from gradscape.gallery.files import FIGURES
from gradscape.gallery.paper import read_paper
from gradscape.landscapes.storage.records import read_json

BOARD = Figure("board", "pinball-16", (13, 14), fidelity="draft")


def test_a_distance_is_in_widths_of_the_papers_range() -> None:
    assert distance((1.0, 5.0), (1.0, 5.0)) == 0
    assert distance((0.0, 7.0), (1.0, 5.0)) == pytest.approx(3 / 4)


def test_the_nearest_comes_first_and_its_losses_are_those_of_its_slice(tmp_path: Path) -> None:
    env, paper = gs.make("pinball-16", fidelity="draft", device="cpu"), (0.3, 6.8)
    found = search(BOARD, env, 4, 6, paper)
    assert {one.through for one in found} == set(names_of(env, 6)) == {
        "center", *(f"example:{name}" for name in env.examples), *(f"random:{n}" for n in range(1, 7))
    }  # fmt: skip
    assert [one.distance for one in found] == sorted(one.distance for one in found)
    best = found[0]
    cut = gs.slice(env, (13, 14), through=best.through, resolution=4, gradients=False, out=tmp_path / "cut")
    loss = cut.data["loss"]
    assert (best.lowest, best.highest) == (pytest.approx(float(loss.min())), pytest.approx(float(loss.max())))
    assert best.distance == distance((best.lowest, best.highest), paper)


def test_a_point_where_a_tenth_fails_is_never_taken() -> None:
    loss, failed = torch.arange(10.0), torch.zeros(10, dtype=torch.bool)
    assert Candidate.of("center", loss, failed, (0.0, 9.0)).distance == 0
    failed[3] = True
    one = Candidate.of("center", loss, failed, (0.0, 9.0))
    assert one.distance == float("inf")
    assert one.record() == {"through": "center", "lowest": None, "highest": None, "failed": 0.1, "distance": None}


def test_what_was_found_is_kept_and_written_into_the_list(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = tmp_path / "figures.toml"
    figures.write_text(FIGURES.read_text())
    out = tmp_path / "kept"
    how = ["--resolution", "2", "--random", "3", "--fidelity", "draft", "--device", "cpu", "--figures", str(figures)]
    assert main(["pinball-16-13-14", "pinball-2", "bounce-x", *how, "--out", str(out), "--write"]) == 0
    said = capsys.readouterr().out
    assert "pinball-2-0-1: it varies all parameters" in said
    assert "bounce-x: the paper has no colour bar of bounce" in said
    best = read_json(out / "pinball-16-13-14.json")["candidates"][0]
    before, after = ({one.id: one for one in read_figures(path)} for path in (FIGURES, figures))
    board = after.pop("pinball-16-13-14")
    assert board.through == best["through"]
    assert board.searched["losses"] == [round(best["lowest"], 4), round(best["highest"], 4)]
    assert tuple(board.searched["paper"]) == read_paper().words["pinball-16"].losses
    assert after == {name: one for name, one in before.items() if name != "pinball-16-13-14"}
    monkeypatch.setattr("benchmarks.base_points.search", lambda *_: pytest.fail("searched again"))
    written = figures.read_text()
    assert main(["pinball-16-13-14", *how, "--out", str(out), "--write"]) == 0
    assert figures.read_text() == written
    monkeypatch.setattr(Pinball, "model_version", 99)
    with pytest.raises(pytest.fail.Exception, match="searched again"):
        main(["pinball-16-13-14", *how, "--out", str(out)])


def test_the_last_figure_of_a_list_can_be_written(tmp_path: Path) -> None:
    figures = tmp_path / "figures.toml"
    figures.write_text(
        '[[figure]]\nid = "a"\nenv = "fluid"\ndims = [0]\n\n[[figure]]\nid = "b"\nenv = "fluid"\ndims = [1]\n'
    )
    found = {"paper": [0, 1], "candidates": [{"through": "random:4", "lowest": 0.1, "highest": 0.9, "distance": 0.2}]}
    write_choice(figures, "b", found)
    assert [one.through for one in read_figures(figures)] == ["center", "random:4"]
    assert figures.read_text().endswith("}\n")
