"""The verdict on a page: the measured words next to those of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ...measures.verdict import WORDS, QuotedWord, Verdict


@dataclass(frozen=True)
class Word:
    """A word that was measured, or that the `paper` uses; `measured` is None if that is not resolved."""

    word: str
    measured: bool | None
    reason: str
    paper: bool

    @property
    def comparison(self) -> str:
        """How the paper's word compares."""
        if not self.paper:
            return "not mentioned"
        return {True: "agrees", False: "disagrees: claims this", None: "claims this"}[self.measured]


def words_of(verdict: Verdict, quoted: Sequence[QuotedWord]) -> list[Word]:
    """Return every measured and every quoted word."""
    reasons, paper = verdict.reasons, {one.word: one.measured for one in quoted}
    return [
        Word(word, word in reasons or paper.get(word, False), reasons.get(word, ""), word in paper)
        for word in WORDS
        if word in reasons or word in paper
    ]
