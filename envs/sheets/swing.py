"""The Swing scenes: a cloth held at two corners swings down onto the floor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.episode import Part, View
from ...landscapes.options import added
from ...landscapes.space import ParameterSpace
from ..base import Environment, Fidelity, ModelPart, copied
from ..engines.sheets.contact import AnchoredFloor, Floor
from ..engines.sheets.springs import Sheet
from ..outlines import triangles
from . import lattice
from .sheets import Drive, SheetOptions, SheetScene

SIDE, HEIGHT = 0.2, 0.1  # the cloth's edge, and how far above the floor it is held [m]
AREAL_DENSITY = 0.2  # [kg/m^2]
STIFFNESS, SWING = 10.0, (1.0, -0.5, 0.0)  # where they are no parameters, and of anchors that swing [N/m], [m/s]
BRAKING = 0.4  # in which anchors that swing come to rest [s], on the floor
PATCHES = 4  # along each edge
BEND = 3e-4  # bending stiffness [N m]
DAMPING, DRAG, GRAVITY = 8e-3, 0.5, 9.81  # [N s/m], [1/s], [m/s^2]


@dataclass(frozen=True)
class SwingOptions(SheetOptions):
    """`loss`: distance of the centre of mass (single), or mean distance of corners (corner) or all vertices (mesh).

    `damping` of the springs [N s/m], `drag` of the air [1/s], `gravity` [m/s^2]. `bending` is the bending stiffness [N
    m], `shear` scales the shear springs, and `friction` is the floor's coefficient. `anchors`: still or swing. With
    swing they start at (1, -0.5, 0) m/s and slow down evenly, to rest after 0.4 s, 20 cm to the right on the floor.
    `bending_springs`: the share of the springs along the lattice that instead join points a sixth of the edge apart. So
    a stiffer part also bends less.
    """

    loss: Literal["single", "corner", "mesh"] = "single"
    damping: float = DAMPING
    drag: float = DRAG
    gravity: float = GRAVITY
    bending: float = BEND
    shear: float = 1.0
    friction: float = 0.0
    anchors: Literal["still", "swing"] = added("still")
    bending_springs: float = added(0.0)


class Swing(SheetScene):
    """A cloth swings down from its two held corners and drags over the floor.

    Model: a cloth (20 cm x 20 cm, 0.2 kg/m^2) starts level, 10 cm above the floor, held at its two right corners; x
    right, y up, z to the front. Springs resist stretching and shear; a plate stiffness of 3e-4 N m resists bending. An
    episode lasts 0.5 s. In longer ones the cloth sways on, and meshes differ more.
    Loss: distance [m] from the final state of example `target` at the same fidelity. An option chooses the distance of
    the centre of mass (single), or the mean distance of the corners (corner) or of all vertices (mesh). Two of the four
    corners are held. Still anchors never miss their targets, so `corner` is half the mean of the other two.
    Preset paper: the supplement's two anchors swing the cloth onto the floor (anchors=swing), and contact changes the
    velocity of vertices that are in contact (contact=start). Its cloth consists of springs only. Bending springs, four
    fifths of those along the lattice (bending_springs=0.8, as in flip), resist bending instead of a plate (bending=0).
    So stiffness patches decide how it folds, and their random losses reach 33 mm instead of 8. The motion of the
    anchors is our choice, and is the same for every initial velocity of the cloth. Then the landscape is as rugged as
    the paper shows, and its gradients are as often opposite to the slope. With anchors that start at that velocity, it
    is smooth.
    Simplifications: by default the anchors are still, because the held cloth swings anyway. By default contact stops
    vertices on the floor, because the alternative depends on the time step. Air is a drag of 0.5/s. Stretching is
    resisted by 10 N/m, softer than fabric, which permits long steps. The bending resistance is ours, to make folds
    wider than a few cells. Coarse meshes fold differently from fine ones. On 32 points, compared with 40 cells (1/10000
    s), losses of standard (28 cells) have rank correlations of 0.99 (velocity and stiffness), and 95 % are within 5.5
    and 7.5 % of the spread. Losses of draft (12 cells) have 0.97 and 0.63, within 19 and 75 %.
    Source: task Swing of "Rethinking Optimization with Differentiable Simulation from a Global Perspective" (CoRL
    2022), appendix A.2.3; geometry and material are ours.
    """

    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=1 / 1000, resolution=12),
        "standard": Fidelity("standard", dt=1 / 5000, resolution=28),
        "reference": Fidelity("reference", dt=1 / 10_000, resolution=40, precision="float64"),
    }
    Options: ClassVar[type[Any]] = SwingOptions
    model_parts: ClassVar[tuple[ModelPart, ...]] = (
        ModelPart("springs' damping", {"damping": 0.0}, "undamped springs"),
        ModelPart("air", {"drag": 0.0}, "no drag"),
        ModelPart("bending", {"bending": 0.0}, "a membrane"),
        ModelPart("shear", {"shear": 0.0}, "no shear springs"),
        ModelPart("gravity", {"gravity": 0.0}, "no weight"),
        ModelPart("exact contact", {"contact": "start"}, "vertices stop once they are inside"),
        ModelPart("friction", {"friction": 0.3}, "friction of the floor", missing=True),
    )
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"contact": "start", "anchors": "swing", "bending_springs": 0.8, "bending": 0.0}
    }
    duration: ClassVar[float] = 0.5

    @property
    def view(self) -> View:  # type: ignore[override] # read only
        """The view, which includes the path of the anchors."""
        right = 0.15 if self.options.anchors == "still" else 0.3
        return View((-0.2, 0.0, -0.11), (right, 0.12, 0.11), eye=(-0.45, 0.5, 1.0), ground=-0.003)

    @property
    def surface(self) -> Floor:
        """The floor, at height 0."""
        return (Floor if self.options.anchors == "still" else AnchoredFloor)(friction=self.options.friction)

    def replicas(self) -> Mapping[str, Environment]:
        """Return the cloth in shorter time steps, and with one cell more or less along its edges."""
        cells, dt, steps = self.fidelity.resolution, self.fidelity.dt, self.own_steps
        finer = dt * steps / math.ceil(steps * (1 + 1 / cells) ** 2)  # as far from instability
        meshes: dict[str, dict[str, Any]] = {
            "one cell more": {"resolution": cells + 1, "dt": finer},
            "one cell less": {"resolution": cells - 1},
        }
        return {**super().replicas(), **self._replicas_of(meshes)}

    def _sheet(self) -> Sheet:
        cells, options = self.fidelity.resolution, self.options
        points = lattice.square(cells)
        pitch = SIDE / cells
        reach = max(1, round(cells / 6))  # of bending springs
        springs = lattice.springs(points, reach=reach, bend=options.bending_springs, shear=options.shear)
        pairs, rest, weight, plate = lattice.merge(points, springs, lattice.plate(points))
        x = np.stack(
            [points[:, 0] * pitch - SIDE, np.full(len(points), HEIGHT), points[:, 1] * pitch - SIDE / 2], axis=1
        )
        mass = AREAL_DENSITY * pitch**2 * lattice.areas(points)
        return Sheet(
            x,
            pairs,
            rest * pitch,
            weight,
            mass,
            damping=options.damping,
            drag=options.drag,
            gravity=options.gravity,
            held=self._corners()[2:],
            plate=options.bending / pitch**2 * plate,
        )

    def _energy(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step"] | None:
        """Return the sum of kinetic, gravitational and spring energy, where no anchor drives the cloth."""
        if self.options.anchors != "still":
            return None
        drive, sheet = self._drive(x), self.sheet
        with self._solvers.lend() as solver:
            frames = copied(solver.run(*drive.detach()))
        mass = torch.from_numpy(sheet.masses.copy())
        speed = (frames.diff(dim=0) / self.fidelity.dt).square().sum(dim=3)  # the step's own velocities
        ends = torch.from_numpy(sheet.pairs).T.long()
        stretch = (frames[1:, :, ends[0]] - frames[1:, :, ends[1]]).norm(dim=3) - torch.from_numpy(sheet.rest)
        stiffness = drive.stiffness.detach()[:, ends].mean(dim=1) * torch.from_numpy(sheet.weight)
        height = sheet.gravity * frames[1:, :, :, 1]
        apart = (frames[1:, :, ends[0]] - frames[1:, :, ends[1]]).square().sum(dim=3)
        bent = (torch.from_numpy(sheet.plates) * apart).sum(dim=2) / 2
        found: Tensor = (speed / 2 + height) @ mass + (stiffness * stretch.square()).sum(dim=2) / 2 + bent
        return found.T

    def _corners(self) -> tuple[int, int, int, int]:
        """Return the numbers of the corners: left back, left front, right back, right front."""
        n = self.fidelity.resolution
        return 0, n, n * (n + 1), (n + 1) ** 2 - 1

    def _loss(self, end: Float[Tensor, "vertex 3"]) -> Float[Tensor, ""]:
        match self.options.loss:
            case "single":
                loss: Tensor = (self._share @ (end - self._target)).norm()
            case "corner":
                loss = (end - self._target)[list(self._corners())].norm(dim=1).mean()
            case _:
                loss = self._share @ (end - self._target).norm(dim=1)
        return loss

    @cached_property
    def _share(self) -> Float[Tensor, " vertex"]:
        """Vertices' shares of the mass."""
        return torch.from_numpy(self.sheet.masses / self.sheet.masses.sum())

    def _surroundings(self, poses: Float[Tensor, "frame 3"]) -> Mapping[str, Float[Tensor, "frame 3"]]:
        held = torch.from_numpy(self.sheet.x[list(self._corners()[2:])])
        return {f"anchor {number}": place + poses for number, place in enumerate(held, start=1)}

    def _parts(self, frames: Float[Tensor, "frame vertex 3"], poses: Float[Tensor, "frame 3"]) -> tuple[Part, ...]:
        faces = triangles(lattice.square(self.fidelity.resolution))
        held = frames[:, list(self._corners()[2:])]
        return (
            Part("sheet", "cloth", frames, faces=faces),
            Part("sphere", "iron", held, (SIDE / 40,)),
            Part("sheet", "target", self._target.expand_as(frames), faces=faces),
        )

    def _course(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step_plus_1 3"]:
        """Return the displacement of the anchors [m]: zero, or an even deceleration to rest."""
        if self.options.anchors == "still":
            return x.new_zeros(1, 1, 3).expand(len(x), self.steps + 1, 3)
        time = (self.fidelity.dt * torch.arange(self.steps + 1, dtype=x.dtype)).clamp(max=BRAKING)
        gone = x.new_tensor(SWING) * (time - time**2 / (2 * BRAKING))[:, None]
        return gone.expand(len(x), -1, -1)

    def _prepare(self) -> None:
        _ = self._target

    @cached_property
    def _target(self) -> Float[Tensor, "vertex 3"]:
        """Final vertex positions of the example `target`, on the CPU whatever this device."""
        own = {field.name: getattr(self.options, field.name) for field in fields(self.options)}
        own["horizon"] = 1.0
        return type(self)(fidelity=self.fidelity, device="cpu", **own).end(self.example("target"))


class SwingVelocity(Swing):
    """Throw a cloth held at two corners so that it ends like a target.

    Parameters: initial velocity x, y, z [m/s] of all vertices that are not held. Stiffness is 10 N/m throughout.
    """

    name = "swing-velocity"
    examples: ClassVar[dict[str, tuple[float, ...]]] = {"target": (1.0, -0.5, 0.3)}
    space = ParameterSpace.box([f"velocity {axis}" for axis in "xyz"], -2.0, 2.0, "m/s")

    def _drive(self, x: Float[Tensor, "batch dim"]) -> Drive:
        return Drive(x, torch.full((len(x), len(self.sheet.x)), STIFFNESS, dtype=x.dtype), self._course(x))


class SwingStiffness(Swing):
    """Choose the stiffness of the patches of a swinging cloth, so that it ends like a target.

    Parameters: stiffness [N/m] of 4 x 4 patches, from left to right and, within a column, from back to front. A vertex
    on the border between patches has their mean, and a spring has the mean of its ends. The swing is fixed: initial
    velocity (1, -0.5, 0) m/s.
    """

    name = "swing-stiffness"
    examples: ClassVar[dict[str, tuple[float, ...]]] = {
        "target": (12.0, 6.0, 7.0, 13.0, 5.0, 9.0, 11.0, 4.0, 8.0, 3.0, 4.0, 9.0, 10.0, 12.0, 6.0, 7.0)
    }
    space = ParameterSpace.box(
        [f"stiffness of patch {row} {column}" for row in range(1, PATCHES + 1) for column in range(1, PATCHES + 1)],
        2.0,
        15.0,
        "N/m",
    )

    def _drive(self, x: Float[Tensor, "batch dim"]) -> Drive:
        share = self._patch_shares().to(x)
        stiffness = torch.stack([(share @ row.view(PATCHES, PATCHES) @ share.T).flatten() for row in x])
        return Drive(x.new_tensor(SWING).expand(len(x), 3), stiffness, self._course(x))

    def _patch_shares(self) -> Float[Tensor, "vertex patch"]:
        """Return how much of a vertex's width along an edge lies in each patch; its width is one cell, or half."""
        cells = self.fidelity.resolution
        middle = torch.arange(cells + 1, dtype=torch.float64) / cells
        low, high = (middle - 0.5 / cells).clamp(min=0.0), (middle + 0.5 / cells).clamp(max=1.0)
        edges = torch.arange(PATCHES + 1, dtype=torch.float64) / PATCHES
        inside = (torch.minimum(high[:, None], edges[1:]) - torch.maximum(low[:, None], edges[:-1])).clamp(min=0.0)
        return inside / (high - low)[:, None]
