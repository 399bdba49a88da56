"""Make results with two checkouts, and compare what they stored bit for bit.

    python -m benchmarks.same_bits make OLD          # in the old checkout, then `make NEW` in the new one
    python -m benchmarks.same_bits compare OLD NEW   # in either

`make` runs the command lines of commands.txt, each in a process of its own; a blank line there waits for what stands
above it. `compare` reads arrays, records and tables with zarr, NumPy and JSON alone, and pictures by their pixels. Exit
code 1 says that a command failed, a value differs or a result is missing; pictures and names of values do not decide.
Results are matched by their folders, so an option may be renamed in the new checkout's commands.txt. To see whether a
checkout works with older results, copy their folder and `make` it again: each command keeps what is there, or refuses
it in one line.

What is measured in seconds is not compared, nor what names the code, the day or the command line.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import math
import os
import shlex
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

COMMANDS = Path(__file__).with_name("commands.txt")
OWN = """
import torch

from gradscape import Environment, Evaluation, Fidelity, ParameterSpace


class Bowl(Environment):
    name, space = "bowl", ParameterSpace.box(["a", "b", "c"], -1.0, 2.0)
    fidelities = {"exact": Fidelity("exact", 0.0, "float64")}

    def _evaluate(self, x, *, grad):
        return Evaluation((x**2).sum(dim=1), 2 * x if grad else None, torch.ones(len(x), dtype=torch.int64))
"""
Value = str | NDArray[Any]
VOLATILE = {"seconds", "gradient_cost", "forwards", "batch"}  # measured, or following from it
VOLATILE |= {"created", "command", "versions", "folder", "history", "source", "gradscape", "checksum", "key"}
TIMED = ("forward", "with_gradient", "batch")  # arrays of studies
EMBEDDED = ("identity", "provenance")  # attributes that may be JSON in text


def make(folder: Path, workers: int) -> int:
    """Run all command lines in a folder, and return how many failed."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "own.py").write_text(OWN)
    failed = 0
    with ThreadPoolExecutor(workers) as pool:
        for group in COMMANDS.read_text().strip().split("\n\n"):
            failed += sum(pool.map(lambda line: run(line, folder), group.splitlines()))
    return failed


def run(line: str, folder: Path) -> bool:
    """Run a command line, `words > NAME` where it prints its result, and say whether it failed."""
    words, _, printed = line.partition(" > ")
    environment = os.environ | {"OMP_NUM_THREADS": "1", "XDG_DATA_HOME": str(folder / "home")}
    done = subprocess.run(
        [sys.executable, "-m", "gradscape", *shlex.split(words)],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if printed and done.returncode in (0, 1):
        (folder / printed).mkdir(exist_ok=True)
        (folder / printed / "said.json").write_text(done.stdout)
    refused = done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1
    failed = done.returncode not in ((0, 1) if printed else (0,))
    if failed:
        print(f"{done.returncode}: landscape {words}\n  {done.stderr.strip()[-500:]}", file=sys.stderr, flush=True)
    return failed and not refused


def compare(old: Path, new: Path) -> int:
    """Print how many results of two folders are equal, or not; return how many hold other values or are missing."""
    counts, values, pictures = Counter[str](), 0, Counter[bool]()
    for name in [shlex.split(line)[-1] for line in COMMANDS.read_text().splitlines() if line]:
        if not (old / name).exists():
            continue
        wanted, found = contents(old / name), contents(new / name)
        differ, keys = differences(wanted, found), sorted(wanted.keys() ^ found.keys())
        outcome = "missing" if not found else "other values" if differ else "other keys" if keys else "equal"
        counts[outcome] += 1
        values += len(wanted)
        drawn, redrawn = pixels(old / name), pixels(new / name)
        pictures.update(drawn[file] == redrawn.get(file) for file in drawn)
        if outcome != "equal":
            said = differ or [f"{key} is {'gone' if key in wanted else 'new'}" for key in keys]
            print(f"{outcome}: {name}: {'; '.join(said[:5])}{f'; {len(said) - 5} more' if said[5:] else ''}")
    print(", ".join(f"{count} {outcome}" for outcome, count in counts.items()))
    print(f"{values} values and arrays; {pictures[False]} of {pictures.total()} pictures differ")
    return counts["other values"] + counts["missing"]


def contents(folder: Path) -> dict[str, Value]:
    """Return what a folder's files hold, by file and name; nothing where there is no folder."""
    found: dict[str, Value] = {}
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder).parts
        if not any(part.endswith(".zarr") or part.startswith(".") for part in inside[:-1]):
            found |= {f"{'/'.join(inside)} {name}": value for name, value in _values(path)}
    return found


def _values(path: Path) -> Iterator[tuple[str, Value]]:
    if path.suffix == ".zarr":
        yield from _stored(path)
    elif path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as found:
            yield from ((name, found[name]) for name in found if name not in TIMED)
    elif path.suffix == ".json":
        yield from _leaves(json.loads(path.read_text()))
    elif path.suffix == ".csv":
        rows = list(csv.DictReader(io.StringIO(path.read_text())))
        for column in rows[0] if rows else ():
            if not column.startswith(("seconds", "forwards")):
                yield column, " ".join(str(row[column]) for row in rows)


def _stored(path: Path) -> Iterator[tuple[str, Value]]:
    """Yield arrays with their dimensions, and attributes."""
    group = zarr.open_group(path, mode="r")
    found = {name: np.asarray(array[:]) for name, array in group.arrays()}
    timed = {"seconds"} | ({"forwards"} if np.isfinite(found.get("grad", np.nan)).any() else set())
    for name, array in group.arrays():
        if name not in timed:
            yield name, found[name]
        yield f"{name} dims", f"{array.metadata.dimension_names} {array.chunks}"  # type: ignore[union-attr]
        yield from ((f"{name} {where}", value) for where, value in _leaves(array.attrs.asdict()))
    attributes = {
        name: json.loads(value) if name in EMBEDDED and isinstance(value, str) else value
        for name, value in group.attrs.asdict().items()
    }
    yield from ((f"attribute {where}", value) for where, value in _leaves(attributes))


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Yield every number and word in a JSON value, with its place; numbers are written out to the last bit."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key not in VOLATILE:
                yield from _leaves(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list):
        yield f"{name} length", str(len(value))
        for number, inner in enumerate(value):
            yield from _leaves(inner, f"{name}[{number}]")
    else:
        yield name, json.dumps(value)


def pixels(folder: Path) -> dict[str, str]:
    """Return a digest of the pixels of every picture."""
    from matplotlib.image import imread

    return {
        str(path.relative_to(folder)): hashlib.sha256(np.ascontiguousarray(imread(path)).tobytes()).hexdigest()
        for path in sorted(folder.rglob("*.png"))
    }


def differences(wanted: dict[str, Value], found: dict[str, Value]) -> list[str]:
    """Name what both have with other bits, arrays first."""
    arrays, words = list[str](), list[str]()
    for name in sorted(wanted.keys() & found.keys()):
        one, other = wanted[name], found[name]
        if isinstance(one, str) or isinstance(other, str):
            words += [f"{name}: {str(one)[:80]} / {str(other)[:80]}"] if str(one) != str(other) else []
        elif (one.shape, one.dtype, one.tobytes()) != (other.shape, other.dtype, other.tobytes()):
            arrays.append(f"{name}: {_off(one, other)}")
    return arrays + words


def _off(one: NDArray[Any], other: NDArray[Any]) -> str:
    """Say by how much arrays differ."""
    if one.shape != other.shape or one.dtype != other.dtype:
        return f"{one.shape} {one.dtype} / {other.shape} {other.dtype}"
    if one.dtype.kind != "f":
        return f"{int((one != other).sum())} of {one.size} differ"
    equal = (one == other) | (np.isnan(one) & np.isnan(other))
    largest = float(np.nanmax(np.abs(one - other)[~equal], initial=0.0))
    return f"{math.prod(one.shape) - int(equal.sum())} of {one.size} differ, by up to {largest:.3g}"


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    making, comparing = verbs.add_parser("make"), verbs.add_parser("compare")
    making.add_argument("folder", type=Path)
    making.add_argument("--workers", type=int, default=2, help="commands that run at once")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    given = parser.parse_args()
    if given.verb == "make":
        sys.exit(int(bool(make(given.folder.resolve(), given.workers))))
    sys.exit(int(bool(compare(given.old, given.new))))


if __name__ == "__main__":
    main()
