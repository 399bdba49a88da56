"""What `landscape pairs` does and prints: the cost, progress, then pairs of parameters ranked."""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE

from ..envs.registry import make
from ..jobs.scene import provenance as provenance_of
from ..landscapes.capacity import Need, require
from ..landscapes.cost import duration
from .arguments import read_settings
from .search_report import search_progress
from .terminal import Console, table

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.measures.sensitivity import Design, Found

RECORD = "pairs.json"
NUMBERS = 60  # that are held for each parameter of a base point, copies included
COLUMNS = ("score", "sensitivity", "interaction", "ruggedness", "disagreement")
LEADERS = {"interaction": "strongest interaction", "ruggedness": "most rugged", "disagreement": "most misleading"}


def pairs(
    name: str,
    *,
    samples: int | None,
    fidelity: str | None,
    device: str,
    engine: str,
    seed: int,
    top: int,
    settings: Sequence[str],
    out: str | None,
    as_json: bool,
    force: bool,
) -> None:
    """Evaluate a shared design, rank all pairs by it, and say which slice to look at."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    env = make(name, fidelity=fidelity, device=device, engine=engine, **read_settings(settings))
    if env.space.dim < 2:
        raise ValueError(f"{name} has one parameter; a pair takes two")
    from ..landscapes.measures.sensitivity import Design, default_samples, explore
    from ..landscapes.storage.checkpoint import Checkpoint
    from ..landscapes.storage.disk import until_full
    from ..landscapes.storage.files import tidy, write_json

    samples = samples or default_samples(env.space.dim)
    require("samples", samples, lambda count: Need(8.0 * NUMBERS * env.space.dim * count))
    design = Design.sobol(env.space, samples, seed=seed)
    identity = {**env.identity(), "samples": samples, "seed": seed}
    folder = Path(out) if out else Path("out") / _folder(identity)
    pieces = Checkpoint.open(folder, identity, what="pairs", force=force)
    command = shlex.join(["landscape", *sys.argv[1:]])

    def kept() -> str:
        return f"{pieces.count()} batches are kept in {folder}"

    try:
        with until_full(kept):
            _announce(console, env, design, folder)
            with search_progress(console) as bar:
                task = bar.add_task("episodes", total=design.episodes)
                found = explore(env, design, pieces, follow=lambda done: bar.update(task, completed=done))
            provenance = provenance_of(env, command)
            record = _record(env, design, found)
            report = {**identity, "set": read_settings(settings), **record, "provenance": provenance}
            write_json(folder / RECORD, report)
    except KeyboardInterrupt:
        console.print(f"stopped: {kept()}; the same command goes on from there: {command}", markup=False)
        sys.exit(130)
    tidy(folder)
    if as_json:
        print(json.dumps({**report, "pairs": report["pairs"][:top], "folder": str(folder)}))
    show(report, Console(stderr=as_json), top)


def _record(env: Environment, design: Design, found: Found) -> dict[str, Any]:
    from ..landscapes.measures.sensitivity import rank

    return {
        "env": env.name,
        "episodes": design.episodes,
        "failed": found.failed,
        "spread": found.spread,
        "parameters": list(env.space.names),
        "total": found.total().tolist(),
        "pairs": rank(found),
    }


def _folder(identity: dict[str, Any]) -> str:
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:6]
    return "-".join(["pairs", identity["objective"], identity["fidelity"], str(identity["samples"]), digest])


def _announce(console: Console, env: Environment, design: Design, folder: Path) -> None:
    with console.status(f"{env.name}: preparing (kernels are compiled once, then kept)"):
        env.prepare()
        points = design.moved(range(1))[: env.preferred_batch]
        env.evaluate(points[:1], grad=False)
        began = time.perf_counter()
        env.evaluate(points, grad=False)
        each = (time.perf_counter() - began) / len(points)
    samples, dim = len(design.base), env.space.dim
    console.print(
        f"{env.name} · {env.fidelity.name} · {env.device} · {folder}\n{design.episodes} episodes, {samples} with "
        f"gradients, for {dim} parameters and {dim * (dim - 1) // 2} pairs: at most about "
        f"{duration(design.episodes * each)}; --samples lowers it",
        markup=False,
    )


def show(report: dict[str, Any], console: Console, top: int) -> None:
    """Print the highest pairs, who leads in each measure, and the command that slices the first."""
    rows, names = report["pairs"], report["parameters"]
    found = table("no.", "pair", *COLUMNS, box=SIMPLE)
    found.columns[0].no_wrap = True
    for row in rows[:top]:
        cells = ["" if row[name] is None else f"{row[name]:.3f}" for name in COLUMNS]
        found.add_row(" ".join(map(str, row["dims"])), _said(row, names), *cells)
    failed = f", {report['failed']} failed" if report["failed"] else ""
    said = f"{report['env']} · {report['fidelity']}: {report['episodes']} episodes{failed}; {len(rows)} pairs"
    console.print(said, markup=False, highlight=False)
    console.print(found)
    console.print(
        "sensitivity: share of the loss's variance that a slice shows on average; interaction: what both do only "
        "together; ruggedness: ups and downs along a tenth of the box, in standard deviations; disagreement of "
        "gradients with slopes over a twentieth of it: 0 none, 1 zero or opposite; "
        "score: sensitivity x (1 + the others).",
        markup=False,
    )
    for measure, title in LEADERS.items():
        best = max(rows, key=lambda row: -1.0 if row[measure] is None else row[measure])
        if best[measure] is not None:
            console.print(f"{title}: {_said(best, names)} ({' '.join(map(str, best['dims']))})", markup=False)
    first = " ".join(map(str, rows[0]["dims"]))
    command = f"landscape slice {report['env']} --dims {first} --fidelity {report['fidelity']}"
    options = "".join(f" --set {name}={value}" for name, value in report["set"].items())
    console.print(command + options, markup=False)


def _said(row: dict[str, Any], names: Sequence[str]) -> str:
    return " \N{MULTIPLICATION SIGN} ".join(names[axis] for axis in row["dims"])
