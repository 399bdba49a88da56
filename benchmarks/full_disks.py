"""Let disks be full while verbs write, then make room, and hold what they end in against the undisturbed.

    python -m benchmarks.full_disks [--kind slice] [--steps 6] [--json]

Every verb that writes is run on disks of its own (tmpfs, in a namespace: no rights are needed where Linux lets users
have those) that have room for a share of the bytes, or of the files, which it writes undisturbed. It has to end with a
line that says that the disk is full, and what to do. Then the disk gets room, and the same command has to end in the
numbers of the undisturbed, with nothing hidden left. Where nothing can be mounted no file may grow beyond so many bytes
instead. Exit code 1 says that something else came out.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import forked, kills, results
from benchmarks.forked import Ended, Limits
from benchmarks.results import KINDS, READ, Numbers

DISK, ROOM = "disk", "size=1g,nr_inodes=100000"
NEW_USER, NEW_MOUNTS, REMOUNT = 0x10000000, 0x00020000, 32  # of Linux: unshare(2), mount(2)
WRITING = ("export", "overlay", "slice", "report", "gallery build")
GOOD = ("room enough", "said full, then right")
PATIENCE = 60.0  # seconds for a command, before Ctrl-C
ADVICE = re.compile(r"make room|same command|run it again")
FULL = re.compile(r"no space|no room|disk is full|too large|of disk, and .* free here", re.IGNORECASE)


@dataclass(frozen=True)
class Job:
    """A command that writes, and what has to be there before."""

    kind: str
    command: str
    before: tuple[str, ...]


@dataclass(frozen=True)
class Disk:
    """How much room a disk has beside what lies on it, in bytes or in files; None has no bound."""

    space: int | None = None
    files: int | None = None


@dataclass(frozen=True)
class Found:
    """How a command ended on a full disk, and again with room; what lay there then, and what it took."""

    full: Ended
    again: Ended
    numbers: dict[str, Numbers]
    hidden: tuple[str, ...]
    space: int
    files: int


@dataclass(frozen=True)
class Case:
    """What came of one command on one disk."""

    kind: str
    command: str
    disk: str
    outcome: str
    said: str


def jobs(kinds: Sequence[str]) -> Iterator[Job]:
    """Yield what makes results of these kinds, and what writes when it reads them."""
    for name in kinds:
        kind = KINDS[name]
        if kind.stop is None:
            yield Job(name, kind.make, kind.needs)
            for read in kind.reads:
                if read.startswith(WRITING) and READ in read:
                    yield Job(name, read, (*kind.needs, kind.make))


class Disks:
    """Disks on which commands are run, beside folders with what they need, under a root."""

    def __init__(self, root: Path, limits: Limits | None = None) -> None:
        self.root, self.limits = root, limits or Limits(cpu=120, clock=300)

    def cases(self, job: Job, disks: Sequence[Disk] | None = None, steps: int = 6) -> Iterator[Case]:
        """Run a command on disks that fill up in so many steps, or on those given."""
        whole = self.run(job, Disk())
        if whole.full.code:
            raise RuntimeError(f"{job.command} ended with {whole.full.code}: {whole.full.err}")
        for disk in disks if disks is not None else _disks(whole, steps):
            found = self.run(job, disk)
            outcome, said = _judged(found, whole)
            yield Case(job.kind, job.command, f"{disk.space} bytes" if disk.files is None else f"{disk.files} files",
                       outcome, said)  # fmt: skip

    def run(self, job: Job, disk: Disk) -> Found:
        """Run a command on a disk, and again when it has room."""
        needs = self._needs(job)
        place = self.root / DISK
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        told = self.root / "told.json"
        told.unlink(missing_ok=True)
        done = forked.alone(_drive, str(needs), str(place), job.command, disk, folder=self.root, limits=self.limits)
        if not told.exists():
            raise RuntimeError(f"{job.command} on {disk}: {done.code} {done.err[-2000:]}")
        said: dict[str, Any] = json.loads(told.read_text())
        ended = {name: Ended(left=done.left, **said[name]) for name in ("full", "again")}
        numbers = {name: Numbers(**one) for name, one in said["numbers"].items()}
        return Found(**ended, numbers=numbers, hidden=tuple(said["hidden"]), space=said["space"], files=said["files"])

    def _needs(self, job: Job) -> Path:
        folder = self.root / "needs" / f"{abs(hash(job.before))}"
        if not folder.exists():
            folder.mkdir(parents=True)
            for command in job.before:
                ended = forked.landscape(command.split(), folder, limits=self.limits, before=results.small)
                if ended.code:
                    raise RuntimeError(f"{command} ended with {ended.code}: {ended.err}")
        return folder


def _disks(whole: Found, steps: int) -> list[Disk]:
    """Return disks from the first byte and file to more than is there at the end: what is replaced needs room, too."""
    shares = [1.2 * (step / steps) ** 1.5 for step in range(steps)]
    return [Disk(space=int(whole.space * share)) for share in shares] + [
        Disk(files=int(whole.files * share)) for share in shares
    ]


def _judged(found: Found, whole: Found) -> tuple[str, str]:
    full, again = found.full, found.again
    for when, ended in (("full", full), ("with room", again)):
        if failure := forked.failure(ended):
            return failure, f"{when}: {forked.last_words(ended.err)}"
    if not full.code and FULL.search(full.err):
        return "met it and said done", full.err
    if full.code and not FULL.search(full.err):
        return "not said to be full", full.err
    if full.code and not ADVICE.search(full.err):
        return "not said what to do", full.err
    if again.code:
        return "does not go on", f"{full.err}\nwith room: {again.err}"
    if wrong := results.wrong(found.numbers, whole.numbers) + results.missing(found.numbers, whole.numbers):
        return "OTHER NUMBERS", f"{', '.join(wrong)}\n{full.err}\nwith room: {again.err}"
    if found.hidden:
        return "hidden files left", f"{', '.join(found.hidden)}\n{full.err}"
    return ("said full, then right" if full.code else "room enough"), full.err


def _drive(needs: str, place: str, command: str, disk: Disk) -> None:
    """Run a command twice on a disk of this process's own, and tell how it ended and what lies there."""
    mounted, folder, told = _mounted(place), Path(place), Path("told.json").resolve()
    shutil.copytree(needs, place, symlinks=True, dirs_exist_ok=True)
    os.chdir(place)
    forked.at_home(folder)
    here = os.statvfs(place)
    used, nodes = (here.f_blocks - here.f_bfree) * here.f_frsize, here.f_files - here.f_ffree
    if mounted:
        pages = max(1, (used + (disk.space or 0)) // here.f_frsize)  # of 0 there would be no bound
        space = "1g" if disk.space is None else pages * here.f_frsize
        _mount(place, f"size={space},nr_inodes={100000 if disk.files is None else nodes + disk.files}", REMOUNT)
    full = _run(command, told.parent, limit=None if mounted else disk.space)
    if mounted:
        _mount(place, ROOM, REMOUNT)
    after = os.statvfs(place)
    again = _run(command, told.parent)
    found = results.numbers(folder)
    hidden = [str(path.relative_to(folder)) for path in kills.hidden(folder)]
    told.write_text(json.dumps({
        "full": full, "again": again, "hidden": hidden,
        "numbers": {name: {"rows": one.rows, "whole": one.whole} for name, one in found.items()},
        "space": (after.f_blocks - after.f_bfree) * after.f_frsize - used if mounted else 1 << 16,
        "files": after.f_files - after.f_ffree - nodes if mounted else 0,
    }))  # fmt: skip


def _mounted(place: str) -> bool:
    """Mount an empty disk that only this process and its children see; say whether that was possible."""
    user, group = os.getuid(), os.getgid()
    if ctypes.CDLL(None, use_errno=True).unshare(NEW_USER | NEW_MOUNTS):
        return False
    Path("/proc/self/setgroups").write_text("deny")
    Path("/proc/self/uid_map").write_text(f"0 {user} 1")
    Path("/proc/self/gid_map").write_text(f"0 {group} 1")
    try:
        _mount(place, ROOM)
    except OSError:
        return False
    return True


def _mount(place: str, how: str, flags: int = 0) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mount(b"tmpfs", place.encode(), b"tmpfs", flags, how.encode()):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), place)


def _run(command: str, said: Path, limit: int | None = None) -> dict[str, Any]:
    """Run a command in a child of this process, and return how it ended; its files may be `limit` bytes long."""
    child = os.fork()
    if not child:
        code = 1
        try:
            for stream, name in ((1, "out"), (2, "err")):
                os.dup2(os.open(said / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            signal.setitimer(signal.ITIMER_REAL, PATIENCE)
            results.small()
            forked.say(command.split())
        except SystemExit as left:
            code = left.code if isinstance(left.code, int) else int(left.code is not None)
        except BaseException:
            sys.excepthook(*sys.exc_info())
        finally:
            sys.stdout.flush()
            os._exit(code)
    deadline, stopped, status = time.monotonic() + PATIENCE + 5, False, (0, 0)
    while not status[0]:
        status = os.waitpid(child, os.WNOHANG)
        if not status[0] and not stopped and time.monotonic() > deadline:
            stopped = True
            os.kill(child, signal.SIGKILL)
        time.sleep(0.01)
    out, err = ((said / name).read_text(errors="replace") for name in ("out", "err"))
    return {"code": os.waitstatus_to_exitcode(status[1]), "out": out, "err": err, "stopped": stopped}


def table(cases: Sequence[Case]) -> str:
    """Return how many disks each verb met with which outcome."""
    counts = Counter((case.kind, case.outcome) for case in cases)
    shown = [*GOOD, *sorted({case.outcome for case in cases} - set(GOOD))]
    lines = [f"| result | {' | '.join(shown)} |", f"|---|{'---|' * len(shown)}"]
    kinds = list(dict.fromkeys(case.kind for case in cases))
    return "\n".join(
        [*lines, *(f"| {kind} | {' | '.join(str(counts[kind, one]) for one in shown)} |" for kind in kinds)]
    )


def main() -> None:
    """Print what came of full disks, and every one of which something else came than should."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", action="append", choices=list(KINDS))
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    forked.load()
    cases = list[Case]()
    with tempfile.TemporaryDirectory() as root:
        for job in jobs(given.kind or list(KINDS)):
            for case in Disks(Path(root)).cases(job, steps=given.steps):
                cases.append(case)
                if case.outcome not in GOOD:
                    print(f"{case.outcome}: room for {case.disk}, then landscape {case.command}\n  {case.said[-900:]}",
                          file=sys.stderr, flush=True)  # fmt: skip
    if given.json:
        print(json.dumps([case.__dict__ for case in cases]))
    else:
        print(f"{len(cases)} disks\n\n{table(cases)}")
    sys.exit(int(any(case.outcome not in GOOD for case in cases)))


if __name__ == "__main__":
    main()
