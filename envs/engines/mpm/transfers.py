"""Particle-grid transfers of MLS-MPM with quadratic B-splines, and their adjoints by hand.

Notation of Hu et al. 2018 (MLS-MPM): particle position x [m], velocity v [m/s], affine velocity C [1/s], affine
momentum A [kg/s]; node i holds momentum and mass (grid_m), or velocity (grid_v). Arrays are [environment, particle] and
[environment, node]; a node's flat index runs z fastest.

The adjoints are written out because they cost half of what reverse-mode AD of the 27-node stencil costs; the tests hold
them against it.
"""

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
def transfers(name: str) -> SimpleNamespace:
    """Return the transfer kernels `p2g, g2p, adjoint_p2g, adjoint_g2p` of one precision."""
    types = precision(name)
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    module = cpp.module(f"gradscape.transfers.{name}")
    Lattice, spline = lattice(name), stencil(name)
    base_node, weights, weight_slopes = spline.base_node, spline.weights, spline.weight_slopes
    lies = layout(name)
    read_matrix, write_matrix, read_node = lies.read_matrix, lies.write_matrix, lies.read_node
    offset = wp.constant(vec3(0.0, 1.0, 2.0))  # real(i) on an unrolled index breaks the code generator in float64

    @wp.func(module=module)
    def column(a: mat33, k: int):
        return vec3(a[0, k], a[1, k], a[2, k])

    @wp.func(module=module)
    def head(g: vec4):
        return vec3(g[0], g[1], g[2])

    @wp.kernel(module=module, enable_backward=False)
    def p2g(
        lattice: Lattice,
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        A: wp.array2d[mat33],
        grid_m: wp.array2d[vec4],
    ):
        """Scatter momentum m v + A (x_i - x) and mass."""
        e, p = wp.tid()
        s = (x[e, p] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        m = mass[e, p]
        a = read_matrix(A, e, p) * (real(1.0) / lattice.inv_dx)
        ax, ay, az = column(a, 0), column(a, 1), column(a, 2)
        q0 = m * v[e, p] - a * f
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                wij = wx[i] * wy[j]
                qij = q0 + offset[i] * ax + offset[j] * ay
                for k in range(3):
                    w = wij * wz[k]
                    q = w * (qij + offset[k] * az)
                    wp.atomic_add(grid_m, e, row + k, vec4(q[0], q[1], q[2], w * m))

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_p2g(
        lattice: Lattice,
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        A: wp.array2d[mat33],
        adj_grid_m: wp.array2d[vec4],
        adj_x: wp.array2d[vec3],
        adj_v: wp.array2d[vec3],
        adj_A: wp.array2d[mat33],
    ):
        """Gather the adjoints of p2g: add to adj_x, set adj_v and adj_A."""
        e, p = wp.tid()
        s = (x[e, p] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx_, dy_, dz_ = weight_slopes(f[0]), weight_slopes(f[1]), weight_slopes(f[2])
        m = mass[e, p]
        dx = real(1.0) / lattice.inv_dx
        momentum = read_matrix(A, e, p)
        a = momentum * dx
        ax, ay, az = column(a, 0), column(a, 1), column(a, 2)
        q0 = m * v[e, p] - a * f
        h0 = vec3()
        hx = vec3()
        hy = vec3()
        hz = vec3()
        slope = vec3()
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                wij = wx[i] * wy[j]
                gx = dx_[i] * wy[j]
                gy = wx[i] * dy_[j]
                qij = q0 + offset[i] * ax + offset[j] * ay
                rij = vec3()
                for k in range(3):
                    g = read_node(adj_grid_m, e, row + k)
                    h = head(g)
                    sigma = wp.dot(h, qij + offset[k] * az) + m * g[3]
                    wh = (wij * wz[k]) * h
                    rij += wh
                    hz += offset[k] * wh
                    slope += sigma * vec3(gx * wz[k], gy * wz[k], wij * dz_[k])
                h0 += rij
                hx += offset[i] * rij
                hy += offset[j] * rij
        adj_v[e, p] = m * h0
        write_matrix(adj_A, e, p, dx * wp.matrix_from_cols(hx - f[0] * h0, hy - f[1] * h0, hz - f[2] * h0))
        adj_x[e, p] = adj_x[e, p] + lattice.inv_dx * slope - wp.transpose(momentum) * h0

    @wp.kernel(module=module, enable_backward=False)
    def g2p(
        lattice: Lattice,
        dt: real,
        x: wp.array2d[vec3],
        grid_v: wp.array2d[vec4],
        x_new: wp.array2d[vec3],
        v_new: wp.array2d[vec3],
        C_new: wp.array2d[mat33],
        left_box: wp.array[wp.int32],
    ):
        """Gather v' = sum w v_i and C' = 4/dx^2 sum w v_i (x_i - x)^T; move x' = x + dt v'."""
        e, p = wp.tid()
        s = (x[e, p] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        s0 = vec3()
        sx = vec3()
        sy = vec3()
        sz = vec3()
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                g0 = head(read_node(grid_v, e, row))
                g1 = head(read_node(grid_v, e, row + 1))
                g2 = head(read_node(grid_v, e, row + 2))
                wij = wx[i] * wy[j]
                r1 = (wij * wz[1]) * g1
                r2 = (wij * wz[2]) * g2
                rij = (wij * wz[0]) * g0 + r1 + r2
                s0 += rij
                sx += offset[i] * rij
                sy += offset[j] * rij
                sz += r1 + real(2.0) * r2
        v_new[e, p] = s0
        C = wp.matrix_from_cols(sx - f[0] * s0, sy - f[1] * s0, sz - f[2] * s0)
        write_matrix(C_new, e, p, (real(4.0) * lattice.inv_dx) * C)
        x_new[e, p] = x[e, p] + dt * s0
        if wp.min(wp.min(f[0], f[1]), f[2]) < real(0.49) or wp.max(wp.max(f[0], f[1]), f[2]) > real(1.51):
            left_box[e] = 1

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_g2p(
        lattice: Lattice,
        dt: real,
        x: wp.array2d[vec3],
        grid_v: wp.array2d[vec4],
        adj_x_new: wp.array2d[vec3],
        adj_v_new: wp.array2d[vec3],
        adj_C_new: wp.array2d[mat33],
        adj_grid_v: wp.array2d[vec4],
        adj_x: wp.array2d[vec3],
    ):
        """Scatter the adjoints of g2p: add to adj_grid_v, set adj_x."""
        e, p = wp.tid()
        s = (x[e, p] - lattice.origin) * lattice.inv_dx
        base = base_node(s, lattice)
        f = s - vec3(real(base[0]), real(base[1]), real(base[2]))
        corner = base - lattice.first
        wx, wy, wz = weights(f[0]), weights(f[1]), weights(f[2])
        dx_, dy_, dz_ = weight_slopes(f[0]), weight_slopes(f[1]), weight_slopes(f[2])
        c = (real(4.0) * lattice.inv_dx) * read_matrix(adj_C_new, e, p)
        cx, cy, cz = column(c, 0), column(c, 1), column(c, 2)
        q0 = adj_v_new[e, p] + dt * adj_x_new[e, p] - c * f
        slope = vec3()
        s0 = vec3()
        for i in range(3):
            for j in range(3):
                row = ((corner[0] + i) * lattice.ny + corner[1] + j) * lattice.nz + corner[2]
                wij = wx[i] * wy[j]
                gx = dx_[i] * wy[j]
                gy = wx[i] * dy_[j]
                qij = q0 + offset[i] * cx + offset[j] * cy
                for k in range(3):
                    vi = head(read_node(grid_v, e, row + k))
                    w = wij * wz[k]
                    q = qij + offset[k] * cz
                    sigma = wp.dot(q, vi)
                    s0 += w * vi
                    slope += sigma * vec3(gx * wz[k], gy * wz[k], wij * dz_[k])
                    wp.atomic_add(adj_grid_v, e, row + k, vec4(w * q[0], w * q[1], w * q[2], real(0.0)))
        adj_x[e, p] = adj_x_new[e, p] + lattice.inv_dx * (slope - wp.transpose(c) * s0)

    return SimpleNamespace(p2g=p2g, g2p=g2p, adjoint_p2g=adjoint_p2g, adjoint_g2p=adjoint_g2p)
