"""The README's picture: a slice of `fluid`, and the episodes at three of its nodes, one after another.

python -m docs.pages.hero     # simulates three episodes: some minutes of two cores
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

import gradscape as gs
from gradscape.gallery.files import DATA, EPISODES
from gradscape.gallery.records import read_nodes
from gradscape.landscapes.draw import style
from gradscape.landscapes.draw.figures.contour import slopes
from gradscape.landscapes.draw.film import picture
from gradscape.landscapes.draw.render.replay import frames, pick_frames
from gradscape.landscapes.identity import plane_of, stored_identity
from gradscape.landscapes.storage.store import open_slice

FIGURE, PLACE = "fluid-6-8", Path(__file__).parents[1] / "hero.webp"
ORDER = ("highest loss", "median loss", "lowest loss")
HEIGHT, DPI = 360, 80  # of the film [pixels]
EVERY = 8  # samples from arrow to arrow
FRAMES, RATE, REST = 36, 12, 10  # of an episode, a second, and that its end stays


def main() -> None:
    """Write the picture as an animated WebP."""
    pictures = [Image.fromarray(one) for one in whole()]
    pictures[0].save(
        PLACE, "WEBP", save_all=True, append_images=pictures[1:], duration=1000 // RATE, loop=0, quality=70, method=6
    )
    print(f"{PLACE}: {len(pictures)} pictures, {PLACE.stat().st_size / 1e6:.1f} MB")


def whole() -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures: the map with the node that is shown, and next to it the episode there."""
    folder = DATA / FIGURE
    dataset = open_slice(folder)
    plane, identity = plane_of(dataset), stored_identity(dataset)
    env = gs.make(identity["objective"], fidelity=identity["fidelity"], device="cpu")
    nodes = {one.why: one for one in read_nodes(folder / EPISODES)}
    for why in ORDER:
        node = nodes[why]
        place = torch.stack([axis[at] for axis, at in zip(plane.axes(), (node.column, node.row), strict=True)])
        episode = env.episode(plane.lift(place[None])[0])
        shown = list(frames(episode, pick_frames(episode, FRAMES), height=HEIGHT))
        left = draw_map(dataset, place.tolist(), f"{why}: {node.loss:.3f} m")
        for frame in [*shown, *[shown[-1]] * REST]:
            yield np.concatenate([left, np.ascontiguousarray(frame[: len(left)])], axis=1)


def draw_map(dataset: Any, place: list[float], said: str) -> NDArray[np.uint8]:
    """Draw the losses and the directions of steepest descent, with the node."""
    figure = Figure(figsize=(1.3 * HEIGHT / DPI, HEIGHT / DPI), dpi=DPI, layout="constrained")
    ax = figure.subplots()
    u, v = (dataset[name].to_numpy() for name in ("u", "v"))
    mesh = ax.pcolormesh(u, v, dataset["loss"].to_numpy(), cmap=style.LOSS_MAP, shading="nearest")
    figure.colorbar(mesh, ax=ax, label="loss [m]")
    rows, columns = (slice(EVERY // 2, None, EVERY) for _ in range(2))
    down = -slopes(dataset)[rows, columns]
    down = down / np.linalg.norm(down, axis=-1, keepdims=True)
    ax.quiver(u[columns], v[rows], down[..., 0], down[..., 1], color="white", alpha=0.8, pivot="mid", width=0.005)
    for width, colour in ((5.0, "white"), (2.5, "#b5367a")):
        ax.plot(*place, "o", markersize=13, markerfacecolor="none", markeredgecolor=colour, markeredgewidth=width,
                clip_on=False, zorder=5)  # fmt: skip
    ax.set_title(said, fontsize=12)
    ax.set_xlabel(dataset["u"].attrs["label"])
    ax.set_ylabel(dataset["v"].attrs["label"])
    return picture(figure, dpi=DPI)


if __name__ == "__main__":
    main()
