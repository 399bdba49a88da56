"""The paper's statements, read from paper.toml: words for landscapes, claims about races, captions of figures."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from ..landscapes.convert import from_json
from .files import PAPER

if TYPE_CHECKING:
    from ..optim.claims import Claim, Claims

ABSENT = "The paper does not use this environment, so it makes no claim about it."


@dataclass(frozen=True)
class PaperWords:
    """The paper's words for an environment's landscape, from `verdict.WORDS`, and where they are in the paper.

    `losses` are the ends of the colour bars of its slices, or None if they are not legible.
    """

    words: tuple[str, ...]
    where: str
    losses: tuple[float, float] | None = None

    def __str__(self) -> str:
        said = f"{', '.join(self.words)} ({self.where})"
        return f"{said}; losses from {self.losses[0]:g} to {self.losses[1]:g} in its slices" if self.losses else said


@dataclass(frozen=True)
class PaperCaption:
    """The paper's statement about a slice, in our words, and the number of its figure, or None for our own slices.

    `words` are from `verdict.WORDS`. They are given where the paper's words for this slice differ from those for the
    scene.
    """

    says: str = "This slice is not shown."
    number: int | None = None
    words: tuple[str, ...] = ()


@dataclass(frozen=True)
class PaperFinding:
    """Measurements that concern the paper's words for some slices, beyond their reports.

    `words` are from `verdict.WORDS`, or the paper's own where it has more. `setting` is a setting that was tried to
    reproduce them, empty for none. `holds` says whether the words are true with it, and `measured` how that is known.
    """

    words: tuple[str, ...]
    measured: str
    setting: str = ""
    holds: bool = True

    def __str__(self) -> str:
        said = f"{', '.join(self.words)}: {self.measured}"
        return f"{said} ({'found with' if self.holds else 'not found with'} {self.setting})" if self.setting else said


@dataclass(frozen=True)
class Paper:
    """All statements of the paper: `words`, `claims` and `silences` by environment, `captions` by slice.

    `findings` are our own measurements, by slice.
    """

    words: Mapping[str, PaperWords]
    claims: Mapping[str, tuple[Claim, ...]]
    silences: Mapping[str, str]
    captions: Mapping[str, PaperCaption]
    findings: Mapping[str, tuple[PaperFinding, ...]]

    def claims_about(self, env: str) -> Claims:
        """Return the paper's claims about optimisers in an environment, or the reason why there are none."""
        from ..optim.claims import Claims

        claims = self.claims.get(env, ())
        return Claims(claims, None if claims else self.silences.get(env, ABSENT))

    def caption_of(self, slice_: str) -> PaperCaption:
        """Return the paper's caption of a slice of the gallery."""
        return self.captions.get(slice_, PaperCaption())


@cache
def read_paper(path: Path = PAPER) -> Paper:
    """Read the paper's statements. Raises ValueError for a word that is not in `verdict.WORDS`."""
    from ..landscapes.measures.verdict import WORDS
    from ..optim.claims import Claim

    tables = tomllib.loads(path.read_text())
    words = from_json(dict[str, PaperWords], tables["environment"])
    captions = {name: from_json(PaperCaption, table) for table in tables["caption"] for name in table["slices"]}
    for name, said in (words | captions).items():
        if unknown := set(said.words) - set(WORDS):
            raise ValueError(f"{path}: {name} has words {sorted(unknown)}; the words are {', '.join(WORDS)}")
    claims: dict[str, tuple[Claim, ...]] = {}
    for table in tables["claim"]:
        pairs = [{"first": first, "second": second} for first in table["first"] for second in table["second"]]
        for env in table["environments"]:
            claims[env] = claims.get(env, ()) + tuple(from_json(Claim, table | pair) for pair in pairs)
    silences = {env: str(table["why"]) for table in tables["silence"] for env in table["environments"]}
    findings: dict[str, tuple[PaperFinding, ...]] = {}
    for table in tables["finding"]:
        for name in table["slices"]:
            findings[name] = (*findings.get(name, ()), from_json(PaperFinding, table))
    return Paper(words, claims, silences, captions, findings)
