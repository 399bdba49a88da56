"""The kernels by which a fluid's volume ratios are smoothed; `smoothing` has the formulas."""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from .. import cpp
from ..runtime import precision
from .layout import layout
from .stencil import lattice, stencil


@cache
@no_type_check
def smoothing_kernels(name: str) -> SimpleNamespace:
    """Return the kernels `clear, spread, collect, adjoint_collect, adjoint_spread` of one precision."""
    types = precision(name)
    real, vec3 = types.real, types.vec3
    module = cpp.module(f"gradscape.smoothing.{name}")
    Lattice, spline = lattice(name), stencil(name)
    base_node, weights, weight_slopes = spline.base_node, spline.weights, spline.weight_slopes
    read_number = layout(name).read_number

    @wp.func(module=module)
    def inverse(weight: real):
        # A particle in the middle of a cell gives the farthest of its nodes nothing, and others may not meet these.
        return wp.where(weight > real(0.0), real(1.0) / weight, real(0.0))

    @wp.kernel(module=module, enable_backward=False)
    def clear(values: wp.array2d[real]):
        e, i = wp.tid()
        values[e, i] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        lattice: Lattice,
        first: int,
        slope: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
    ):
        """Scatter V s and V."""
        e, p = wp.tid()
        q = first + p
        s = (x[e, q] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        beyond = wp.log(J[e, p]) - slope * x[e, q][1]
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                for k in range(3):
                    w = wx[i] * wy[j] * wz[k] * volume[e, q]
                    wp.atomic_add(amount, e, row + k, w * beyond)
                    wp.atomic_add(weight, e, row + k, w)

    @wp.kernel(module=module, enable_backward=False)
    def collect(
        lattice: Lattice,
        first: int,
        slope: real,
        share: real,
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        J_new: wp.array2d[real],
    ):
        """Gather the nodes' means and take J so far towards them."""
        e, p = wp.tid()
        q = first + p
        s = (x[e, q] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        mean = real(0.0)
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                for k in range(3):
                    mean += (
                        wx[i]
                        * wy[j]
                        * wz[k]
                        * read_number(amount, e, row + k)
                        * inverse(read_number(weight, e, row + k))
                    )
        here = wp.log(J[e, p])
        J_new[e, p] = wp.exp(here + share * (mean - (here - slope * x[e, q][1])))

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_collect(
        lattice: Lattice,
        first: int,
        share: real,
        x: wp.array2d[vec3],
        J_new: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        adj_J: wp.array2d[real],
        adj_x: wp.array2d[vec3],
        adj_mean: wp.array2d[real],
    ):
        """Scatter the adjoints of the nodes' means; add to adj_x, turn adj_J from that of J' into that of log J'."""
        e, p = wp.tid()
        q = first + p
        s = (x[e, q] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx_, dy_, dz_ = weight_slopes(f[0]), weight_slopes(f[1]), weight_slopes(f[2])
        g = adj_J[e, p] * J_new[e, p]
        steep = vec3()
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                for k in range(3):
                    mean = read_number(amount, e, row + k) * inverse(read_number(weight, e, row + k))
                    steep += mean * vec3(dx_[i] * wy[j] * wz[k], wx[i] * dy_[j] * wz[k], wx[i] * wy[j] * dz_[k])
                    wp.atomic_add(adj_mean, e, row + k, wx[i] * wy[j] * wz[k] * share * g)
        adj_x[e, q] = adj_x[e, q] + (share * g * lattice.inv_dx) * steep
        adj_J[e, p] = g

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_spread(
        lattice: Lattice,
        first: int,
        slope: real,
        share: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        adj_mean: wp.array2d[real],
        adj_J: wp.array2d[real],
        adj_x: wp.array2d[vec3],
    ):
        """Gather the adjoint of s; add to adj_x, turn adj_J from that of log J' into that of J."""
        e, p = wp.tid()
        q = first + p
        s = (x[e, q] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx_, dy_, dz_ = weight_slopes(f[0]), weight_slopes(f[1]), weight_slopes(f[2])
        beyond = wp.log(J[e, p]) - slope * x[e, q][1]
        adj_s = real(0.0)
        steep = vec3()
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                for k in range(3):
                    share_of_one = inverse(read_number(weight, e, row + k))
                    a = read_number(adj_mean, e, row + k) * share_of_one
                    off = a * (beyond - read_number(amount, e, row + k) * share_of_one)
                    adj_s += wx[i] * wy[j] * wz[k] * a
                    steep += off * vec3(dx_[i] * wy[j] * wz[k], wx[i] * dy_[j] * wz[k], wx[i] * wy[j] * dz_[k])
        g = adj_J[e, p]
        adj_s = volume[e, q] * adj_s - share * g
        adj_x[e, q] = adj_x[e, q] + (volume[e, q] * lattice.inv_dx) * steep - vec3(real(0.0), slope * adj_s, real(0.0))
        adj_J[e, p] = (g + adj_s) / J[e, p]

    return SimpleNamespace(
        clear=clear,
        spread=spread,
        collect=collect,
        adjoint_collect=adjoint_collect,
        adjoint_spread=adjoint_spread,
    )
