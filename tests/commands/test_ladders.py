"""`landscape tradeoff --ladder`: what a choice of ladder takes, prints and refuses."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

import gradscape as gs
from gradscape.commands.tradeoff import LADDERS
from gradscape.envs import registry
from gradscape.landscapes import cost
from gradscape.landscapes.measures import fidelity, turns
from gradscape.landscapes.measures.model import ModelStudy
from gradscape.landscapes.storage.records import read_json

from ..command import Said
from ..parted import CLOCK, Parted

Command = Callable[..., Said]
TRADE = ["tradeoff", "parted", "--ladder", "model", "--points", "16", "--out", "parts"]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register the scene, and time it by its own clock in few rounds."""
    for module in (turns, cost):
        monkeypatch.setattr(module, "time", CLOCK)
    for name, value in (("ROUNDS", 3), ("LASTING", 0.0), ("ENOUGH", 0.0)):
        monkeypatch.setattr(turns, name, value)
    monkeypatch.setattr(fidelity, "RESAMPLES", 99)
    monkeypatch.setitem(registry.entries(), "parted", registry.Entry("parted", Parted))


@pytest.mark.drawn
def test_the_parts_of_a_model_are_printed_drawn_and_kept(run: Command, tmp_path: Path) -> None:
    done = run(*TRADE, "--json", "--figure-width-mm", "85", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert {**read_json(tmp_path / "parts/model.json"), "folder": "parts"} == report
    for file, begins in (("model.png", b"\x89PNG"), ("model-85mm.pdf", b"%PDF")):
        assert (tmp_path / "parts" / file).read_bytes().startswith(begins)
    for said in (
        "parts that are missing, and what putting each in does",
        "paint, no paint: moves nothing beyond the noise; saves time",
        "wind, no wind: changes the order; costs nothing measurable",
        "tough glass, glass that breaks: fails where the full model does not; costs nothing measurable",
        "refused: tank: parted needs its tank",
        "-50% (-50:-50)",
    ):
        assert said in done.stderr
    assert "about " in done.stderr.partition("parts of the model to measure")[2]  # the estimate comes first
    again = run(*TRADE, cwd=tmp_path)
    assert "0 parts" not in again.stderr
    assert "6 are there already" in again.stderr  # those that are refused are tried again


def test_the_front_door_has_the_same_ladder(tmp_path: Path) -> None:
    found = gs.tradeoff(Parted, ladder="model", points=16, out=tmp_path / "parts")
    assert isinstance(found, ModelStudy)
    assert found.record() == read_json(tmp_path / "parts/model.json")
    assert "ladder='model'" in found.command
    with pytest.raises(ValueError, match="--variants goes with --ladder fidelity"):
        gs.tradeoff(Parted, ladder="model", variants=("dt",))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["bounce", "--ladder", "dt"], f"--ladder takes {', '.join(LADDERS)}; got 'dt'"),
        (["parted", "--ladder", "model", "--variants", "dt"], "--variants goes with --ladder fidelity"),
        (["bounce", "--fidelity", "draft"], "got --fidelity draft, leave it out"),
        (["branin", "--ladder", "model"], "branin names no parts of its model"),
    ],
)
def test_what_a_ladder_does_not_take_is_refused(arguments: list[str], said: str, run: Command, tmp_path: Path) -> None:
    done = run("tradeoff", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert not list(tmp_path.iterdir())
