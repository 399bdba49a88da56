"""Mass of particles at grid nodes, as a torch function."""

from functools import cache
from typing import Any, no_type_check

import numpy as np
import torch
import warp as wp

from .. import cpp
from ..runtime import load, precision, to_torch
from .model import Model, place_grid
from .stencil import lattice, stencil
from .transfers import transfers, transfers_of_columns

WHOLE = 2.0**60  # units of the mass of all particles


@cache
@no_type_check
def count_kernel(name: str) -> Any:
    """Return the kernel that adds particles' masses, in units, to their nodes."""
    types = precision(name)
    real, vec3, (Reals, Vectors, _, _) = types.real, types.vec3, types.rows
    Lattice, spline = lattice(name), stencil(name)
    base_node, weights = spline.base_node, spline.weights

    @wp.kernel(module=cpp.module(f"gradscape.raster.{name}"), enable_backward=False)
    def count_mass(lattice: Lattice, mass: Reals, x: Vectors, units: wp.float64, grid: wp.array2d[wp.int64]):
        e, p = wp.tid()
        s = (x[e, p] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        whole = wp.float64(mass[e, p]) * units
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                for k in range(3):
                    share = wp.float64(wx[i] * wy[j] * wz[k]) * whole
                    wp.atomic_add(grid, e, row + k, wp.int64(wp.rint(share)))

    return count_mass


class Raster:
    """Spread particles' `mass`, shape (particle,), over the nodes of a model's grid, for up to `capacity` rows.

    On a GPU, or where `counting`, masses are added up as integers, whose sums do not depend on their order.
    """

    def __init__(
        self, model: Model, mass: np.ndarray, *, capacity: int, device: str, counting: bool | None = None
    ) -> None:
        name, types = model.precision, precision(model.precision)
        self.counting = device != "cpu" if counting is None else counting
        self.kernels = (transfers_of_columns if self.counting else transfers)(name)
        self.count = count_kernel(name)
        self.lattice, self.device = place_grid(model), device
        load([self.kernels.adjoint_p2g, *([self.count] if self.counting else [])], device)
        self.unit = float(mass.sum()) / WHOLE
        self.mass: wp.array = wp.array(np.tile(mass, (capacity, 1)), dtype=types.real, device=device)
        kinds = 2 * (types.vec3, types.vec3, types.mat33)
        arrays = [wp.zeros((capacity, len(mass)), dtype=kind, device=device) for kind in kinds]
        self.particles, self.adjoints = arrays[:3], arrays[3:]  # x, v, A: a mass does not depend on v and A
        self.grid = wp.zeros((capacity, model.cells), dtype=types.vec4, device=device)
        starts = np.arange(0, model.cells, model.nodes[2], dtype=np.int32)  # of columns of nodes, which have all theirs
        self.starts: list[wp.array] = [wp.array(np.tile(starts, (capacity, 1)), device=device)] if self.counting else []
        self.units = wp.zeros((capacity, model.cells if self.counting else 0), dtype=wp.int64, device=device)

    @staticmethod
    def bytes_per_row(model: Model) -> int:
        """Return what a row takes."""
        return model.real_bytes * (31 * model.particles + 4 * model.cells) + 8 * model.cells

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """Return the mass at each node, shape (batch, node), of particles at x [m], shape (batch, particle, 3)."""
        mass: torch.Tensor = _Spread.apply(x, self)
        return mass

    def spread(self, x: torch.Tensor) -> torch.Tensor:
        """Return masses without a graph."""
        if self.counting:
            self.units.zero_()
            self._place(x)
            inputs = [self.lattice, self.mass, self.particles[0], 1.0 / self.unit, self.units]
            wp.launch(self.count, (len(x), self.mass.shape[1]), inputs, device=self.device, record_tape=False)
            return (to_torch(self.units)[: len(x)].double() * self.unit).to(x.dtype)
        self.grid.zero_()
        self._launch(self.kernels.p2g, x, [])
        return to_torch(self.grid)[: len(x), :, 3].to(x.dtype, copy=True)

    def gather(self, x: torch.Tensor, adj_mass: torch.Tensor) -> torch.Tensor:
        """Return the adjoint of x from that of the masses."""
        grid = to_torch(self.grid)
        grid.zero_()
        grid[: len(x), :, 3] = adj_mass.to(grid)
        self.adjoints[0].zero_()
        self._launch(self.kernels.adjoint_p2g, x, self.adjoints)
        return to_torch(self.adjoints[0])[: len(x)].to(x.dtype, copy=True)

    def _place(self, x: torch.Tensor) -> None:
        places = to_torch(self.particles[0])
        places[: len(x)] = x.to(places)

    def _launch(self, kernel: Any, x: torch.Tensor, adjoints: list[Any]) -> None:
        self._place(x)
        inputs = [self.lattice, *self.starts, self.mass, *self.particles, self.grid, *adjoints]
        dim = len(x), cpp.threads(kernel, self.mass.shape[1])
        wp.launch(kernel, dim, inputs, device=self.device, record_tape=False)


class _Spread(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, raster: Raster) -> torch.Tensor:
        ctx.save_for_backward(x)
        ctx.raster = raster
        return raster.spread(x)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, adj_mass: torch.Tensor) -> tuple[torch.Tensor, None]:
        (x,) = ctx.saved_tensors
        return ctx.raster.gather(x, adj_mass), None
