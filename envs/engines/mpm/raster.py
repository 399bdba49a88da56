"""Mass of particles at grid nodes, as a torch function."""

from typing import Any

import numpy as np
import torch
import warp as wp

from ..runtime import load, precision, to_torch
from .model import Model, place_grid
from .transfers import transfers


class Raster:
    """Spread particles' `mass`, shape (particle,), over the nodes of a model's grid, for up to `capacity` rows."""

    def __init__(
        self, model: Model, mass: np.ndarray, *, capacity: int, device: str, deterministic: bool = False
    ) -> None:
        types = precision(model.precision)
        self.kernels = transfers(model.precision, deterministic=deterministic)
        self.lattice, self.device = place_grid(model), device
        load([self.kernels.p2g, self.kernels.adjoint_p2g], device)
        self.mass: wp.array = wp.array(np.tile(mass, (capacity, 1)), dtype=types.real, device=device)
        kinds = types.vec3, types.vec3, types.mat33, types.vec3, types.vec3, types.mat33
        particles = [wp.zeros((capacity, len(mass)), dtype=kind, device=device) for kind in kinds]
        self.particles, self.adjoints = particles[:3], particles[3:]  # x, v, A: a mass does not depend on v and A
        self.grid = wp.zeros((capacity, model.cells), dtype=types.vec4, device=device)

    @staticmethod
    def bytes_per_row(model: Model) -> int:
        """Return what a row takes."""
        return model.real_bytes * (31 * model.particles + 4 * model.cells)

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """Return the mass at each node, shape (batch, node), of particles at x [m], shape (batch, particle, 3)."""
        mass: torch.Tensor = _Spread.apply(x, self)
        return mass

    def spread(self, x: torch.Tensor) -> torch.Tensor:
        """Return masses without a graph."""
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

    def _launch(self, kernel: Any, x: torch.Tensor, adjoints: list[Any]) -> None:
        places = to_torch(self.particles[0])
        places[: len(x)] = x.to(places)
        inputs = [self.lattice, self.mass, *self.particles, self.grid, *adjoints]
        wp.launch(kernel, (len(x), self.mass.shape[1]), inputs, device=self.device, record_tape=False)


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
