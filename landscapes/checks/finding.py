"""The result of one check of an objective."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

Numbers = Mapping[str, float | None]
PASS, FAIL, SKIP, WARN, KNOWN, UNEXPECTED = "pass", "fail", "skip", "warn", "known", "unexpected"


@dataclass(frozen=True)
class Finding:
    """The outcome of one check.

    `outcome` is pass, fail or skip. It is warn where no promise is broken but a user should know; known for an expected
    failure, and unexpected for a pass where a failure was expected. `figure` is the measurement, `why` the reason where
    it is not obvious, `numbers` the measurement as numbers, and `table` a row of numbers for each step of a ladder.
    """

    check: str
    outcome: str
    figure: str
    why: str = ""
    numbers: Numbers | None = None
    table: tuple[Numbers, ...] = ()

    @property
    def bad(self) -> bool:
        """Whether this makes the whole check fail."""
        return self.outcome in (FAIL, UNEXPECTED)

    def excuse(self, expected: Mapping[str, str]) -> Finding:
        """Return the finding with an expected failure excused; `expected` maps names of checks to reasons."""
        if self.check not in expected or self.outcome == SKIP:
            return self
        reason = expected[self.check]
        if self.outcome == FAIL:
            return replace(self, outcome=KNOWN, why=f"{self.why}; known: {reason}" if self.why else f"known: {reason}")
        return replace(self, outcome=UNEXPECTED, why=f"it passes, so this reason no longer applies: {reason}")


def verdict(
    ok: bool, figure: str, why: str = "", numbers: Numbers | None = None, table: tuple[Numbers, ...] = ()
) -> Finding:
    """Return a pass, or a failure for the given reason; the suite adds the name of the check."""
    return Finding("", PASS if ok else FAIL, figure, "" if ok else why, numbers, table)


def within(apart: float, limit: float, figure: str, why: str) -> Finding:
    """Return a pass where numbers differ by at most a limit; `figure` describes those that are not equal."""
    return verdict(apart <= limit, "same bits" if apart == 0 else figure, f"at most {limit:.0e} is allowed: {why}")


def skip(figure: str, why: str = "", numbers: Numbers | None = None, table: tuple[Numbers, ...] = ()) -> Finding:
    """Return a skipped check, with the reason."""
    return Finding("", SKIP, figure, why, numbers, table)


def refused(refusal: ValueError) -> Finding:
    """Return the pass of a correct refusal."""
    return verdict(True, f"refused: {one_line(refusal)}")


def one_line(error: Exception) -> str:
    """Return an error's message in one line."""
    return " ".join(str(error).split())
