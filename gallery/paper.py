"""What the paper says, read from paper.toml: of landscapes in words, of races in claims, of figures in captions."""

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

ABSENT = "The paper does not have this environment, so it claims nothing about it."


@dataclass(frozen=True)
class PaperWords:
    """Hold the paper's words for an environment's landscape, of `verdict.WORDS`, and where it says them.

    `losses` are the ends of the colour bars of its slices, None where they cannot be read.
    """

    words: tuple[str, ...]
    where: str
    losses: tuple[float, float] | None = None

    def __str__(self) -> str:
        said = f"{', '.join(self.words)} ({self.where})"
        return f"{said}; losses from {self.losses[0]:g} to {self.losses[1]:g} in its slices" if self.losses else said


@dataclass(frozen=True)
class PaperCaption:
    """Hold what the paper says, in our words, of what a slice shows, and the number of its figure, None in ours.

    `words` are those of this slice alone, of `verdict.WORDS`, where it does not say of it what it says of the scene.
    """

    says: str = "It does not show this slice."
    number: int | None = None
    words: tuple[str, ...] = ()


@dataclass(frozen=True)
class PaperFinding:
    """Hold what was measured of the paper's words for some slices, beyond what their reports say.

    `words` are of `verdict.WORDS`, or the paper's own where it has more. `setting` is what turns our landscape into
    the paper's, empty where none was found; `holds` says whether the words hold with it; `measured` how that is known.
    """

    words: tuple[str, ...]
    measured: str
    setting: str = ""
    holds: bool = True

    def __str__(self) -> str:
        said = f"{', '.join(self.words)}: {self.measured}"
        return f"{said} ({'so with' if self.holds else 'tried:'} {self.setting})" if self.setting else said


@dataclass(frozen=True)
class Paper:
    """Hold all that the paper says: `words`, `claims` and `silences` by environment, `captions` by slice.

    `findings` are ours, by slice.
    """

    words: Mapping[str, PaperWords]
    claims: Mapping[str, tuple[Claim, ...]]
    silences: Mapping[str, str]
    captions: Mapping[str, PaperCaption]
    findings: Mapping[str, tuple[PaperFinding, ...]]

    def claims_about(self, env: str) -> Claims:
        """Return which optimisers the paper has ahead of which others in an environment, or why it claims nothing."""
        from ..optim.claims import Claims

        claims = self.claims.get(env, ())
        return Claims(claims, None if claims else self.silences.get(env, ABSENT))

    def caption_of(self, slice_: str) -> PaperCaption:
        """Return what the paper says of a slice of the gallery."""
        return self.captions.get(slice_, PaperCaption())


@cache
def read_paper(path: Path = PAPER) -> Paper:
    """Read what the paper says. Raises ValueError where it says a word that landscapes are not described in."""
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
