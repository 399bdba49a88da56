"""The result of one check of an objective."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

Numbers = Mapping[str, float | None]
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
    numbers: Numbers | None = None
    table: tuple[Numbers, ...] = ()

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


def verdict(
    ok: bool, figure: str, why: str = "", numbers: Numbers | None = None, table: tuple[Numbers, ...] = ()
) -> Finding:
    """Return a pass, or a failure for the reason given; the suite says of which check."""
    return Finding("", PASS if ok else FAIL, figure, "" if ok else why, numbers, table)


def within(apart: float, limit: float, figure: str, why: str) -> Finding:
    """Return a pass where numbers are no farther apart than a limit; `figure` describes those that are not equal."""
    return verdict(apart <= limit, "same bits" if apart == 0 else figure, f"at most {limit:.0e} is wanted: {why}")


def skip(figure: str, why: str = "", numbers: Numbers | None = None, table: tuple[Numbers, ...] = ()) -> Finding:
    """Return a check that was not made, with the reason."""
    return Finding("", SKIP, figure, why, numbers, table)


def refused(refusal: ValueError) -> Finding:
    """Return the pass of what was refused."""
    return verdict(True, f"refused: {one_line(refusal)}")


def one_line(error: Exception) -> str:
    """Return what an error says, in one line."""
    return " ".join(str(error).split())
