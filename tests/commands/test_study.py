"""`landscape study`: what a kind of study takes, prints and refuses."""

from pathlib import Path

import pytest

import gradscape as gs
from gradscape.envs import registry
from gradscape.landscapes import cost
from gradscape.landscapes.storage.records import read_json
from gradscape.studies import samples

from ..command import Run
from ..parted import CLOCK, Parted

TRADE = ["study", "model", "parted", "--points", "16", "--out", "parts"]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register the scene, and time it by its own clock in few rounds."""
    for module in (samples, cost):
        monkeypatch.setattr(module, "time", CLOCK)
    for name, value in (("MIN_ROUNDS", 3), ("MIN_SECONDS", 0.0), ("BATCH_SECONDS", 0.0), ("RESAMPLES", 99)):
        monkeypatch.setattr(samples, name, value)
    monkeypatch.setitem(registry.entries(), "parted", registry.Entry("parted", Parted))


@pytest.mark.drawn
def test_the_parts_of_a_model_are_printed_drawn_and_kept(run: Run, tmp_path: Path) -> None:
    done = run.ok(*TRADE, "--json", "--figure-width-mm", "85")
    report = done.json
    assert {**read_json(tmp_path / "parts/model.json"), "folder": "parts"} == report
    for file, begins in (("model.png", b"\x89PNG"), ("model-85mm.pdf", b"%PDF")):
        assert (tmp_path / "parts" / file).read_bytes().startswith(begins)
    for said in (
        "missing parts, and the effect of adding each",
        "paint, no paint: moves nothing beyond the noise; saves time",
        "wind, no wind: changes the order; costs nothing measurable",
        "tough glass, glass that breaks: fails where the full model does not; costs nothing measurable",
        "refused: tank: parted needs its tank",
        "-50% (-50:-50)",
    ):
        assert said in done.stderr
    assert "about " in done.stderr.partition("models to measure")[2]  # the estimate comes first
    again = run(*TRADE)
    assert "0 models" not in again.stderr
    assert "8 are done already" in again.stderr  # those that are refused are tried again


@pytest.mark.parametrize(("name", "kind"), [("tradeoff", "fidelity"), ("extremes", "extremes")])
def test_a_former_function_names_the_present_one(name: str, kind: str) -> None:
    with pytest.raises(AttributeError, match=f"gradscape.{name} is now gradscape.study.'{kind}'"):
        getattr(gs, name)
