"""Slices of a bowl with a ledge: a fine one, a coarse one, and one that is refined, and a site of them."""

from pathlib import Path

import pytest
import torch
from PIL import Image

from gradscape.gallery.figures import Figure
from gradscape.gallery.paper import PaperCaption
from gradscape.gallery.site import build, studio
from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.sampling.refine import Refinement, refine
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.store import SliceStore

SPACE = ParameterSpace(
    ("speed", "angle"), torch.tensor([-1.0, 0]).double(), torch.tensor([1.0, 2]).double(), ("m/s", "")
)
FIGURES = [
    Figure(name, "ledge", (0, 1), PaperCaption("Made up."), resolution=size)
    for name, size in (("fine", 256), ("coarse", 16), ("refined", 33))
]


class Ledge(Objective):
    """A bowl with a ledge that its gradients do not show, and a corner that is not finite."""

    name, space = "ledge", SPACE

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        z = 2 * self.space.to_unit(x) - 1
        loss, slope = 0.02 + z.square().sum(dim=1) + (z[:, 0] > 0.43), 2 * z
        loss[(z > 0.75).all(dim=1)] = torch.nan
        return Evaluation.from_results(loss, slope if grad else None)


def keep_ledges(folder: Path) -> None:
    """Sample the slices into a folder of figures' data."""
    for figure in FIGURES:
        plane = Plane.through(SPACE, SPACE.center, figure.dims, resolution=figure.resolution)
        identity = {"objective": "ledge", "options": {}, "fidelity": "exact"}
        if figure.id == "refined":
            identity["refine"] = {"share": 0.05}
        store = SliceStore.create(folder / figure.id / "slice.zarr", plane, SPACE, identity=identity, provenance={})
        if figure.id == "refined":
            refine(Ledge(), plane, store, Refinement(0.05))
        else:
            sample(Ledge(), plane, store)


def build_ledges(data: Path, out: Path) -> None:
    """Build a site of the slices without the pictures that are no canvases."""
    blank = Image.new("RGB", (160, 120), "white")

    def leave_out(source: Path, folder: Path) -> None:
        for name in ("landscape", "thumbnail", "landscape-dark", "thumbnail-dark"):
            blank.save(folder / f"{name}.png")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(studio, "draw_slice", leave_out)
        build.build_site(FIGURES, data, out)
