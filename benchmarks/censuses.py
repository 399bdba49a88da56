"""Write the tables of what many slices of every scene are like, from the censuses that the gallery keeps.

    python -m benchmarks.censuses [--check]

README.md has the shares alone. The table in docs/measures.md has a row for each scene: how many slices were measured,
in which share of them losses move by less than a hundredth of what they do in all, which share each word of the
classification fits, with its interval, and the paper's words with their shares. It is of the records by `landscape
census ENV --fidelity standard` in gallery/data/census; a scene that has none, or has changed since, is said to be so.
With --check nothing is written: exit code 1 says that a page differs, or that a scene is not measured.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gradscape.gallery.files import DEVICES
from gradscape.gallery.paper import read_paper
from gradscape.landscapes.statistics import Estimate
from gradscape.landscapes.storage.records import read_json

from .pages import DATA, DOCS, MISSING, ROOT, UNMEASURED, is_present, scenes, settle_measured

PAGE, NAME = DOCS / "measures.md", "censuses"
README = ROOT / "README.md"
FAINT = 0.01  # of the range of the losses of all slices
HEAD = ("environment", "slices", "faint", "measured: share of the slices (95 % interval)", "the paper's words")
SHORT = {  # the columns of README: what a slice may be, and the words that say so
    "very smooth": ("very smooth",),
    "smooth with local minima": ("smooth with local minima",),
    "rugged": ("rugged", "extremely rugged"),
    "with jumps": ("discontinuous",),
    "gradients good": ("gradients good",),
}
SHORT_HEAD = ("environment", *SHORT, "the paper says")


@dataclass(frozen=True)
class Shares:
    """Say which share of so many slices each word fits, and in which losses hardly move."""

    slices: int
    faint: float
    words: Mapping[str, Estimate]

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Shares:
        """Read it from the record of a census."""
        words = {word: Estimate.of_record(one) for word, one in record["words"].items()}
        ranges = [one["range"] for one in record["slices"] if None not in one["range"]]
        whole = max(high for _, high in ranges) - min(low for low, _ in ranges)
        faint = sum(high - low < FAINT * whole for low, high in ranges) / len(record["slices"])
        return cls(len(record["slices"]), faint, words)

    def say(self, word: str) -> str:
        """Say the share of a word."""
        one = self.words[word]
        interval = f" ({100 * one.low:.0f} to {100 * one.high:.0f})" if one.low < one.high else ""
        return f"{word} {100 * one.value:.0f} %{interval}"


def censuses(data: Path = DATA) -> dict[str, Shares | str]:
    """Return the kept census of each scene, or why there is none."""
    found: dict[str, Shares | str] = {}
    for name in scenes():
        files = (data / "census" / f"{name}-{device}.json" for device in DEVICES)
        record = next((read_json(file) for file in files if file.exists()), None)
        if record is None:
            found[name] = MISSING
        elif not is_present(name, record["identity"]["model_version"], record["identity"]["engine"]):
            found[name] = UNMEASURED
        else:
            found[name] = Shares.of_record(record)
    return found


def rows(found: Mapping[str, Shares | str]) -> Iterator[list[str]]:
    """Return a row for each scene."""
    for name, one in found.items():
        said = _paper_words(name)
        if isinstance(one, str):
            yield [f"`{name}`", "", "", one, ", ".join(said)]
            continue
        most = sorted(one.words, key=lambda word, one=one: -one.words[word].value)  # type: ignore[misc]
        measured = ", ".join(one.say(word) for word in most if one.words[word].value > 0)
        yield [f"`{name}`", str(one.slices), f"{100 * one.faint:.0f} %", measured, ", ".join(map(one.say, said))]


def short_rows(found: Mapping[str, Shares | str]) -> Iterator[list[str]]:
    """Return a row of README for each scene: which percentage of its slices fits each column."""
    nothing = [""] * (len(SHORT) - 1)
    for name, one in found.items():
        shares = [one, *nothing] if isinstance(one, str) else [_percent(one, words) for words in SHORT.values()]
        yield [f"`{name}`", *shares, ", ".join(_paper_words(name))]


def _paper_words(scene: str) -> Sequence[str]:
    words = read_paper().words
    return words[scene].words if scene in words else ()


def _percent(shares: Shares, words: Sequence[str]) -> str:
    """Add the shares of words of which a slice has one at most."""
    return f"{100 * sum(shares.words[word].value for word in words):.0f} %"


def main() -> int:
    """Write both pages, or say what is not so."""
    found = censuses()
    tables = ((HEAD, rows(found), PAGE), (SHORT_HEAD, short_rows(found), README))
    return max(settle_measured(__doc__ or "", found, head, lines, page, NAME) for head, lines, page in tables)


if __name__ == "__main__":
    sys.exit(main())
