"""Kill jobs of all kinds at random moments, and compare what they end in with undisturbed runs.

    python -m benchmarks.kills [--count 50] [--seed 0] [--job slice --job workers] [--json]

A job is begun in a folder of its own, killed (SIGKILL) up to four times, each time at a moment drawn from the time that
it takes undisturbed, begun again by the same command, and then left to end; of a job with workers the command, one
worker or all of them are killed. Every stored value must have the bits of the undisturbed run; `seconds` of searches,
which are measured, are left out, and so is `forwards`, which follows from them. No process of a killed job may go on
for long, and nothing hidden may lie in its folder at the end. Exit code 1 says that it was otherwise. Jobs are forked
from a process that has loaded what they need, so that moments fall into the work and not into its start.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib
import json
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

import torch
from benchmarks import results
from benchmarks.forked import LOADED, at_home, ended, living

from gradscape.cli import main as landscape
from gradscape.landscapes.measures import fidelity as tradeoff

JOBS = {
    "slice": "slice bounce --dims 0 1 --resolution 32 --fidelity draft --out made",
    "sweep": "sweep bounce --dims 0 1 --over 2 --frames 3 --resolution 12 --fidelity draft --out made",
    "race": "race bounce --methods random,descents --seeds 2 --budget 40 --fidelity draft --out made",
    "gallery": "gallery compute --only bounce --part slices --resolution 96 --fidelity draft --device cpu --data made",
    "pairs": "pairs bounce --samples 32 --fidelity draft --device cpu --out made",
    "tradeoff": "tradeoff bounce --points 8 --variants precision --device cpu --out made",
    "report": "report branin --points 3 --out made",
    "workers": "slice bounce --dims 0 1 --resolution 48 --fidelity draft --device cpu --scheduler local:2 --out made",
}
VICTIMS = ("parent", "worker", "all")  # of a job with workers
RECORDS = (".npz", "pairs.json", "report.json", "measures.json")  # of studies, beside stores
MOST = 4  # times that one job is killed
FORK = multiprocessing.get_context("fork")


@dataclass
class Tally:
    """What was done to one kind of job: kills by how much of it was on disk, and jobs that ended in other bits."""

    seconds: float
    jobs: int = 0
    other_bits: int = 0
    hidden: int = 0  # files that were left by processes that were killed
    orphans: int = 0
    kills: Counter[str] = field(default_factory=Counter)


def work(command: str, folder: Path) -> None:
    """Run a command in a folder, silently."""
    os.setsid()  # a group of its own
    os.chdir(folder)
    at_home(folder)
    tradeoff.REPETITION = 0.02
    with open(os.devnull, "w") as nowhere:
        for stream in (1, 2):
            os.dup2(nowhere.fileno(), stream)
    torch.set_num_threads(1)
    landscape(command.split())


def run(command: str, folder: Path, patience: float | None = None, victim: str = "parent") -> tuple[bool, int]:
    """Run a command, kill it when patience is over; say whether it ended before, and what of it lives on."""
    process = FORK.Process(target=work, args=(command, folder))
    process.start()
    assert process.pid is not None
    process.join(patience)
    killed = process.is_alive()
    if killed:
        workers = [number for number, name in living(process.pid) if number != process.pid and "python" in name]
        for number in {"parent": [process.pid], "worker": workers[:1], "all": [process.pid, *workers]}[victim]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
    process.join()
    left = ended(process.pid)
    if process.exitcode not in (0, -signal.SIGKILL, *([1] if killed and victim == "worker" else [])):
        raise RuntimeError(f"{command} left with exit code {process.exitcode} in {folder}")
    return process.exitcode == 0, len(left)


def bits(folder: Path) -> tuple[int, str]:
    """Return how many points and records a folder holds, and a digest of all their values."""
    from gradscape.landscapes.storage.paths import is_slice
    from gradscape.landscapes.storage.store import SliceStore
    from gradscape.optim.runs.store import RunStore, is_run

    digest, done = hashlib.sha256(), 0
    for path in sorted(folder.rglob("*.zarr")):
        if any(part.startswith(".") for part in path.relative_to(folder).parts):
            continue  # a store that was being made
        if is_slice(path):
            dataset = SliceStore.open(path).dataset()
        elif is_run(path):
            dataset = RunStore.open(path).dataset().drop_vars(["seconds", "forwards"])
        else:
            continue
        digest.update(str(path.relative_to(folder)).encode())
        done += int((dataset["status"] > 0).sum())
        for name in sorted(dataset.data_vars):
            digest.update(str(name).encode() + dataset[name].to_numpy().tobytes())
    for name, one in results.numbers(folder).items():
        if name.endswith(RECORDS):
            digest.update(f"{name} {one.whole}".encode())
            done += 1
    return done, digest.hexdigest()


def hidden(folder: Path) -> list[Path]:
    """Return what was being made in a folder and never was."""
    return [path for path in folder.rglob(".*") if path.suffix in (".making", ".partial")]


def held(folder: Path) -> tuple[int, str]:
    """Return the `bits` of a folder, read in a process of its own: none that has read a store is forked."""
    here, there = FORK.Pipe()
    process = FORK.Process(target=_send_bits, args=(folder, there))
    process.start()
    found: tuple[int, str] = here.recv()
    process.join()
    return found


def _send_bits(folder: Path, answer: Connection) -> None:
    answer.send(bits(folder))


def disturbed(
    command: str,
    folder: Path,
    kills: int,
    moment: Callable[[], float],
    victim: Callable[[], str],
    whole: int,
    tally: Tally,
) -> int:
    """Kill a job so often unless it ends before, let it end, and return how often it was killed."""
    done = 0
    while done < kills:
        over, left = run(command, folder, moment(), victim())
        tally.orphans += left
        if over:
            break
        points = held(folder)[0]
        tally.kills["nothing" if not points else "all" if points == whole else "a part"] += 1
        done += 1
    tally.orphans += run(command, folder)[1]
    tally.hidden += len(hidden(folder))
    return done


def trial(count: int, seed: int, root: Path, kinds: Sequence[str] = tuple(JOBS)) -> dict[str, Tally]:
    """Kill jobs of all kinds in turn until so many kills are done."""
    chance, tallies, wanted = random.Random(seed), dict[str, Tally](), dict[str, tuple[int, str]]()
    left, number = count, 0
    while left:
        kind = kinds[number % len(kinds)]
        if kind not in tallies:
            folder = root / f"{kind}-undisturbed"
            folder.mkdir()
            began = time.monotonic()
            run(JOBS[kind], folder)
            tallies[kind] = Tally(time.monotonic() - began)
            wanted[kind] = held(folder)
        tally, folder = tallies[kind], root / f"{kind}-{number}"
        folder.mkdir()
        kills = min(left, chance.randint(1, MOST))
        victim = partial(chance.choice, VICTIMS if kind == "workers" else VICTIMS[:1])
        moment = partial(chance.uniform, 0, tally.seconds)
        left -= disturbed(JOBS[kind], folder, kills, moment, victim, wanted[kind][0], tally)
        tally.jobs += 1
        tally.other_bits += held(folder) != wanted[kind]
        number += 1
        print(f"{count - left} of {count} kills, {kind}", file=sys.stderr, flush=True)
    return tallies


def main() -> None:
    """Print what was killed, and whether it ended in the same bits."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--job", action="append", choices=list(JOBS))
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    for module in LOADED:
        importlib.import_module(f"gradscape.{module}")
    with tempfile.TemporaryDirectory() as root:
        tallies = trial(given.count, given.seed, Path(root), given.job or list(JOBS))
    if given.json:
        said = {kind: {"jobs": one.jobs, "kills": one.kills, "other_bits": one.other_bits, "hidden": one.hidden,
                       "orphans": one.orphans} for kind, one in tallies.items()}  # fmt: skip
        print(json.dumps(said))
    else:
        print(
            "| job | jobs | kills | with nothing, a part, all on disk | other bits | hidden files left "
            "| processes left |\n|---|---|---|---|---|---|---|"
        )
        for kind, one in tallies.items():
            at = ", ".join(str(one.kills[where]) for where in ("nothing", "a part", "all"))
            ends = f"{one.other_bits} | {one.hidden} | {one.orphans}"
            print(f"| {kind} | {one.jobs} | {one.kills.total()} | {at} | {ends} |")
    sys.exit(int(any(one.other_bits or one.hidden or one.orphans for one in tallies.values())))


if __name__ == "__main__":
    main()
