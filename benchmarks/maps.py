"""Move and turn the pictures of a gallery's page in Chromium, and say how much of a frame's time that takes.

    python -m benchmarks.maps [--resolution 256] [--frames 120] [--site FOLDER]

A page of a made-up slice, rugged and with failures, is built for each of two sizes, 48 x 48 and the one asked for, in
--site or a temporary folder. Of each are printed, in shares of the 16.7 ms that a frame of 60 a second has, the median
and the 95th percentile of what script takes to draw one while the map is dragged, zoomed, and dragged with all layers,
and while the surface turns; and of the larger one how many times as long it takes as the smaller.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gradscape.gallery.figures import Figure
from gradscape.gallery.files import STORE
from gradscape.gallery.paper import PaperCaption
from gradscape.gallery.site.build import build_site
from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.store import SliceStore

FRAME = 1000 / 60  # [ms]
SMALL = 48
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
MOVES = {  # what is done before each frame, by what is drawn then
    "map, dragged": ("redraw", "setView(6, (k % 50) / 60, (k % 40) / 60)"),
    "map, zoomed": ("redraw", "zoomAt(k % 20 < 10 ? 1.2 : 1 / 1.2, [0.4, 0.6])"),
    "map, all layers, dragged": ("redraw", "setView(2, (k % 50) / 120, (k % 40) / 120)"),
    "surface, turned": ("repaint", "turning = true; turn(0.03, 0.002)"),
}
MEASURE = """async ([kind, move, frames]) => {
    const step = new Function("k", move);
    const [taken, between] = [[], []];
    const frame = window.requestAnimationFrame;
    let spent = 0;
    window.requestAnimationFrame = (call) => frame((now) => {
        const start = performance.now();
        call(now);
        spent += performance.now() - start;
    });
    let last = 0;
    for (let k = 0; k < frames; k++) {
        spent = 0;
        step(k);
        const now = await new Promise((done) => frame(() => frame(done)));
        taken.push(spent);
        if (last) between.push((now - last) / 2);
        last = now;
    }
    window.requestAnimationFrame = frame;
    return [taken, between];
}"""


class Rugged(Objective):
    """Ripples on a bowl, with a disc where nothing is finite."""

    name = "rugged"
    space = ParameterSpace(
        ("speed", "angle"), torch.tensor([-1.0, 0]).double(), torch.tensor([1.0, 2]).double(), ("m/s", "rad")
    )

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        """Return the losses and gradients of points, shape (batch, 2)."""
        x = x.clone().requires_grad_()
        z = 2 * self.space.to_unit(x) - 1
        loss = 2 + z.square().sum(dim=1) + 0.3 * (19 * z[:, 0]).sin() * (23 * z[:, 1]).cos()
        (slope,) = torch.autograd.grad(loss.sum(), x)
        loss = loss.detach()
        loss[(z.detach() - 0.6).norm(dim=1) < 0.2] = torch.nan
        return Evaluation.from_results(loss, slope if grad else None)


def keep(resolution: int, data: Path) -> Figure:
    """Sample the made-up slice into a folder of figures' data, and return its figure."""
    figure = Figure(f"rugged-{resolution}", "rugged", (0, 1), PaperCaption("Made up."), resolution=resolution)
    plane = Plane.through(Rugged.space, Rugged.space.center, figure.dims, resolution=resolution)
    identity = {"objective": "rugged", "options": {}, "fidelity": "exact"}
    store = SliceStore.create(data / figure.id / STORE, plane, Rugged.space, identity=identity, provenance={})
    sample(Rugged(), plane, store)
    return figure


def measure(page: Any, frames: int) -> dict[str, list[float]]:
    """Return what script took for each frame of each kind [ms]."""
    found = {}
    for kind, (draws, move) in MOVES.items():
        if "all layers" in kind:
            page.check("input[name=isolines]")
            page.check("input[name=arrows]")
            if page.locator("input[name=finer]").count():
                page.check("input[name=finer]")
        page.wait_for_timeout(500)
        found[kind], _ = page.evaluate(MEASURE, [draws, move, frames])
    return found


def visit(folder: Path, figures: Mapping[int, Figure], frames: int) -> dict[int, dict[str, list[float]]]:
    """Measure the page of each size in one browser."""
    from playwright.sync_api import sync_playwright

    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        raise SystemExit(f"this needs one of {', '.join(BROWSERS)}")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=["--disable-gpu"])
        found = {}
        for size, figure in figures.items():
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.goto(f"file://{folder}/{figure.id}/index.html")
            found[size] = measure(page, frames)
        browser.close()
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--site", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = asked.site or Path(temporary) / "site"
        figures = {size: keep(size, Path(temporary) / "data") for size in (SMALL, asked.resolution)}
        build_site(list(figures.values()), Path(temporary) / "data", folder)
        found = visit(folder.resolve(), figures, asked.frames)
    print(f"script of a frame, in shares of {FRAME:.1f} ms; no GPU\n")
    print(f"{'':28}{SMALL:>7}{asked.resolution:>8}{'95th':>8}{'ratio':>8}")
    for kind in MOVES:
        small, large = (np.array(found[size][kind]) for size in figures)
        middle, late = np.median(large), np.percentile(large, 95)
        ratio = middle / max(float(np.median(small)), 0.05)
        print(f"{kind:28}{np.median(small) / FRAME:7.0%}{middle / FRAME:8.0%}{late / FRAME:8.0%}{ratio:8.2f}")


if __name__ == "__main__":
    main()
