"""What a race found, as its file has it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from ..landscapes.plain import jsonable
from ..optim.claims import ClaimFinding
from ..optim.race import Race


@dataclass(frozen=True)
class RaceSummary:
    """Say what a race found, as `race.json` in its folder has it; `race` holds the runs, whose figures are in it, too.

    `silence` says why there is no claim.
    """

    env: str
    fidelity: str
    device: str
    engine: str
    options: dict[str, Any]
    loss_unit: str
    methods: list[str]
    method_options: dict[str, dict[str, Any]]
    budget: int
    seeds: int
    race: Race
    claims: list[ClaimFinding]
    silence: str | None
    command: str
    files: list[str]

    def record(self) -> dict[str, Any]:
        """Return the summary as its file has it."""
        figures = self.race.statistics.record()
        about = ("env", "fidelity", "device", "engine", "options", "loss_unit")
        whole = {
            **{name: getattr(self, name) for name in (*about, "methods", "method_options", "budget", "seeds")},
            **{name: figures[name] for name in ("ranks", "differences")},
            "claims": [claim_record(finding) for finding in self.claims],
            "silence": self.silence,
            **{name: figures[name] for name in ("targets", "running_times", "ecdf", "curves")},
            "command": self.command,
            "files": self.files,
        }
        return {name: jsonable(value) for name, value in whole.items()}


def claim_record(finding: ClaimFinding) -> dict[str, Any]:
    """Return what a race makes of a claim, as files have it."""
    parts = {"difference": finding.difference, "superiority": finding.superiority}
    how = {name: None if part is None else asdict(part) for name, part in parts.items()}
    return asdict(finding.claim) | {"claim": str(finding.claim), "verdict": finding.verdict} | how
