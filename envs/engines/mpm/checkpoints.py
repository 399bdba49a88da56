"""What MLS-MPM keeps of an episode: the particles of an instant, the grids of a substep, a control step whole."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import warp as wp

from .model import place

if TYPE_CHECKING:
    from .solver import Solver


@dataclass(frozen=True, eq=False)
class Frame:
    """The state of a batch at one instant, or its adjoint: arrays [environment, particle]."""

    x: wp.array
    v: wp.array
    C: wp.array
    S: tuple[wp.array, ...]

    def arrays(self) -> tuple[wp.array, ...]:
        """Return every array of the frame."""
        return (self.x, self.v, self.C, *self.S)


@dataclass(frozen=True, eq=False)
class Grid:
    """What nodes hold in one substep, [environment, node]: momentum and mass, then velocity; or the adjoints."""

    m: wp.array
    v: wp.array


class Window:
    """Hold one control step whole: frames between its ends, A and grids of its substeps, and where the grids lie."""

    def __init__(self, solver: "Solver", cells: int = 1) -> None:
        model = solver.model
        self.step = -1
        self.frames = [solver.frame() for _ in range(model.substeps - 1)]
        self.A = [solver.array(solver.types.mat33, model.particles) for _ in range(model.substeps)]
        self.grids = [solver.grid(cells) for _ in range(model.substeps)]
        self.lattice = place(model)

    @property
    def _cells(self) -> int:
        """How many nodes all its grids have room for."""
        return min(int(grid.v.shape[1]) for grid in self.grids)

    @property
    def bytes(self) -> int:
        """What its arrays take."""
        grids = [array for grid in self.grids for array in (grid.m, grid.v)]
        frames = [array for frame in self.frames for array in frame.arrays()]
        return sum(array.capacity for array in (*frames, *self.A, *grids))

    def growth(self, cells: int, solver: "Solver") -> int:
        """Return the bytes that grids of so many nodes take beyond those that are there, 0 where these suffice."""
        if self._cells >= cells:
            return 0
        more = _ample(cells, solver) - self._cells
        return 2 * len(self.grids) * solver.capacity * more * int(wp.types.type_size_in_bytes(solver.types.vec4))

    def hold(self, step: int, solver: "Solver") -> None:
        """Make room for a control step."""
        cells, self.step = solver.boxes[step].cells, -1
        if self._cells < cells:
            solver.replay.forget()
            for substep in range(len(self.grids)):
                self.grids[substep] = solver.grid(0)  # the old one goes first
                self.grids[substep] = solver.grid(_ample(cells, solver))
        self.step, self.lattice = step, place(solver.model, solver.boxes[step])


def _ample(cells: int, solver: "Solver") -> int:
    """Return how many nodes to make room for where so many are needed."""
    return int(min(cells * 5 // 4, solver.model.cells))
