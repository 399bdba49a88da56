"""The report card's own page: all of it is in the file, and it can be read on a screen and on a phone."""

import re
from pathlib import Path
from typing import Any

import pytest

from gradscape.landscapes.draw.pages.card import card_page, card_scenes

from .figures.records import card


def test_the_page_holds_all_it_shows() -> None:
    page = card_page(card())
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    assert not re.search(r"https?://|@import|url\(", page)
    assert all(said in page for said in ("sign", "22 to 46 %", "95 % of points: below 210 %", "speed x below 0.3"))
    assert len(page) < 40_000 * len(card().slices)  # panels of few colours


def test_panels_of_a_scene_share_their_scale_and_say_how_many_arrows_oppose() -> None:
    scenes = {one.name: one for one in card_scenes(card())}
    drop = scenes["drop"]
    assert (drop.low, drop.high, drop.unit) == ("0", "2", "m²")
    assert [bool(row.panel) for row in drop.rows] == [True, False]  # the second is not installed
    assert drop.rows[0].axes == ("speed x [m/s], 0 to 1", "speed y [m/s], 0 to 1")
    assert [row.opposing for row in scenes["flight"].rows] == ["100 %"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_it_can_be_read_wide_and_narrow_in_light_and_dark(
    browser: Any, tmp_path: Path, width: int, scheme: str
) -> None:
    (tmp_path / "card.html").write_text(card_page(card()), encoding="utf-8")
    page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page.goto((tmp_path / "card.html").as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    cells = page.evaluate(
        """() => Array.from(document.querySelectorAll('tbody th, tbody td')).filter((one) => one.textContent.trim())
            .map((one) => [one.getBoundingClientRect().width, one.scrollWidth - one.clientWidth])"""
    )
    assert len(cells) > 15
    assert all(wide >= 90 and hidden <= 0 for wide, hidden in cells)
    panels = page.evaluate(
        "Array.from(document.images).map((one) => [one.complete, one.naturalWidth, one.clientWidth])"
    )
    assert len(panels) == 3
    assert all(there and size == 360 and shown >= 120 for there, size, shown in panels)
    ground, ink = (page.evaluate(f"getComputedStyle(document.body).{name}") for name in ("backgroundColor", "color"))
    levels = [sum(map(int, re.findall(r"\d+", of)[:3])) / 3 for of in (ground, ink)]
    assert (levels[0] > levels[1]) == (scheme == "light")
    assert abs(levels[0] - levels[1]) > 180
    page.close()
