"""Search for the point of each of the gallery's figures: the one with losses closest to the paper's.

    python -m benchmarks.base_points [FIGURE|ENV ...] [--resolution 8] [--random 32] [--fidelity standard]
        [--device auto] [--out benchmarks/data/base-points] [--write]

The paper gives the ends of its colour bars, but not the points of its slices. For each figure whose environment has
such ends in gallery/paper.toml, losses are evaluated on a small grid over the figure's plane, through the centre, each
example of the scene, and random:1 to random:32. The chosen point has the smallest error of its lowest and highest loss:

    (|lowest - paper's lowest| + |highest - paper's highest|) / (paper's highest - paper's lowest)

The choice ignores ruggedness. A figure that varies all parameters is the same through every point. A point with a tenth
or more of failed episodes is not chosen. Results are stored in the folder --out, a file for each figure, and a stored
search with the same code of the scene is not repeated. --write puts points and results into gallery/figures.toml.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gradscape.envs.base import Environment
from gradscape.envs.registry import environment_class
from gradscape.gallery.figures import Figure, choose_figures, read_figures
from gradscape.gallery.files import FIGURES
from gradscape.gallery.paper import read_paper
from gradscape.gallery.parts import points_beside
from gradscape.landscapes.objective import Evaluation, Status, evaluate
from gradscape.landscapes.storage.records import read_json, write_record

DATA = Path(__file__).parent / "data" / "base-points"
MOST_FAILED = 0.1  # of a candidate's episodes
DIGITS = 4


@dataclass(frozen=True)
class Candidate:
    """A point that a figure could go through: the ends of its losses, its share of failures, its distance."""

    through: str
    lowest: float
    highest: float
    failed: float
    distance: float

    @classmethod
    def of(cls, through: str, loss: Tensor, failed: Tensor, paper: tuple[float, float]) -> Candidate:
        """Measure the losses of a grid, in the objective's unit; the distance is infinite where too many failed."""
        share = float(failed.double().mean())
        if share >= MOST_FAILED:
            return cls(through, math.nan, math.nan, share, math.inf)
        lowest, highest = float(loss[~failed].min()), float(loss[~failed].max())
        return cls(through, lowest, highest, share, distance((lowest, highest), paper))

    def record(self) -> dict[str, Any]:
        """Return it as plain JSON: null for what is not known."""
        plain = {
            name: value if math.isfinite(value) else None for name, value in vars(self).items() if name != "through"
        }
        return {"through": self.through, **plain}


def distance(found: tuple[float, float], paper: tuple[float, float]) -> float:
    """Return the error of both ends of a range of losses, in widths of the paper's range."""
    return (abs(found[0] - paper[0]) + abs(found[1] - paper[1])) / (paper[1] - paper[0])


def names_of(env: Environment, count: int) -> list[str]:
    """Return the candidate points of figures: the centre, the examples, and this many random ones."""
    return ["center", *(f"example:{name}" for name in env.examples), *(f"random:{n}" for n in range(1, count + 1))]


def search(
    figure: Figure, env: Environment, resolution: int, count: int, paper: tuple[float, float]
) -> list[Candidate]:
    """Measure all candidates of a figure, their grids in common batches; the nearest first."""
    names = names_of(env, count)
    grids = [replace(figure, through=name).plane(env, resolution).grid() for name in names]
    points = torch.stack(grids).reshape(-1, env.space.dim)
    parts = (evaluate(env, x, grad=False) for x in _batches(points, env.preferred_batch, figure.id))
    found = Evaluation.join(parts, dim=env.space.dim, grad=False)
    failed = found.status != Status.OK
    rows = zip(names, found.loss.reshape(len(names), -1), failed.reshape(len(names), -1), strict=True)
    return sorted((Candidate.of(*row, paper) for row in rows), key=lambda one: one.distance)


def _batches(points: Tensor, size: int, name: str) -> Iterator[Tensor]:
    parts = torch.split(points, size)
    for number, part in enumerate(parts):
        print(f"\r{name}: {number * size} of {len(points)} episodes", end="", file=sys.stderr, flush=True)
        yield part
    print(f"\r{name}: {len(points)} of {len(points)} episodes", file=sys.stderr)


def write_choice(path: Path, figure: str, found: dict[str, Any]) -> None:
    """Replace the point and its result in the figure's table of a list of figures."""
    text = path.read_text()
    heads = [match.start() for match in re.finditer(r"^\[\[figure\]\]$", text, flags=re.MULTILINE)] + [len(text)]
    blocks = [text[: heads[0]], *(text[low:high] for low, high in pairwise(heads))]
    (number,) = (n for n, block in enumerate(blocks) if f'\nid = "{figure}"\n' in block)
    kept = [line for line in blocks[number].rstrip("\n").split("\n") if not re.match(r"(through|searched) = ", line)]
    best = found["candidates"][0]
    result = {
        "losses": [round(best["lowest"], DIGITS), round(best["highest"], DIGITS)],
        "paper": found["paper"],
        "distance": round(best["distance"], DIGITS),
        "candidates": len(found["candidates"]),
    }
    plain = ", ".join(f"{key} = {json.dumps(value)}" for key, value in result.items())
    kept += [f'through = "{best["through"]}"', f"searched = {{ {plain} }}"]
    end = "\n\n" if number < len(blocks) - 1 else "\n"
    path.write_text("".join([*blocks[:number], "\n".join(kept) + end, *blocks[number + 1 :]]))


def _measure(figure: Figure, asked: argparse.Namespace, paper: tuple[float, float], path: Path) -> dict[str, Any]:
    """Return the result of a figure, from its folder if stored with these settings."""
    kind = environment_class(figure.env)
    settings = {
        **{"figure": figure.id, "dims": list(figure.dims), "options": dict(figure.options), "paper": list(paper)},
        **{"fidelity": asked.fidelity, "resolution": asked.resolution, "random": asked.random},
        "model_version": kind.version_on(kind.engines[0]),
    }
    if path.exists() and {name: (kept := read_json(path)).get(name) for name in settings} == settings:
        print(f"{figure.id}: already stored", file=sys.stderr)
        return dict(kept)
    env = figure.scene(asked.device, asked.fidelity).make()
    found = search(figure, env, asked.resolution, asked.random, paper)
    record = {**settings, "device": env.device, "candidates": [one.record() for one in found]}
    write_record(path, record)
    return record


def main(arguments: Sequence[str] | None = None) -> int:
    """Search, print what was found, and write it into the list of figures if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("only", nargs="*", metavar="FIGURE|ENV", help="figures or environments, by default all")
    parser.add_argument("--resolution", type=int, default=8, help="points along each axis of a grid")
    parser.add_argument("--random", type=int, default=32, help="random points")
    parser.add_argument("--fidelity", default="standard")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", type=Path, default=DATA)
    parser.add_argument("--figures", type=Path, default=FIGURES, help="the list of figures")
    parser.add_argument("--write", action="store_true", help="write the results into the list of figures")
    asked = parser.parse_args(arguments)
    words = read_paper().words
    asked.out.mkdir(parents=True, exist_ok=True)
    for figure in choose_figures(read_figures(asked.figures), asked.only):
        if not points_beside(figure):
            print(f"{figure.id}: it varies all parameters, so it is the same through every point")
            continue
        paper = words[figure.env].losses if figure.env in words else None
        if paper is None:
            print(f"{figure.id}: the paper has no colour bar of {figure.env}; it keeps {figure.through}")
            continue
        found = _measure(figure, asked, paper, asked.out / f"{figure.id}.json")
        if (best := found["candidates"][0])["distance"] is None:
            print(f"{figure.id}: a tenth of the episodes or more fail at every point; it keeps {figure.through}")
            continue
        ends = f"{best['lowest']:.4g} to {best['highest']:.4g}, the paper's {paper[0]:g} to {paper[1]:g}"
        print(f"{figure.id}: {best['through']}, losses {ends}, distance {best['distance']:.3g}")
        if asked.write:
            write_choice(asked.figures, figure.id, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
