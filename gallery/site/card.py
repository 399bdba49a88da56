"""The page of the report card: what is measured of the gradients of several engines."""

from __future__ import annotations

import shutil
from pathlib import Path

from ...landscapes.measures.card import Card
from ...landscapes.storage.records import read_json, reading
from ..files import CARD, CARD_PICTURE, CARD_RECORD, dark_name

REMAKE = "delete it, and `landscape card --out {}` measures it anew"


def place_card(data: Path, out: Path) -> Card | None:
    """Copy the report card of the figures' data into the site, and return it; None where there is none."""
    from ...landscapes.draw.figures.dark import save_dark

    source, target = data / CARD, out / CARD
    if not (source / CARD_RECORD).exists() or not (source / CARD_PICTURE).exists():
        return None
    with reading(source / CARD_RECORD, REMAKE.format(source)):
        card = Card.of_record(read_json(source / CARD_RECORD))
    target.mkdir()
    for name in (CARD_RECORD, CARD_PICTURE):
        shutil.copyfile(source / name, target / name)
    save_dark(source / CARD_PICTURE, target / dark_name(CARD_PICTURE))
    return card
