"""The results of checks of several environments, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .check import STYLES
from .terminal import Console, Text

if TYPE_CHECKING:
    from ..jobs.checks import CheckReports


def show(found: CheckReports, console: Console) -> int:
    """Print a line and a verdict for each environment; the exit code is 1 where one fails or could not be checked."""
    from ..jobs.checks import sum_up

    console.soft_wrap = True
    lines = [(one.env, "passes" if one.passed else "fails", sum_up(one)) for one in found.reports]
    lines += [(name, "cannot be checked", why) for name, why in found.failed.items()]
    width = max(len(name) for name, _, _ in lines)
    for name, said, why in lines:
        line = Text(f"{name:{width}}  ")
        line.append(said, STYLES["pass" if said == "passes" else "fail"])
        console.print(line.append(f": {why}", ""))
    good = sum(said == "passes" for _, said, _ in lines)
    console.print(Text(f"{good} of {len(lines)} pass", STYLES["pass" if found.passed else "fail"]))
    return 0 if found.passed else 1
