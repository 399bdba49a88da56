"""Results of every kind that the verbs leave, small: how each is made, what reads it, and what numbers it holds."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

MADE, READ = "made-1", "read-1"  # what a kind is made into, and where a verb that reads it writes: no words of English
CUT = "slice ackley --set dim=3 --dims 0 1 --resolution 6 --out"
SEARCH = "optimize ackley --set dim=3 --method cma-es --budget 30 --seed 1 --out"
BOUNCE = "bounce --fidelity draft --device cpu"
TURN = (
    "extremes bounce --fidelity draft --set horizon=0.05 --points 4 --knobs dt --precisions float64 --device cpu --out"
)
EXPORT = f"export {MADE} --out {READ}/table.csv"
GALLERY = f"gallery compute --resolution 6 --fidelity draft --device cpu --data {MADE}"

# What differs from one run to the next, or says only what was done now.
VOLATILE = {"seconds", "provenance", "created", "command", "files", "forwards", "gradient_cost", "resumed", "batch"}
VOLATILE |= {"folder", "wall", "versions", "episodes"}


@dataclass(frozen=True)
class Kind:
    """A kind of result: the command that makes it in `MADE`, what it needs beside it, and what reads it.

    `stop` is patched in the process that makes it, so that it ends unfinished; `where` holds what is worth damaging.
    """

    make: str
    reads: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    stop: Callable[[], object] | None = None
    where: str = MADE


def unfinished_slice() -> None:
    """Stop a slice when all its tiles are there."""
    from gradscape.landscapes.storage.store import SliceStore

    small()
    SliceStore.finish = _interrupted  # type: ignore[method-assign]


def unfinished_run() -> None:
    """Stop a search after some rows."""
    from gradscape.optim.runs import store

    small()
    store.PAUSE, store.SHARE = 0.0, math.inf  # writes after every proposal
    append = store.RunStore.append

    def stopped(filled: store.RunStore, *given: Any, **options: Any) -> None:
        if filled.count > 12:
            _interrupted()
        append(filled, *given, **options)

    store.RunStore.append = stopped  # type: ignore[method-assign]


def _interrupted(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


KINDS = {
    "slice": Kind(
        f"{CUT} {MADE}",
        (EXPORT, f"overlay {MADE} run --out {READ}", f"report {MADE} --points 2 --out {READ} --json", f"view {MADE}",
         f"surface {MADE} --out {READ}"),
        needs=(f"{SEARCH} run",),
    ),
    "line": Kind(
        f"bounce --axis y --resolution 16 --fidelity draft --device cpu --out {MADE}",
        (EXPORT, f"report {MADE} --points 2 --out {READ} --json"),
    ),
    "filling slice": Kind(f"{CUT} {MADE}", (EXPORT,), stop=unfinished_slice),
    "sweep": Kind(f"sweep ackley --set dim=3 --dims 0 1 --over 2 --frames 2 --resolution 4 --out {MADE}"),
    "run": Kind(
        f"{SEARCH} {MADE}",
        (EXPORT, f"overlay cut {MADE} --out {READ}", f"slice ackley --set dim=3 --dims 0 1 --resolution 3 "
         f"--through best:{MADE} --out {READ} --json", f"{SEARCH.replace('30', '40')} {MADE}"),
        needs=(f"{CUT} cut",),
    ),
    "stopped run": Kind(f"{SEARCH} {MADE}", (EXPORT,), stop=unfinished_run),
    "race": Kind(
        f"race ackley --set dim=3 --methods random,descents --seeds 2 --budget 16 --out {MADE}",
        (f"overlay cut {MADE} --out {READ}",),
        needs=(f"{CUT} cut",),
    ),
    "league": Kind(f"league branin ackley --methods random,descents --seeds 2 --budget 8 --device cpu --out {MADE}"),
    "pairs": Kind(f"pairs ackley --set dim=3 --samples 2 --out {MADE} --json"),
    "census": Kind(f"census ackley --set dim=3 --slices 4 --resolution 6 --out {MADE} --json"),
    "card": Kind(f"card --scene control --resolution 3 --out {MADE} --json"),
    "tradeoff": Kind(f"tradeoff bounce --device cpu --points 2 --variants precision --out {MADE} --json"),
    "kept tradeoff": Kind(
        f"tradeoff bounce --device cpu --set horizon=0.5 --points 2 --variants precision --out {MADE}",
        (f"slice bounce --device cpu --tolerance 20% --set horizon=0.5 --dims 0 1 --resolution 3 --out {READ}",),
        where="home/gradscape",
    ),
    "extremes": Kind(f"{TURN} {MADE} --json"),
    "kept extremes": Kind(f"{TURN} {MADE}", ("envs bounce",), where="home/gradscape"),
    "report": Kind(
        f"report cut --points 2 --out {MADE} --json",
        (f"report cut --points 2 --out {MADE} --figure-width-mm 85",),
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
    "gallery": Kind(
        f"{GALLERY} --only pinball-2-0-1 --part slices --part sweeps --part episodes --part searches --part reports",
        (f"gallery list --json --data {MADE}", f"gallery build --data {MADE} --out {READ}",
         f"report --all --points 2 --data {MADE} --out {READ} --json"),
    ),
    "gallery tradeoff": Kind(
        f"{GALLERY} --only bounce-y --part slices --part tradeoffs",
        (f"gallery build --data {MADE} --out {READ}",),
    ),
}  # fmt: skip


def leave_blank(put: Callable[[object, str, Any], object]) -> None:
    """Let pictures and frames of films be blank, and not laid out: most of what a small job takes is drawing them.

    `put` is setattr, or what does the same for a while.
    """
    from matplotlib.figure import Figure

    from gradscape.landscapes.draw.figures import page

    save = Figure.savefig

    def leave(figure: Figure, where: Any, **how: Any) -> None:
        if how.get("format") == "rgba":  # a frame, whose size is known
            where.write(bytes(4 * math.prod(figure.canvas.get_width_height())))
        else:
            save(Figure(figsize=(0.1, 0.1)), where, **how)

    put(Figure, "savefig", leave)
    put(page, "settle", lambda picture: None)


def small() -> None:
    """Let pictures be blank, nothing be repeated only to be timed, and searches and films of the gallery be few."""
    from gradscape.gallery import episodes as gallery_episodes
    from gradscape.gallery import measures as gallery_measures
    from gradscape.gallery import parts as gallery_parts
    from gradscape.landscapes import cost
    from gradscape.landscapes.measures import fidelity as tradeoff

    leave_blank(setattr)
    tradeoff.REPETITION = tradeoff.LARGEST = 0.002
    cost.MOMENT = cost.ENOUGH = cost.WARM_UP = 0.0
    gallery_parts.METHODS, gallery_parts.BUDGET = ("random",), 8
    gallery_parts.FRAMES, gallery_parts.COARSE = 2, 5
    gallery_episodes.LONGEST, gallery_episodes.HEIGHT = 2, 48
    gallery_measures.TRADEOFF_POINTS, gallery_measures.REPORT_POINTS = 2, 2
    gallery_measures.TURNED = ["precision"]


def nothing() -> None:
    """Let Ctrl-C come with the first episode, page or request, so that nothing is computed."""
    from http.server import ThreadingHTTPServer

    from gradscape.envs.base import Environment
    from gradscape.gallery.site import build

    for place, name in ((Environment, "evaluate"), (build, "build_site"), (ThreadingHTTPServer, "serve_forever")):
        setattr(place, name, _interrupted)


@dataclass(frozen=True)
class Numbers:
    """What a file says: `rows`, each with the place of a number that there may also be none of, or one `whole`."""

    rows: dict[str, str]
    whole: str = ""


def numbers(folder: Path) -> dict[str, Numbers]:
    """Return what files say, but for what differs every time; those that do not open are left out."""
    found = {}
    for path, read in _readable(folder):
        with suppress(Exception):  # whatever a damaged file raises
            found[str(path.relative_to(folder))] = read(path)
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
        if any(part.startswith(".") or part.endswith(".zarr") for part in parts[:-1]) or parts[-1].startswith("."):
            continue
        if path.suffix == ".zarr":
            yield path, _store
        elif path.suffix in kinds and path.name not in ("settings.json", "summary.json"):
            yield path, kinds[path.suffix]


def _store(path: Path) -> Numbers:
    from gradscape.landscapes.storage.paths import is_slice
    from gradscape.landscapes.storage.store import SliceStore
    from gradscape.optim.runs.store import RunStore

    dataset = SliceStore.open(path).dataset() if is_slice(path) else RunStore.open(path).dataset()
    return _of_dataset(dataset.drop_vars(["seconds", "forwards"], errors="ignore"))


def _zipped(path: Path) -> Numbers:
    from gradscape.gallery.runs import open_run

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
    """Return a JSON value without what differs every time."""
    if isinstance(value, dict):
        return {name: plain(inner) for name, inner in value.items() if name not in VOLATILE}
    if isinstance(value, list):
        return [plain(inner) for inner in value]
    return None if isinstance(value, float) and math.isnan(value) else value


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
