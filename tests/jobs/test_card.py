"""The report card as a study: who is in it, what it leaves, how it continues."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gradscape as gs
from gradscape.envs.registry import entries
from gradscape.jobs import card
from gradscape.jobs.card import ENTRANTS, CardJob, read_card

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
    assert (grade.verdict, grade.scene) == ("passes", CONTROL)
    assert grade.share is not None
    assert grade.share.judged >= 59
    assert grade.versions.keys() == {"gradscape", "torch"}
    assert grade.versions["gradscape"] == gs.__version__
    assert found.slices[0].loss.shape == (5, 5)
    record = json.loads((tmp_path / "card/card.json").read_text())
    assert record["grades"][0]["check"] == "landscape check branin"
    assert (tmp_path / "card/card.png").stat().st_size > 1000
    page = (tmp_path / "card/card.html").read_text()
    assert "src=" not in page.replace('src="data:', "")  # nothing from outside
    assert "0 % (0 to 6 %) of 64 points" in page
    again = read_card(tmp_path / "card/card.json")
    assert again.grades == found.grades
    assert again.slices[0].labels == found.slices[0].labels
    np.testing.assert_allclose(again.slices[0].slope, found.slices[0].slope, rtol=1e-6)


def test_it_continues_from_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = gs.card([CONTROL], resolution=5, out=tmp_path)
    monkeypatch.setattr(card, "_measure", None)
    assert gs.card([CONTROL], resolution=5, out=tmp_path).grades == first.grades


@pytest.mark.slow
def test_a_gradient_that_is_right_of_the_program_and_wrong_of_the_physics_is_told_by_the_closed_form(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = [one for one in ENTRANTS if one.env == "bounce-once"]
    job = replace(CardJob.open(["bounce once"], resolution=3, device="cpu", out=tmp_path), entrants=ours)
    found = {one.options["contacts"]: one for one in job.run().grades}
    assert {one.verdict for one in found.values()} == {"passes"}
    off = {how: one.closed_form for how, one in found.items()}
    assert off["touch"].median < 1e-12
    assert off["shift"].median < 1e-5
    assert off["step"].median > 1


def test_an_engine_that_is_not_installed_is_said_to_be_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(card, "installs", lambda entry: "pip install 'gradscape[mjx]'" if entry.extra else "")
    found = CardJob.open(["drop"], out=tmp_path).run()
    assert {one.verdict for one in found.grades} == {"not installed"}
    assert found.grades[0].finding == "pip install 'gradscape[mjx]'"
    assert not found.slices


def test_a_scene_that_the_card_does_not_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"the card has no scene 'fall'; it has control, flight, bounce once"):
        CardJob.open(["fall"], out=tmp_path / "none")
    assert not (tmp_path / "none").exists()
