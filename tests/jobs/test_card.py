"""The report card as a study: who is in it, what it leaves, how it continues."""

import json
from pathlib import Path

import pytest

import gradscape as gs
from gradscape.envs.registry import entries
from gradscape.jobs import card
from gradscape.jobs.card import ENTRANTS, CardJob

CONTROL = "control"


def test_every_engine_of_the_card_is_registered_and_has_a_name_of_its_own() -> None:
    assert {one.env for one in ENTRANTS} <= set(entries())
    assert len({one.name for one in ENTRANTS}) == len(ENTRANTS)
    ours = {one.scene for one in ENTRANTS if not entries()[one.env].extra}
    assert {"bounce", "chain"} <= ours  # on the same terms
    extras = {entry.extra for entry in entries().values()} - {""}
    assert {entries()[one.env].extra for one in ENTRANTS} >= extras


@pytest.mark.drawn
def test_what_is_known_to_be_right_passes(tmp_path: Path) -> None:
    found = gs.card([CONTROL], resolution=5, out=tmp_path / "card")
    (grade,) = found.grades
    assert (grade.outcome, grade.scene) == ("passes", CONTROL)
    assert grade.versions["gradscape"] == gs.__version__
    assert found.slices[0].loss.shape == (5, 5)
    record = json.loads((tmp_path / "card/card.json").read_text())
    assert record["grades"][0]["check"] == "landscape check branin --points 3"
    assert (tmp_path / "card/card.png").stat().st_size > 1000


def test_it_goes_on_from_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = gs.card([CONTROL], resolution=5, out=tmp_path)
    monkeypatch.setattr(card, "_measure", None)
    assert gs.card([CONTROL], resolution=5, out=tmp_path).grades == first.grades


def test_an_engine_that_is_not_installed_is_said_to_be_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(card, "installs", lambda entry: "pip install 'gradscape[mjx]'" if entry.extra else "")
    found = CardJob.open(["drop"], out=tmp_path).run()
    assert {one.outcome for one in found.grades} == {"not installed"}
    assert found.grades[0].finding == "pip install 'gradscape[mjx]'"
    assert not found.slices


def test_a_scene_that_the_card_does_not_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"the card has no scene 'fall'; it has control, flight, drop"):
        CardJob.open(["fall"], out=tmp_path / "none")
    assert not (tmp_path / "none").exists()
