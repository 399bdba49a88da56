"""What the paper says: of environments, methods and slices that there are, in the words for landscapes."""

from collections.abc import Callable
from pathlib import Path

import pytest

from gradscape.envs.registry import entries
from gradscape.gallery.figures import read_figures
from gradscape.gallery.files import PAPER
from gradscape.gallery.paper import ABSENT, PaperCaption, read_paper
from gradscape.optim.claims import Claims
from gradscape.optim.registry import methods

from ..command import Said

WHOLE = read_paper()


def test_the_paper_is_quoted_on_every_environment_that_the_gallery_shows() -> None:
    assert set(WHOLE.words) <= set(entries())
    assert {figure.env for figure in read_figures()} <= set(WHOLE.words)


def test_claims_are_about_methods_and_environments_that_exist() -> None:
    assert WHOLE.claims.keys() <= entries().keys()
    claims = [claim for one in WHOLE.claims.values() for claim in one]
    assert {name for claim in claims for name in (claim.first, claim.second)} < set(methods())
    assert all(claim.source for claim in claims)


def test_of_an_environment_there_are_claims_or_a_reason_why_there_are_none() -> None:
    assert WHOLE.claims.keys().isdisjoint(WHOLE.silences)
    assert set(WHOLE.words) == set(WHOLE.claims) | set(WHOLE.silences)
    assert "limitation" in str(WHOLE.claims_about("flip").silence)
    assert WHOLE.claims_about("branin") == Claims((), ABSENT)
    assert WHOLE.claims_about("fluid").silence is None


def test_claims_of_several_entries_stand_in_their_order() -> None:
    assert [str(claim) for claim in WHOLE.claims_about("pinch").claims] == [
        "bo-leap better than descents", "bo-leap better than bo-descents", "bo-leap and cma-es alike"
    ]  # fmt: skip


def test_captions_are_of_slices_that_the_gallery_shows_and_all_of_them() -> None:
    assert set(WHOLE.captions) == {figure.id for figure in read_figures()}
    assert WHOLE.caption_of("fluid-0-1").number == 10
    assert WHOLE.caption_of("mine") == PaperCaption()


def test_a_word_that_no_landscape_is_described_in_is_refused(tmp_path: Path) -> None:
    text = PAPER.read_text().replace('words = ["discontinuous"]', 'words = ["bumpy"]')
    (tmp_path / "paper.toml").write_text(text)
    with pytest.raises(ValueError, match=r"bounce has words \['bumpy'\]; the words are "):
        read_paper(tmp_path / "paper.toml")


def test_an_environment_s_description_quotes_the_paper(run: Callable[..., Said], tmp_path: Path) -> None:
    said = " ".join(run("envs", "pinball-2", cwd=tmp_path).stdout.split())
    assert (
        "the paper says: rugged, large flat regions, discontinuous, gradients zero (A.1.2, and B.2 for rugged)" in said
    )
    assert "losses from 0.4 to 8.5 in its slices" in said
