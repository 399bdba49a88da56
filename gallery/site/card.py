"""The page of the report card: what is measured of the gradients of several engines."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path

from ...landscapes.convert import from_json
from ...landscapes.measures.card import Card
from ...landscapes.storage.records import read_json, reading
from ..files import CARD, CARD_PICTURE, CARD_RECORD
from .downloads import save_table
from .studio import Studio

CARD_TABLE = "card.csv"
REMAKE = "delete it, and `landscape card --out {}` measures it anew"


def place_card(data: Path, out: Path, studio: Studio) -> Card | None:
    """Copy the report card of the figures' data into the site, and return it; None where there is none."""
    source, target = data / CARD, out / CARD
    if not (source / CARD_RECORD).exists() or not (source / CARD_PICTURE).exists():
        return None
    with reading(source / CARD_RECORD, REMAKE.format(source)):
        card = from_json(Card, read_json(source / CARD_RECORD))
    target.mkdir()
    for name in (CARD_RECORD, CARD_PICTURE):
        shutil.copyfile(source / name, target / name)
    studio.develop(source / CARD_PICTURE, target / CARD_PICTURE)
    save_table([asdict(one) for one in card.grades], target / CARD_TABLE)
    return card
