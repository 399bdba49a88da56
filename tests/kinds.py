"""Small results of every kind that the verbs leave: how each is made, what reads it, and what numbers it holds."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any
from warnings import catch_warnings

import numpy as np
import pytest

from gradscape.cli import main
from gradscape.landscapes.storage.paths import ARCHIVE, FILLING, FOLDER, finished_path, is_slice

from .clock import Clock
from .command import Said

ROOT = tempfile.TemporaryDirectory(prefix="gradscape-tests-")  # of all folders, for as long as tests run
MADE, READ = "made-1", "read-1"  # what a kind is made into, and where a verb that reads it writes
CUT = "slice ackley --set dim=3 --dims 0 1 --resolution 6 --out"
SEARCH = "optimize ackley --set dim=3 --method cma-es --budget 30 --seed 1 --out"
BOUNCE = "bounce --fidelity draft --device cpu"
TURN = (
    "study extremes bounce --fidelity draft --set horizon=0.05 --points 4 --settings dt --precisions float64 "
    "--device cpu --out"
)
EXPORT = f"export {MADE} --out {READ}/table.csv"
GALLERY = f"gallery compute --resolution 6 --fidelity draft --device cpu --data {MADE}"

# What differs from one run to the next, or says only what was done now.
VOLATILE = {"seconds", "provenance", "created", "command", "files", "forwards", "gradient_cost", "resumed", "batch"}
VOLATILE |= {"folder", "wall", "versions", "episodes"}


@dataclass(frozen=True)
class Kind:
    """A kind of result: the command that makes it in `MADE`, what reads it, and what has to be there before.

    `where` is the folder that may be damaged.
    """

    make: str
    reads: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    where: str = MADE


KINDS = {
    "slice": Kind(
        f"{CUT} {MADE}",
        (EXPORT, f"overlay {MADE} run --out {READ}", f"report {MADE} --points-per-axis 2 --out {READ} --json",
         f"view {MADE}", f"surface {MADE} --out {READ}"),
        needs=(f"{SEARCH} run",),
    ),
    "line": Kind(
        f"bounce --axis y --resolution 16 --fidelity draft --device cpu --out {MADE}",
        (EXPORT, f"report {MADE} --points-per-axis 2 --out {READ} --json"),
    ),
    "sweep": Kind(f"sweep ackley --set dim=3 --dims 0 1 --over 2 --frames 2 --resolution 4 --out {MADE}"),
    "run": Kind(
        f"{SEARCH} {MADE}",
        (EXPORT, f"overlay cut {MADE} --out {READ}", f"slice ackley --set dim=3 --dims 0 1 --resolution 3 "
         f"--through best:{MADE} --out {READ} --json", f"{SEARCH.replace('30', '40')} {MADE}"),
        needs=(f"{CUT} cut",),
    ),
    "race": Kind(
        f"race ackley --set dim=3 --methods random,descents --seeds 2 --budget 16 --out {MADE}",
        (f"overlay cut {MADE} --out {READ}",),
        needs=(f"{CUT} cut",),
    ),
    "league": Kind(f"league branin ackley --methods random,descents --seeds 2 --budget 8 --device cpu --out {MADE}"),
    "pairs": Kind(f"pairs ackley --set dim=3 --samples 2 --out {MADE} --json"),
    "hessian": Kind(f"hessian ackley --set dim=3 --through random:1 --out {MADE} --json"),
    "remedy": Kind(f"remedy ackley --set dim=3 --starts 6 --budget 16 --remedies smooth:2%:first:4 --out {MADE}"),
    "advise": Kind(f"advise ackley --set dim=3 --budget 200 --device cpu --out {MADE} --json"),
    "census": Kind(f"census ackley --set dim=3 --slices 4 --resolution 6 --out {MADE} --json"),
    "check": Kind(f"check branin --power 50% --device cpu --out {MADE} --json"),
    "card": Kind(f"card --scene control --resolution 3 --out {MADE} --json"),
    "fidelity": Kind(f"study fidelity bounce --device cpu --points 2 --settings precision --out {MADE} --json"),
    "kept fidelity": Kind(
        f"study fidelity bounce --device cpu --set horizon=0.5 --points 2 --settings precision --out {MADE}",
        (f"slice bounce --device cpu --tolerance 20% --set horizon=0.5 --dims 0 1 --resolution 3 --out {READ}",),
        where="home/gradscape",
    ),
    "extremes": Kind(f"{TURN} {MADE} --json"),
    "kept extremes": Kind(f"{TURN} {MADE}", ("envs bounce",), where="home/gradscape"),
    "report": Kind(
        f"report cut --points-per-axis 2 --out {MADE} --json",
        (f"report cut --points-per-axis 2 --out {MADE} --figure-width-mm 85",),
        needs=(f"{CUT} cut",),
    ),
    "overlay": Kind(
        f"overlay cut run --through best --resolution 4 --out {MADE}",
        needs=(f"{CUT} cut", f"{SEARCH} run"),
    ),
    "comparison": Kind(
        f"compare cut ackley --set dim=3 --out {MADE} --json", needs=(f"{CUT} cut",)
    ),
    "replay": Kind(f"replay {BOUNCE} --no-film --out {MADE}"),
    "surface": Kind(f"surface cut run --out {MADE}", needs=(f"{CUT} cut", f"{SEARCH} run")),
    "gallery": Kind(
        f"{GALLERY} --only pinball-2-0-1 --part slices --part sweeps --part episodes --part searches --part reports",
        (f"gallery list --json --data {MADE}", f"gallery build --data {MADE} --out {READ}",
         f"report --all --points-per-axis 2 --data {MADE} --out {READ} --json"),
    ),
    "gallery study": Kind(
        f"{GALLERY} --only bounce-y --part slices --part fidelities",
        (f"gallery build --data {MADE} --out {READ}",),
    ),
}  # fmt: skip


def quicken(put: Callable[[object, str, Any], object]) -> None:
    """Let nothing be repeated only to be timed, all take the same time, and searches and films of the gallery be few.

    `put` is setattr, or what does the same for a while.
    """
    from gradscape.gallery import parts as gallery_parts
    from gradscape.landscapes import cost
    from gradscape.optim.runs import store
    from gradscape.studies import samples

    for place, values in (
        # Which fidelity is the quickest is no matter of chance: each evaluation takes one tick, exact in binary.
        (samples, {"REPETITION": 0.002, "LARGEST": 0.002, "time": Clock(tick=2**-10)}),
        (cost, {"MOMENT": 0.0, "ENOUGH": 0.0, "WARM_UP": 0.0, "time": Clock(tick=2**-10)}),  # so does a gradient
        (store, {"PAUSE": 0.0, "SHARE": math.inf}),  # writes after every proposal
        (gallery_parts, {"METHODS": ("random",), "BUDGET": 8, "SWEEP_FRAMES": 2, "SWEEP_RESOLUTION": 5}),
        (gallery_parts, {"EPISODE_FRAMES": 2, "EPISODE_HEIGHT": 48}),
        (gallery_parts, {"STUDY_POINTS": 2, "REPORT_POINTS": 2, "CHANGED": ("precision",)}),
    ):
        for name, value in values.items():
            put(place, name, value)


def files(folder: Path) -> list[Path]:
    """Return every file under a folder."""
    return sorted(file for file in folder.rglob("*") if file.is_file())


def say(command: str, folder: Path) -> Said:
    """Run a command in this process and in a folder, which holds the user's data and temporary files, too."""
    out, err = StringIO(), StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        chdir(folder),
        redirect_stdout(out),
        redirect_stderr(err),
        catch_warnings(record=True, action="always") as warned,
    ):
        for name, place in (("XDG_DATA_HOME", "home"), ("TMPDIR", "tmp")):
            (folder / place).mkdir(exist_ok=True)
            patch.setenv(name, str(folder / place))
        patch.setattr(tempfile, "tempdir", None)
        patch.setenv("COLUMNS", "160")
        patch.setattr(sys, "argv", ["landscape", *command.split()])
        quicken(patch.setattr)
        code = 0
        try:
            main(command.split())
        except SystemExit as left:
            code = int(left.code or 0)
    return Said(code, out.getvalue(), "".join(f"{one.message}\n" for one in warned) + err.getvalue())


def printed(out: str) -> str:
    """Return what was printed, of JSON what is the same every time."""
    try:
        return json.dumps(plain(json.loads(out)), sort_keys=True)
    except ValueError:
        return ""


@cache
def before(kind: str) -> Path:
    """Return a folder with what a kind needs."""
    folder = Path(tempfile.mkdtemp(dir=ROOT.name))
    for command in KINDS[kind].needs:
        assert say(command, folder).returncode == 0, command
    return folder


@cache
def whole(kind: str) -> Path:
    """Return a folder with a whole result of a kind."""
    folder = copy(before(kind))
    done = say(KINDS[kind].make, folder)
    assert done.returncode == 0, done.stderr
    return folder


@cache
def undisturbed(kind: str, command: str) -> tuple[dict[str, Numbers], str]:
    """Return the numbers, and what is printed, after a command on a whole result."""
    folder = copy(whole(kind))
    done = say(command, folder)
    return numbers(folder), printed(done.stdout)


def copy(folder: Path) -> Path:
    """Return a copy of a folder."""
    place = Path(tempfile.mkdtemp(dir=ROOT.name))
    shutil.copytree(folder, place, symlinks=True, dirs_exist_ok=True)
    return place


@dataclass(frozen=True)
class Numbers:
    """What a file says: `rows`, each with the place of a number that there may also be none of, or one `whole`."""

    rows: dict[str, str]
    whole: str = ""


def numbers(folder: Path) -> dict[str, Numbers]:
    """Return what files say, but for what differs every time; those that do not open are left out.

    A slice that is being filled says what it will say when it is finished.
    """
    found = {}
    for path, read in _readable(folder):
        with suppress(Exception):  # whatever a damaged file raises
            found[str(finished_path(path).relative_to(folder))] = read(path)
    return found


def wrong(found: dict[str, Numbers], wanted: dict[str, Numbers]) -> list[str]:
    """Name what is there and says other numbers than it should; what is not there is not wrong."""
    return [
        name
        for name, here in found.items()
        if (right := wanted.get(name)) is None
        or here.whole != right.whole
        or any(right.rows.get(place) != value for place, value in here.rows.items())
    ]


def missing(found: dict[str, Numbers], wanted: dict[str, Numbers]) -> list[str]:
    """Name what should be there and is not, whole or in part; what only pictures are drawn from may lack."""
    return [
        name
        for name, right in wanted.items()
        if not name.endswith(".npz") and ((here := found.get(name)) is None or here.rows.keys() != right.rows.keys())
    ]


def _readable(folder: Path) -> Iterator[tuple[Path, Callable[[Path], Numbers]]]:
    kinds = {".json": _json, ".csv": _table, ".npz": _arrays, ".js": _text, ".zip": _zipped}
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        if any(part.startswith(".") or part.endswith((".zarr", FILLING)) for part in parts[:-1]):
            continue
        if path.name.startswith("."):
            continue
        if path.suffix in (".zarr", FILLING) or (path.name.endswith(FOLDER + ARCHIVE) and is_slice(path)):
            yield path, _store
        elif path.suffix in kinds and path.name not in ("settings.json", "summary.json"):
            yield path, kinds[path.suffix]


def _store(path: Path) -> Numbers:
    from gradscape.landscapes.storage.store import SliceStore
    from gradscape.optim.runs.store import RunStore

    dataset = SliceStore.open(path).dataset() if is_slice(path) else RunStore.open(path).dataset()
    return _of_dataset(dataset.drop_vars(["seconds", "forwards"], errors="ignore"))


def _zipped(path: Path) -> Numbers:
    from gradscape.gallery.records import open_run

    return _of_dataset(open_run(path).drop_vars(["seconds", "forwards"], errors="ignore"))


def _of_dataset(dataset: Any) -> Numbers:
    """Return the bits at each point that has a status; those of its place, and what names it, belong to the whole."""
    status = dataset["status"].to_numpy()
    names = sorted(str(name) for name in dataset.data_vars)
    axes = b"".join(dataset[name].to_numpy().tobytes() for name in ("u", "v") if name in dataset)
    rows = {
        str(place): _digest(b"".join(dataset[name].to_numpy()[place].tobytes() for name in names))
        for place in np.ndindex(status.shape)
        if status[place] > 0
    }
    return Numbers(rows, _digest(axes))


def _json(path: Path) -> Numbers:
    from gradscape.landscapes.storage.records import verify

    found = json.loads(path.read_text())
    said = [verify(one) for one in found] if isinstance(found, list) else verify(found)
    return Numbers({}, _digest(json.dumps(plain(said), sort_keys=True).encode()))


def plain(value: Any) -> Any:
    """Return a JSON value without what differs every time; a number is the same as 1 and as 1.0."""
    if isinstance(value, dict):
        return {name: plain(inner) for name, inner in value.items() if name not in VOLATILE}
    if isinstance(value, list):
        return [plain(inner) for inner in value]
    if isinstance(value, int | float) and not isinstance(value, bool):
        return None if math.isnan(value) else float(value)
    return value


def _table(path: Path) -> Numbers:
    """Return a table's rows by number, but for those that say that nothing is there."""
    rows = list(csv.DictReader(io.StringIO(path.read_text())))
    kept = {
        str(number): json.dumps(
            {name: cell for name, cell in row.items() if not name.startswith(("seconds", "forwards"))}
        )
        for number, row in enumerate(rows)
        if row.get("status") != "missing"
    }
    return Numbers(kept)


def _arrays(path: Path) -> Numbers:
    timed = ("forward", "with_gradient", "batch")
    with np.load(path, allow_pickle=False) as arrays:
        return Numbers({}, _digest(b"".join(arrays[name].tobytes() for name in sorted(arrays) if name not in timed)))


def _text(path: Path) -> Numbers:
    return Numbers({}, _digest(path.read_bytes()))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
