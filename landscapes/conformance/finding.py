"""The result of one check of an objective."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

PASS, FAIL, SKIP, WARN, KNOWN, UNEXPECTED = "pass", "fail", "skip", "warn", "known", "unexpected"


@dataclass(frozen=True)
class Finding:
    """Say how one check ended.

    `outcome` is pass, fail or skip; warn, where no promise is broken and a user should know it all the same; known is a
    failure that was expected, unexpected a pass where a failure was. `figure` is what was measured, `why` the reason
    where it is not plain, `numbers` the same to compute with, and `table` a row of numbers for each step of a ladder.
    """

    check: str
    outcome: str
    figure: str
    why: str = ""
    numbers: Mapping[str, float | None] | None = None
    table: tuple[Mapping[str, float | None], ...] = ()

    @property
    def bad(self) -> bool:
        """Whether this makes the whole fail."""
        return self.outcome in (FAIL, UNEXPECTED)

    def excuse(self, expected: Mapping[str, str]) -> Finding:
        """Return the finding with an expected failure excused; `expected` maps names of checks to reasons."""
        if self.check not in expected or self.outcome == SKIP:
            return self
        reason = expected[self.check]
        if self.outcome == FAIL:
            return replace(self, outcome=KNOWN, why=f"{self.why}; known: {reason}" if self.why else f"known: {reason}")
        return replace(self, outcome=UNEXPECTED, why=f"it passes, so this is no longer true: {reason}")


def verdict(check: str, ok: bool, figure: str, why: str = "") -> Finding:
    """Return a pass, or a failure for the reason given."""
    return Finding(check, PASS if ok else FAIL, figure, "" if ok else why)
