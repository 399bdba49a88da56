"""Search the losses of MPM scenes for ripples with the wavelength of a grid cell.

    python -m benchmarks.ripples [fluid torus assembly table triple-move] [--grids 0.75 1 1.5 2] [--lines 8]

Losses are taken along lines through random base points, each along one parameter that moves a tool by several cells.
The ripple at a wavelength comes from the spectrum of the line's second differences, as an amplitude relative to the
line's range [%]. `own` is the largest near the wavelength of the grid's own cells, `others` that of grids with other
sizes at the same wavelength. Ripples of the landscape are in both, ripples of the cells only in the first, and `excess`
is the root of the difference of their squares. Values are medians over lines, and the largest excess. The last line
gives the difference of gradients from slopes over 1e-4 and 1e-2 of the box in random directions.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

import gradscape as gs
from gradscape.envs.mpm.scene import MpmScene
from gradscape.landscapes.objective import Status, evaluate

SCENES = ("fluid", "torus", "assembly", "table", "triple-move")
SAMPLES = 128  # of a line
PARTS = (1e-4, 1e-2)  # of the box over which slopes are taken
INNER = 0.5  # part of the box in which base points lie, so that few tools are held back at walls
AROUND = (0.92, 1.09)  # times the cells' frequency where their ripple is looked for
PADDED = 16  # times the samples that a spectrum is computed on


def lines_of(space: gs.ParameterSpace, count: int, seed: int = 0) -> Tensor:
    """Return points of lines along the parameters in turn, shape (line, sample, dim)."""
    points = inner_points(space, count, seed)[:, None].repeat(1, SAMPLES, 1)
    for k in range(count):
        axis = k % points.shape[2]
        points[k, :, axis] = torch.linspace(float(space.lower[axis]), float(space.upper[axis]), SAMPLES)
    return points


def inner_points(space: gs.ParameterSpace, count: int, seed: int) -> Tensor:
    """Return Sobol points of the inner part of the box, shape (count, dim)."""
    lower, upper = (torch.as_tensor(side, dtype=torch.float64) for side in (space.lower, space.upper))
    drawn = torch.quasirandom.SobolEngine(len(lower), scramble=True, seed=seed).draw(count).double()
    return lower + (upper - lower) * (0.5 + INNER * (drawn - 0.5))


def cells_crossed(env: MpmScene, lines: Tensor) -> np.ndarray:
    """Return the largest tool movement along each line at the episode's end, in cells, shape (line,)."""
    first, last = (env.tools(lines[:, k])[:, -1] for k in (0, -1))
    return ((last - first).abs().amax(dim=(1, 2)) / env.model.dx).numpy()


def amplitude(losses: np.ndarray, cycles: float) -> float:
    """Return the largest amplitude of a line's ripples near this many cycles along it, relative to the line's range.

    NaN where a sample failed, or where a ripple has fewer than four samples.
    """
    n = len(losses)
    window = np.hanning(n - 2)
    spectrum = np.abs(np.fft.rfft(np.diff(losses, 2) * window, PADDED * n)) * 2.0 / window.sum()
    per_sample = np.fft.rfftfreq(PADDED * n)
    found = per_sample * (n - 1)
    near = (found > AROUND[0] * cycles) & (found < AROUND[1] * cycles)
    if not near.any() or AROUND[1] * cycles > (n - 1) / 4:
        return float("nan")
    return float((spectrum[near] / (2.0 - 2.0 * np.cos(2.0 * np.pi * per_sample[near]))).max() / np.ptp(losses))


def losses_of(env: gs.Environment, lines: Tensor) -> np.ndarray:
    """Return the losses along lines, shape (line, sample)."""
    found = evaluate(env, lines.reshape(-1, lines.shape[2]), grad=False)
    losses = found.loss.masked_fill(found.status != int(Status.OK), float("nan"))
    return losses.reshape(lines.shape[:2]).double().cpu().numpy()


def compare(losses: Mapping[int, np.ndarray], crossed: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Return the ripples of each grid's lines at its own wavelength, and of others there [%], shape (line, 2)."""
    found = {}
    for cells, cycles in crossed.items():
        rest = [line for other, line in losses.items() if other != cells]
        pairs = [
            (amplitude(losses[cells][k], many), np.mean([amplitude(lines[k], many) for lines in rest]))
            for k, many in enumerate(cycles)
        ]
        found[cells] = 100.0 * np.array(pairs)
    return found


def slopes(env: gs.Environment, count: int = 48, seed: int = 1) -> list[float]:
    """Return the median difference of gradients from slopes over PARTS of the box, relative to the slopes."""
    space = env.space
    x = inner_points(space, count, seed)
    generator = torch.Generator().manual_seed(seed)
    way = torch.nn.functional.normalize(torch.randn(x.shape, generator=generator, dtype=torch.float64), dim=1)
    way = way * (torch.as_tensor(space.upper) - torch.as_tensor(space.lower))
    gradient = (evaluate(env, x, grad=True).grad.cpu().double() * way).sum(dim=1)
    off = []
    for part in PARTS:
        ends = evaluate(env, torch.cat([x + part / 2 * way, x - part / 2 * way]), grad=False).loss.cpu().double()
        slope = (ends[:count] - ends[count:]) / part
        off.append(float(((gradient - slope).abs() / slope.abs()).nanmedian()))
    return off


def on_grid(env: MpmScene, part: float) -> MpmScene:
    """Return a scene on a grid with this factor on its cells, with smaller steps if cells are smaller."""
    known = env.fidelity
    cells = round(part * known.resolution)
    finer = cells / known.resolution
    dt = env.control_step / round(env.control_step / known.dt * max(1.0, finer))
    particles = round(known.particles * finer**3)
    fidelity = replace(known, name=f"{cells} cells", resolution=cells, dt=dt, particles=particles)
    return env.remake(fidelity=fidelity)


def table(standard: MpmScene, grids: Sequence[float], count: int) -> list[str]:
    """Return the rows of one scene, of which `standard` is the environment at that fidelity."""
    lines = lines_of(standard.space, count)
    losses, crossed = {}, {}
    for part in grids:
        env = on_grid(standard, part)
        cells = env.fidelity.resolution
        losses[cells], crossed[cells] = losses_of(env, lines), cells_crossed(env, lines)
    rows = []
    for cells, found in compare(losses, crossed).items():
        excess = np.sqrt(np.maximum(found[:, 0] ** 2 - found[:, 1] ** 2, 0.0))
        numbers = (np.median(crossed[cells]), *np.nanmedian(found, axis=0), np.nanmedian(excess), np.nanmax(excess))
        rows.append(f"| {standard.name} | {cells} | " + " | ".join(f"{number:.2f}" for number in numbers) + " |")
    return rows


def main() -> None:
    """Print the table of each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", help=f"default: {' '.join(SCENES)}")
    parser.add_argument("--grids", type=float, nargs="+", default=[0.75, 1.0, 1.5, 2.0], help="times standard's cells")
    parser.add_argument("--lines", type=int, default=10)
    parser.add_argument("--device", default="auto")
    given = parser.parse_args()
    print("| scene | cells | crossed | own [%] | others [%] | excess [%] | greatest [%] |", "|---" * 7 + "|", sep="\n")
    for name in given.scenes or SCENES:
        standard = gs.make(name, fidelity="standard", device=given.device)
        print("\n".join(table(standard, given.grids, given.lines)), flush=True)
        off = " and ".join(f"{100 * one:.1f} %" for one in slopes(standard))
        print(f"\n{name}: gradients differ from the slopes over {PARTS} of the box by {off} (medians)\n", flush=True)


if __name__ == "__main__":
    main()
