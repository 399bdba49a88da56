"""The words of a page: those that were measured, next to those of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ...measures.verdict import WORDS, QuotedWord, Verdict


@dataclass(frozen=True)
class Word:
    """A word that was measured, or that the `paper` says; `measured` is None where that is not resolved."""

    word: str
    measured: bool | None
    reason: str
    paper: bool

    @property
    def comparison(self) -> str:
        """How the paper's word compares."""
        if not self.paper:
            return "says nothing of it"
        return {True: "agrees", False: "disagrees: it says so", None: "says so"}[self.measured]


def words_of(verdict: Verdict, quoted: Sequence[QuotedWord]) -> list[Word]:
    """Return every word that was measured or is quoted."""
    reasons, paper = verdict.reasons, {one.word: one.measured for one in quoted}
    return [
        Word(word, word in reasons or paper.get(word, False), reasons.get(word, ""), word in paper)
        for word in WORDS
        if word in reasons or word in paper
    ]
