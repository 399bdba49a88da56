"""Free memory and disk: a size that cannot fit is refused before anything is allocated."""

from __future__ import annotations

import os
import resource
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ENDLESS = 10**30  # larger values take no more: their powers are beyond what a float holds
BLOCK = 4096  # bytes that a file takes on a disk, however small it is
UNITS = ("kB", "MB", "GB", "TB", "PB", "EB")
MEMINFO, CGROUPS = Path("/proc/meminfo"), Path("/sys/fs/cgroup")


class TooLargeError(ValueError):
    """A size does not fit into the memory or onto the disk of this machine."""


@dataclass(frozen=True)
class Need:
    """An estimate of the memory and disk that something needs [bytes]."""

    memory: float = 0.0
    disk: float = 0.0

    def times(self, count: float) -> Need:
        """Return the need of `count` such things."""
        return Need(count * self.memory, count * self.disk)


def require(what: str, value: int, need: Callable[[int], Need], folder: Path | None = None) -> None:
    """Refuse a value that needs more than there is, before allocation, and name the largest one that would fit.

    `what` names the value, such as resolution, and `need` gives the need of each value, which must not decrease.
    Without a `folder` nothing is written. Raises TooLargeError where it does not fit.
    """
    there = Need(available_memory(), free_disk(folder) if folder else float("inf"))
    too_large = min(value, ENDLESS)
    if _fits(need(too_large), there):
        return
    fits = 0
    while too_large - fits > 1:
        middle = (fits + too_large) // 2
        fits, too_large = (middle, too_large) if _fits(need(middle), there) else (fits, middle)
    wanted = need(min(value, ENDLESS))
    name = "memory" if wanted.memory > there.memory else "disk"
    digit: int = 10 ** max(0, len(str(fits)) - 2)  # two digits: more would pretend to more accuracy than there is
    most = f"{what} {fits // digit * digit} would fit" if fits else f"not even {what} 1 would fit, so free some space"
    raise TooLargeError(
        f"{what} {value} needs about {size(getattr(wanted, name))} of {name}, but only {size(getattr(there, name))} "
        f"are free here; {most}"
    )


def available_memory() -> float:
    """Return the bytes of memory that the system and the groups of this process still allow."""
    if not MEMINFO.exists():
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    lines = dict(line.split(":") for line in MEMINFO.read_text().splitlines())
    return min([1024.0 * int(lines["MemAvailable"].split()[0]), *_group_limits()])


def peak_memory() -> int:
    """Return the peak memory of this process [bytes]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def free_disk(folder: Path) -> float:
    """Return the free bytes on the disk of a folder, which need not exist yet."""
    there = next((place for place in (folder, *folder.absolute().parents) if place.exists()), Path.cwd())
    return float(shutil.disk_usage(there).free)


def size(count: float) -> str:
    """Write a number of bytes with a unit, such as "2 MB"."""
    unit = next((at for at, _ in enumerate(UNITS) if count < 1000.0 ** (at + 2)), len(UNITS) - 1)
    amount = count / 1000.0 ** (unit + 1)
    return f"{amount:.0f} {UNITS[unit]}" if unit < 2 else f"{amount:.1f} {UNITS[unit]}"


def _fits(wanted: Need, there: Need) -> bool:
    return wanted.memory <= there.memory and wanted.disk <= there.disk


def _group_limits() -> list[float]:
    """Return the remaining memory of the control groups (version 2) of this process, where they have a limit."""
    try:
        own = next(line[3:] for line in Path("/proc/self/cgroup").read_text().splitlines() if line.startswith("0::"))
    except (OSError, StopIteration):
        return []
    group = CGROUPS / own.strip("/")
    return [
        left for place in (group, *group.parents) if place.is_relative_to(CGROUPS) for left in _free_in_group(place)
    ]


def _free_in_group(group: Path) -> list[float]:
    try:
        most, taken = ((group / name).read_text().strip() for name in ("memory.max", "memory.current"))
        stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    except (OSError, ValueError):
        return []
    return [] if most == "max" else [float(most) - float(taken) + float(stat.get("inactive_file", 0))]
