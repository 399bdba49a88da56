"""Launch materials' kernels and boundaries' functions on tensors."""

import numpy as np
import torch
import warp as wp

from gradscape.envs.engines import cpp
from gradscape.envs.engines.mpm.boundaries import substep_struct
from gradscape.envs.engines.mpm.materials.kernels import alone, update_kernel
from gradscape.envs.engines.mpm.stencil import lattice
from gradscape.envs.engines.runtime import precision, to_torch

SCALE, MASS, VOLUME, DT = -0.7, 0.2, 0.3, 1e-3
NAMES = ["float32", "float64"]
IDENTITY = torch.eye(3, dtype=torch.float64)


def draw(*shape, seed):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5


def rotations(count, seed):
    q = torch.linalg.qr(draw(count, 3, 3, seed=seed)).Q
    return q * torch.linalg.det(q)[:, None, None]


def vectors(*rows):
    return torch.tensor(rows, dtype=torch.float64)


class MaterialBench:
    """Launch one material's kernels on tensors of particles, shape (particle, ...)."""

    def __init__(self, material, name="float64"):
        self.material, self.types = material, precision(name)
        self.kernels = material.kernels(name)
        self.kinds = {(): self.types.real, (3, 3): self.types.mat33}

    def update(self, state, C, dt=DT):
        """Return the new state and the affine momentum A."""
        return self._launch(0, dt, [state, C], [state, C])

    def adjoint(self, state, C, adj_new, adj_A, dt=DT):
        """Return the adjoints of state and C."""
        return self._launch(1, dt, [state, C, adj_new, adj_A], [state, C])

    def deform(self, state, C, dt=DT):
        return self.update(state, C, dt)[0]

    def tau(self, state, C=None):
        """Return the Kirchhoff stress [Pa] of a state that no time passes by."""
        C = torch.zeros(len(state), 3, 3, dtype=torch.float64) if C is None else C
        return (self.update(state, C, 0.0)[1] - MASS * C) / (SCALE * VOLUME)

    def slopes(self, state, C, adj_new, adj_A, dt, step):
        """Return (adjoint, fourth-order difference) along a random direction of state and one of C, by particle."""
        pairs = []
        for i, adjoint in enumerate(self.adjoint(state, C, adj_new, adj_A, dt)):
            direction = draw(*adjoint.shape, seed=20 + i)
            at = {}
            for k in (-2, -1, 1, 2):
                moved = [state, C]
                moved[i] = moved[i] + k * step * direction
                new, A = self.update(*moved, dt)
                at[k] = each_sum(new * adj_new) + each_sum(A * adj_A)
            slope = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * step)
            pairs.append((each_sum(adjoint * direction), slope))
        return pairs

    def _launch(self, which, dt, given, wanted):
        count, law = len(given[0]), self.material.law(self.types.name)
        law.dt, law.scale = dt, SCALE
        law.mass, law.volume = (wp.array(np.full((1, count), one), dtype=self.types.real) for one in (MASS, VOLUME))
        results = [self._array(torch.zeros_like(like)) for like in wanted]
        inputs, kernel = [law, *map(self._array, given), *results], self.kernels[which]
        wp.launch(kernel, (1, cpp.threads(kernel, count)), inputs, record_tape=False)
        return tuple(to_torch(array)[0].double().clone() for array in results)

    def _array(self, values):
        kind = self.kinds[tuple(values.shape[1:])]
        return wp.array(values.to(self.types.torch)[None].contiguous().numpy(), dtype=kind, copy=True)


def in_warp(material, response, name):
    """Return a bench of a material's functions for a GPU, one particle at a time."""
    bench, found = MaterialBench(material, name), response(name)
    bench.kernels = update_kernel(name, found), alone(name, found)
    return bench


def assert_rows_have_the_same_bits(material, response, state, C, adj_new, adj_A):
    """Hold a material's kernels in C++ against its `response` in Warp."""
    one, rows = in_warp(material, response, "float32"), MaterialBench(material, "float32")
    for wanted, found in (
        *zip(one.update(state, C), rows.update(state, C), strict=True),
        *zip(one.adjoint(state, C, adj_new, adj_A), rows.adjoint(state, C, adj_new, adj_A), strict=True),
    ):
        assert wanted.isfinite().all()
        assert (wanted == found).all()


def placed(name, origin, dx, nodes, first=(0, 0, 0)):
    """Return the lattice of so many nodes from node `first` on, the grid beginning at `origin`."""
    grid = lattice(name)()
    grid.origin, grid.inv_dx, grid.first = precision(name).vec3(*origin), 1 / dx, wp.vec3i(*first)
    grid.nx, grid.ny, grid.nz = nodes
    return grid


def slope_errors(run, at, adj_end, gradient, steps, *, seed):
    """Return for each step how far differences along a random direction are from a gradient's slope, relative to it.

    `run` takes what it is differentiated by, shape (batch, ...), to ends whose adjoint is `adj_end`.
    """
    direction = draw(*at.shape, seed=seed)
    slope, errors = each_sum(gradient * direction), []
    for step in steps:
        ends = [each_sum(run(at + sign * step * direction) * adj_end) for sign in (1, -1)]
        errors.append(float((((ends[0] - ends[1]) / (2 * step) - slope) / slope).abs().max()))
    return errors


def each_sum(values):
    return values.flatten(1).sum(dim=1) if values.ndim > 1 else values


class BoundaryBench:
    """Launch a boundary's function, and its adjoint, on tensors of nodes, shape (node, 3)."""

    def __init__(self, boundary, *, rate):
        self.boundary, self.rate, self.types = boundary, rate, precision("float64")
        contact, Data = boundary.function("float64")
        self.data = boundary.data("float64", "cpu")
        vec3, Substep = self.types.vec3, substep_struct("float64")

        @wp.kernel(module="unique", module_options=cpp.options())
        def apply(
            data: Data,
            p: wp.array[vec3],
            tools: wp.array3d[vec3],
            sums: wp.array2d[wp.int64],
            now: Substep,
            v: wp.array[vec3],
            out: wp.array[vec3],
        ):
            i = wp.tid()
            out[i] = contact(data, p[i], v[i], 0, 0, tools, sums, now)

        self.kernel, self.substep = apply, Substep

    def __call__(self, p, v, tools, fraction=0.0):
        """Return the velocities of nodes at p [m]; `tools`, shape (2, slot, 3), are those of one control step."""
        inputs = self._inputs(p, v, tools, fraction)
        wp.launch(self.kernel, len(v), inputs, record_tape=False)
        return to_torch(inputs[-1]).clone()

    def adjoint(self, p, v, tools, adj_out, fraction=0.0):
        """Return the adjoints of v and tools."""
        inputs = self._inputs(p, v, tools, fraction)
        adj_tools, adj_v = wp.zeros_like(inputs[2]), wp.zeros_like(inputs[5])
        adjoints = [type(self.data)(), None, adj_tools, None, self.substep(), adj_v, self._array(adj_out)]
        wp.launch(self.kernel, len(v), inputs, adj_inputs=adjoints, adj_outputs=[], adjoint=True, record_tape=False)
        return to_torch(adj_v).clone(), to_torch(adj_tools)[0].clone()

    def _inputs(self, p, v, tools, fraction):
        at, places, before, after = (self._array(t) for t in (p.expand_as(v), tools[None], v, torch.zeros_like(v)))
        now = self.substep()
        now.fraction, now.rate = fraction, self.rate
        return [self.data, at, places, wp.zeros((1, 1), dtype=wp.int64), now, before, after]

    def _array(self, values):
        return wp.array(values.contiguous().numpy(), dtype=self.types.vec3, copy=True)
