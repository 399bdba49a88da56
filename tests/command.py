"""What the command printed when it was run in this process."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Said:
    returncode: int
    stdout: str
    stderr: str
