"""MLS-MPM (Hu et al. 2018) in Taichi, as DiffTaichi (Hu et al. 2020) writes it: the reference for the Warp engine.

One kernel per equation, time index first, gradients by the compiler. Substep s takes (x, v, C, S)[s] to s + 1:

    update    S' = deform(S, C), A = -dt V 4/dx^2 tau(S', C) + m C          (each material's own)
    p2g       m_i = sum w m, q_i = sum w (m v + A (x_i - x))
    grid_op   v_i = boundary(q_i / m_i + dt g) where there is mass
    g2p       v' = sum w v_i, C' = 4/dx^2 sum w v_i (x_i - x)^T
    move      x' = x + dt v'

Before a control step a fluid's volume ratios are smoothed, by torch.

Arrays are torch's, [substep, environment, particle] or [environment, node], and kernels work on their memory. Particles
are kept at the ends of control steps, and for all substeps of one: the backward pass simulates each control step once
more, and fills its one grid again for each substep. Threads add in any order, so the last digits of results may differ.
"""

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, reduce
from types import SimpleNamespace
from typing import Any, NamedTuple, no_type_check

import numpy as np
import torch

from ....landscapes.threads import one_torch_thread
from ...base import copied
from ..mpm.boundaries import FAINTEST, STICKY, TINY, UPSTREAM_DT, Boundary, Kind, LadleInTank, Open, Tool, ToolsInRoom
from ..mpm.materials import Elastic, Fluid, Material, Plasticine
from ..mpm.materials.fluid import TORN
from ..mpm.materials.plasticine import ROUNDED, SMALLEST
from ..mpm.model import EMPTY, Model, walls_that_reflect
from ..mpm.smoothing import smooth_volume_ratios
from ..runtime import precision
from .runtime import real as real_type
from .runtime import start, ti

# ---- What particles are made of, as Taichi kernels: stress from state, and how motion changes the state.
#
# Each material is a pair (update, adjoint) of functions of the same arguments. `update` takes substep s to s + 1,
#
# S' = deform(S, C),    A = -dt V 4/dx^2 tau(S', C) + m C,
#
# and `adjoint` adds to the gradients of S[s] and C[s] what those of S[s + 1] and A[s] say: by the compiler's AD, but
# for plasticine, whose singular value decomposition the compiler cannot differentiate. tau is the Kirchhoff stress
# [Pa].

SWEEPS = 5  # of Jacobi rotations; four reach round-off
VANISHED = 1e-30  # keeps what has vanished from being divided by
PAIRS = ((0, 1), (0, 2), (1, 2))
CLOSE = 0.1  # relative gap of two numbers below which their divided differences are summed as a series


def kernels(material: Material, name: str) -> tuple[Any, Any]:
    """Return (update, adjoint) of a material in the precision `name`."""
    makers = {Fluid: _fluid, Elastic: _elastic, Plasticine: _plasticine}
    update, adjoint = makers[type(material)](name)
    return update, adjoint


@cache
@no_type_check
def _fluid(name: str) -> tuple[Any, Any]:
    """J' = min(exp(dt tr C) J, TORN), tau = K log J' I + J' mu (C + C^T - 2/3 tr C I)."""
    real, array = types(name)

    @ti.func
    def law(J, c, dt, bulk, viscosity):
        one = ti.Matrix.identity(real, 3)
        j = ti.min(ti.exp(dt * c.trace()) * J, real(TORN))
        shear = c + c.transpose() - real(2.0 / 3.0) * c.trace() * one
        return j, bulk * ti.log(j) * one + j * viscosity * shear

    return _by_the_compiler(name, law, array(3))


@cache
@no_type_check
def _elastic(name: str) -> tuple[Any, Any]:
    """F' = (I + dt C) F, tau = mu (F' F'^T - I) + lam log(det F') I."""
    real, array = types(name)

    @ti.func
    def law(F, c, dt, mu, lam):
        one = ti.Matrix.identity(real, 3)
        f = (one + dt * c) @ F
        return f, mu * (f @ f.transpose() - one) + lam * ti.log(f.determinant()) * one

    return _by_the_compiler(name, law, array(3, 3, 3))


@no_type_check
def _by_the_compiler(name: str, law: Any, states: Any) -> tuple[Any, Any]:
    """Return the kernels of a law (S, C, dt, two constants) -> (S', tau) whose adjoint is the compiler's."""
    real, array = types(name)

    @ti.kernel
    def update(
        s: ti.i32, batch: ti.i32, first: ti.i32, dt: real, scale: real, one: real, other: real,
        mass: array(1), volume: array(1), C: array(3, 3, 3), S: states, A: array(3, 3, 3),
    ):  # fmt: skip
        for e, p in ti.ndrange(batch, S.shape[2]):
            c = C[s, e, first + p]
            new, tau = law(S[s, e, p], c, dt, one, other)
            S[s + 1, e, p] = new
            A[s, e, first + p] = scale * volume[first + p] * tau + mass[first + p] * c

    return update, update.grad


@cache
@no_type_check
def _plasticine(name: str) -> tuple[Any, Any]:
    """F' = U diag(f) V^T, tau = U diag(t) U^T of (I + dt C) F = U diag(s) V^T; see `_yield_functions`."""
    real, array = types(name)
    svd, (flow, pull) = _svd(name), _yield_functions(name)

    @ti.kernel
    def update(
        s: ti.i32, batch: ti.i32, first: ti.i32, dt: real, scale: real, mu: real, lam: real, kappa: real,
        mass: array(1), volume: array(1), C: array(3, 3, 3), F: array(3, 3, 3), A: array(3, 3, 3),
    ):  # fmt: skip
        for e, p in ti.ndrange(batch, F.shape[2]):
            c = C[s, e, first + p]
            U, sigma, V = svd((ti.Matrix.identity(real, 3) + dt * c) @ F[s, e, p])
            f = flow(sigma, kappa)
            J = f[0] * f[1] * f[2]
            t = real(2.0) * mu * f * (f - real(1.0)) + lam * J * (J - real(1.0))
            tau = U @ _spread(t) @ U.transpose()
            F[s + 1, e, p] = U @ _spread(f) @ V.transpose()
            A[s, e, first + p] = scale * volume[first + p] * tau + mass[first + p] * c

    @ti.kernel
    def transpose(
        s: ti.i32, batch: ti.i32, first: ti.i32, dt: real, scale: real, mu: real, lam: real, kappa: real,
        mass: array(1), volume: array(1), C: array(3, 3, 3), F: array(3, 3, 3),
        adj_C: array(3, 3, 3), adj_F: array(3, 3, 3), adj_A: array(3, 3, 3),
    ):  # fmt: skip
        for e, p in ti.ndrange(batch, F.shape[2]):
            advance = ti.Matrix.identity(real, 3) + dt * C[s, e, first + p]
            U, sigma, V = svd(advance @ F[s, e, p])
            a = adj_A[s, e, first + p]
            G = U.transpose() @ adj_F[s + 1, e, p] @ V
            T = scale * volume[first + p] * (U.transpose() @ a @ U)
            adj_trial = U @ pull(sigma, G, T, mu, lam, kappa) @ V.transpose()
            adj_F[s, e, p] += advance.transpose() @ adj_trial
            adj_C[s, e, first + p] += mass[first + p] * a + dt * adj_trial @ F[s, e, p].transpose()

    def adjoint(*inputs: Any) -> None:
        *constants, C, F, A = inputs
        transpose(*constants, C, F, C.grad, F.grad, A.grad)

    return update, adjoint


@ti.func
@no_type_check
def _diagonal(m):
    return ti.Vector([m[0, 0], m[1, 1], m[2, 2]])


@ti.func
@no_type_check
def _spread(v):
    zero = v[0] - v[0]
    return ti.Matrix([[v[0], zero, zero], [zero, v[1], zero], [zero, zero, v[2]]])


@no_type_check
def _svd(name: str) -> Any:
    """Return the function F -> (U, s, V) with rotations U and V; the least of s, in no order, has the sign of det F.

    Rotations from the right make the columns of F V orthogonal (Hestenes 1958). (ti.svd is off by up to 2e-10 in
    float64.)
    """
    real, _ = types(name)

    @ti.func
    def column(M, i: ti.template()):
        return ti.Vector([M[0, i], M[1, i], M[2, i]])

    @ti.func
    def rotate(M, i: ti.template(), j: ti.template(), c, s):
        new = M
        for row in ti.static(range(3)):
            new[row, i] = c * M[row, i] - s * M[row, j]
            new[row, j] = s * M[row, i] + c * M[row, j]
        return new

    @ti.func
    def svd(F):
        B, V = F, ti.Matrix.identity(real, 3)
        for _ in range(SWEEPS):
            for i, j in ti.static(PAIRS):
                x, y = column(B, i), column(B, j)
                gap, twice = y.dot(y) - x.dot(x), real(2.0) * x.dot(y)
                span = ti.abs(gap) + ti.sqrt(gap * gap + twice * twice)
                t = ti.select(gap < real(0.0), -twice, twice) / ti.max(span, real(VANISHED))
                c = real(1.0) / ti.sqrt(real(1.0) + t * t)
                B, V = rotate(B, i, j, c, t * c), rotate(V, i, j, c, t * c)
        s = ti.Vector([column(B, i).norm() for i in ti.static(range(3))])
        U = B
        for i in ti.static(range(3)):
            for row in ti.static(range(3)):
                U[row, i] = B[row, i] / ti.max(s[i], real(VANISHED))
        least = s.min()
        for i, j, k in ti.static(((0, 1, 2), (1, 2, 0), (2, 0, 1))):
            if s[i] == least:
                u = column(U, j).cross(column(U, k))
                s[i] = u.dot(column(B, i))
                for row in ti.static(range(3)):
                    U[row, i] = u[row]
        return U, s, V

    return svd


@no_type_check
def _yield_functions(name: str) -> tuple[Any, Any]:
    """Return the von Mises flow s -> f, and the transpose of the differential of F' and tau.

    With e = log max(s, SMALLEST), d = e - mean(e), n = sqrt(d.d + ROUNDED): f = s where n <= kappa, else
    f = exp(mean(e) + kappa d / n); and t = 2 mu f (f - 1) + lam J (J - 1), J = f_0 f_1 f_2.

    A change dB of the trial turns U and V, and P = U^T dB V gives what that does. Off the diagonal,

        Q = U^T dF' V:    Q_ij + Q_ji = a (P_ij + P_ji),    Q_ij - Q_ji = b (P_ij - P_ji),
        U^T dtau U:       (t_i - t_j) / (s_i^2 - s_j^2) (s_j P_ij + s_i P_ji),

    with a = (f_i - f_j) / (s_i - s_j), b = (f_i + f_j) / (s_i + s_j), and t_i - t_j = 2 mu (f_i + f_j - 1)(f_i - f_j):
    so a is the only quotient of differences, and it stays finite where singular values meet.
    """
    real = real_type(name)
    exp_quotient, log_quotient = _quotients(name)

    @ti.func
    def strain(s):
        e = ti.log(ti.max(s, real(SMALLEST)))
        mean = e.sum() / real(3.0)
        d = e - mean
        return e, mean, d, ti.sqrt(d.dot(d) + real(ROUNDED))

    @ti.func
    def flow(s, kappa):
        _, mean, d, n = strain(s)
        return ti.select(n > kappa, ti.exp(mean + kappa / n * d), s)

    @ti.func
    def pull_diagonal(s, f, G, T, mu, lam, kappa):
        J = f[0] * f[1] * f[2]
        rest = ti.Vector([f[1] * f[2], f[0] * f[2], f[0] * f[1]])
        g = _diagonal(G) + real(2.0) * mu * _diagonal(T) * (real(2.0) * f - real(1.0))
        g += lam * (real(2.0) * J - real(1.0)) * T.trace() * rest
        _, _, d, n = strain(s)
        if n > kappa:
            h = g * f
            mean, c = h.sum() / real(3.0), kappa / n
            h = mean + c * (h - mean) - c * d.dot(h) / (n * n) * d
            g = ti.select(s > real(SMALLEST), h / s, real(0.0))
        return g

    @ti.func
    def pull(s, G, T, mu, lam, kappa):
        e, mean, d, n = strain(s)
        f = flow(s, kappa)
        k = mean + kappa / n * d
        P = _spread(pull_diagonal(s, f, G, T, mu, lam, kappa))
        for i, j in ti.static(PAIRS):
            a = real(1.0)
            if n > kappa:
                a = kappa / n * exp_quotient(k[i], k[j]) * log_quotient(s[i], s[j], e[i], e[j])
            total = ti.max(s[i] + s[j], real(1e-12))
            b = (f[i] + f[j]) / total
            bend = real(2.0) * mu * (f[i] + f[j] - real(1.0)) * a / total * (T[i, j] + T[j, i])
            P[i, j] = (a * (G[i, j] + G[j, i]) + b * (G[i, j] - G[j, i])) / real(2.0) + bend * s[j]
            P[j, i] = (a * (G[i, j] + G[j, i]) - b * (G[i, j] - G[j, i])) / real(2.0) + bend * s[i]
        return P

    return flow, pull


@no_type_check
def _quotients(name: str) -> tuple[Any, Any]:
    """Return (exp x - exp y) / (x - y), and (e_i - e_j) / (s_i - s_j) for e = log max(s, SMALLEST)."""
    real = real_type(name)

    @ti.func
    def exp_quotient(x, y):
        h = (x - y) / real(2.0)
        z = h * h
        series = real(1.0) + z / real(6.0) * (real(1.0) + z / real(20.0) * (real(1.0) + z / real(42.0)))  # sinh(h) / h
        ratio = ti.exp((x + y) / real(2.0)) * series
        if ti.abs(h) > real(CLOSE):
            ratio = (ti.exp(x) - ti.exp(y)) / (x - y)
        return ratio

    @ti.func
    def log_quotient(si, sj, ei, ej):
        total = si + sj
        z = (si - sj) / total
        ratio = real(0.0)
        if ti.min(si, sj) > real(SMALLEST) and ti.abs(z) < real(CLOSE):
            for k in ti.static(range(6)):  # atanh(z) / z
                ratio += real(2.0) / total * z ** (2 * k) / real(2.0 * k + 1.0)
        elif ti.max(si, sj) > real(SMALLEST):
            ratio = (ei - ej) / (si - sj)
        return ratio

    return exp_quotient, log_quotient


@no_type_check
def types(name: str) -> tuple[Any, Any]:
    """Return the scalar type, and the function (indices, then the element's shape) -> type of an array."""
    real = real_type(name)

    def array(ndim, *shape):
        kinds = {0: lambda: real, 1: lambda n: ti.types.vector(n, real), 2: lambda n, m: ti.types.matrix(n, m, real)}
        return ti.types.ndarray(dtype=kinds[len(shape)](*shape), ndim=ndim)

    return real, array


# ---- What grid velocities meet, as Taichi functions: the boundaries' data, made of contacts that act one after
# another.
#
# A contact is a function (node position p [m], velocity v [m/s], environment e, tools, control step, fraction of it, 1
# over its span [1/s]) -> velocity. In a shell around a tool, velocities lose a share of what goes into it and are
# rubbed,
#
# v' = v + share(d) (rub(u - u_n n) - (u - u_n n) - u_n n)   where u = v - v_tool and u_n = n.u < 0,
#
# d being the signed distance and n its normal. Sizes and frictions are compiled in.

LADLE_SLIP, TOOL_SLIP = 1e-10, 1e-8  # added to squared sliding speeds [m^2/s^2], so that rest has a gradient
ON_WALL = 1e-6  # a wall's own nodes belong to it [m]


@cache
def boundary_contact(boundary: Boundary, name: str) -> Any:
    """Return all of a boundary's contacts as one, in the precision `name`. Raises ValueError for an unknown one."""
    if isinstance(boundary, Open):
        return _free()
    if isinstance(boundary, LadleInTank):
        contacts = [*_ladle(boundary, name), _drag(boundary, name)]
        edge = boundary.half_width - ON_WALL
        lower, upper = (-edge, ON_WALL, -edge), (edge, boundary.lid, edge)
        return reduce(_apply_both, [*contacts, _walls(lower, upper, name)])
    if isinstance(boundary, ToolsInRoom):
        slots = [sum(tool.slots for tool in boundary.tools[:j]) for j in range(len(boundary.tools))]
        contacts = [
            _tool(tool, slot, _influence(boundary, name), name)
            for tool, slot in zip(boundary.tools, slots, strict=True)
        ]
        lower = (boundary.lower[0], -1e9, boundary.lower[2])  # below it has a floor
        return reduce(_apply_both, [*contacts, _floor(boundary, name), _walls(lower, boundary.upper, name)])
    raise ValueError(f"the Taichi engine knows Open, LadleInTank and ToolsInRoom; got boundary {boundary!r}")


@no_type_check
def _free() -> Any:
    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        return v

    return contact


@no_type_check
def _apply_both(first: Any, second: Any) -> Any:
    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        return second(p, first(p, v, e, tools, step, fraction, rate), e, tools, step, fraction, rate)

    return contact


@cache
@no_type_check
def _shapes(name: str) -> SimpleNamespace:
    """Return signed distances (outward normal, distance [m]) of a point in each shape's own frame.

    All take the point, the shape's axis and two lengths, whether or not they have so many.
    """
    real = real_type(name)

    @ti.func
    def sphere(p, axis, radius, _):
        length = ti.sqrt(p.dot(p) + real(TINY))
        return p / length, length - radius

    @ti.func
    def capsule(p, axis, half_length, radius):
        along = ti.max(-half_length, ti.min(p.dot(axis), half_length))
        return sphere(p - along * axis, axis, radius, radius)

    @ti.func
    def torus(p, axis, ring, tube):
        axial = ti.sqrt(p[0] ** 2 + p[2] ** 2 + real(TINY))
        to_ring = p - ti.Vector([p[0], real(0.0), p[2]]) * (ring / axial)
        gap = axial - ring
        length = ti.sqrt(gap**2 + p[1] ** 2 + real(TINY))
        return to_ring / length, length - tube

    @ti.func
    def bowl(p, axis, radius, half_thickness):
        """Return the distance to an open half-sphere shell, its rim in the plane y = 0, its opening upwards."""
        out, gap = sphere(p, axis, radius, radius)
        side = ti.select(gap < real(0.0), -real(1.0), real(1.0))
        rim, to_rim = torus(p, axis, radius, half_thickness)
        below = p[1] < real(0.0)
        return ti.select(below, side * out, rim), ti.select(below, side * gap - half_thickness, to_rim)

    @ti.func
    def cylinder(p, axis, radius, half_height):
        axial = ti.sqrt(p[0] ** 2 + p[2] ** 2 + real(TINY))
        outward = ti.Vector([p[0], real(0.0), p[2]]) / axial
        upward = ti.Vector([real(0.0), ti.select(p[1] < real(0.0), -real(1.0), real(1.0)), real(0.0)])
        out, over = axial - radius, ti.abs(p[1]) - half_height
        to_edge = ti.sqrt(out**2 + over**2 + real(TINY))
        past_edge = (out > real(0.0)) & (over > real(0.0))
        n, d = ti.select(out > over, outward, upward), ti.max(out, over)
        edge = (out * outward + over * upward) / to_edge
        return ti.select(past_edge, edge, n), ti.select(past_edge, to_edge, d)

    return SimpleNamespace(sphere=sphere, capsule=capsule, torus=torus, bowl=bowl, cylinder=cylinder)


@cache
@no_type_check
def _laws(name: str) -> SimpleNamespace:
    """Return what contacts share: a tool's motion, Coulomb's friction, and the two together."""
    real = real_type(name)

    @ti.func
    def motion(tools: ti.template(), e, step, slot: ti.template(), fraction, rate):
        start = tools[e, step, slot]
        change = tools[e, step + 1, slot] - start
        return start + fraction * change, rate * change

    @ti.func
    def rub(t, normal, friction, slip: ti.template()):
        """Return the sliding velocity after a contact that stopped the `normal` velocity."""
        speed = ti.sqrt(t.dot(t) + real(slip))
        return t * ti.max(real(0.0), real(1.0) + friction * normal / speed)

    @ti.func
    def touch(v, body, n, share, held, friction, slip: ti.template()):
        """Take a share of the velocity that goes into a body, and what of it is held of that which goes out."""
        u = v - body
        normal = u.dot(n)
        t = u - normal * n
        felt = ti.select(normal < real(0.0), share, held)
        return v + felt * (rub(t, -ti.abs(normal), friction, slip) - u)

    return SimpleNamespace(motion=motion, rub=rub, touch=touch)


@no_type_check
def _ladle(ladle: LadleInTank, name: str) -> list[Any]:
    """Return the contacts with its bowl and, where it has one, with its handle, an upright capsule on the rim."""
    real, laws, shapes = real_type(name), _laws(name), _shapes(name)
    grip, held = _ladle_shares(ladle, name)

    @ti.func
    def up():
        return ti.Vector([real(0.0), real(1.0), real(0.0)])

    @ti.func
    def bowl(p, rim):
        return shapes.bowl(p - rim, up(), real(ladle.radius), real(ladle.half_thickness))

    @ti.func
    def handle(p, rim):
        half = real(ladle.height / 2)
        middle = rim + ti.Vector([-real(ladle.radius), half, real(0.0)])
        return shapes.capsule(p - middle, up(), half, real(ladle.half_thickness))

    def contact_with(distance):
        @ti.func
        def contact(p, v, e, tools: ti.template(), step, fraction, rate):
            rim, body = laws.motion(tools, e, step, 0, fraction, rate)
            n, d = distance(p, rim)
            return laws.touch(v, body, n, grip(d), held(d), real(ladle.friction), LADLE_SLIP)

        return contact

    return [contact_with(part) for part in ((bowl, handle) if ladle.height else (bowl,))]


@no_type_check
def _drag(tank: LadleInTank, name: str) -> Any:
    """Return what the tank's floor and walls leave of the velocity along them."""
    real = real_type(name)
    edge = tank.half_width - ON_WALL

    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        on = ti.Vector([ti.abs(p[0]) > real(edge), p[1] < real(ON_WALL), ti.abs(p[2]) > real(edge)])
        w = v
        for a, b in ti.static(((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))):
            w[b] = ti.select(on[a] and not on[b], real(tank.slip) * v[b], w[b])
        return w

    return contact


@no_type_check
def _ladle_shares(ladle: LadleInTank, name: str) -> tuple[Any, Any]:
    """Return which share of what goes into the ladle a node at a distance loses, and of what goes out."""
    real = real_type(name)

    @ti.func
    def fade(s):
        s = ti.max(real(0.0), ti.min(s, real(1.0)))
        return s * s * (real(3.0) - real(2.0) * s)

    @ti.func
    def grip(d):
        return fade(real(1.0) - d / real(ladle.band))

    @ti.func
    def held(d):
        return fade(-d / real(ladle.half_thickness))

    return grip, held


@no_type_check
def _tool(tool: Tool, slot: int, influence: Any, name: str) -> Any:
    real, laws = real_type(name), _laws(name)
    rolls, (a, b) = tool.kind is Kind.ROLLER, (*tool.size, 0.0)[:2]
    distance = getattr(_shapes(name), {Kind.ROLLER: "capsule"}.get(tool.kind, tool.kind.name.lower()))

    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        place, body = laws.motion(tools, e, step, slot, fraction, rate)
        local = p - place
        axis = up = ti.Vector([real(0.0), real(1.0), real(0.0)])
        if ti.static(rolls):
            angles, spin = laws.motion(tools, e, step, slot + 1, fraction, rate)
            axis = ti.Vector([ti.sin(angles[1]), real(0.0), ti.cos(angles[1])])
            body += (spin[0] * axis + spin[1] * up).cross(local)
        n, d = distance(local, axis, real(a), real(b))
        return laws.touch(v, body, n, influence(d), real(0.0), real(tool.friction), TOOL_SLIP)

    return contact


@no_type_check
def _influence(room: ToolsInRoom, name: str) -> Any:
    """Return the share of what runs into a tool that a node at a distance loses in a substep."""
    real, substeps = real_type(name), room.dt / UPSTREAM_DT

    @ti.func
    def influence(d):
        left = (real(1.0) - ti.exp(-real(room.softness) * ti.max(d, real(0.0)))) / real(1.0 - FAINTEST)
        inside = left <= real(0.0)
        decay = ti.exp(real(substeps) * ti.log(ti.select(inside, real(1.0), left)))
        return ti.select(inside, real(1.0), ti.max(real(1.0) - decay, real(0.0)))

    return influence


@no_type_check
def _floor(room: ToolsInRoom, name: str) -> Any:
    """Return the contact with the floor's nodes: nothing sinks, what presses is rubbed, or sticks."""
    real, laws = real_type(name), _laws(name)
    sticky = room.friction >= STICKY

    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        t = ti.Vector([real(0.0), ti.max(v[1], real(0.0)), real(0.0)])
        if ti.static(not sticky):
            sliding = laws.rub(ti.Vector([v[0], real(0.0), v[2]]), v[1], real(room.friction), TOOL_SLIP)
            t = ti.select(v[1] < real(0.0), sliding, v)
        return ti.select(p[1] <= real(room.floor), t, v)

    return contact


@no_type_check
def _walls(lower: tuple[float, ...], upper: tuple[float, ...], name: str) -> Any:
    """Return the contact with slippery walls around a box."""
    real = real_type(name)

    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        w = v
        for a in ti.static(range(3)):
            inward = ti.select(p[a] <= real(lower[a]), ti.max(v[a], real(0.0)), v[a])
            w[a] = ti.select(p[a] >= real(upper[a]), ti.min(inward, real(0.0)), inward)
        return w

    return contact


@dataclass(frozen=True, eq=False)
class States:
    """States over time: x, v, C and each body's own S, [time, environment, particle]."""

    x: torch.Tensor
    v: torch.Tensor
    C: torch.Tensor
    S: tuple[torch.Tensor, ...]

    def arrays(self) -> tuple[torch.Tensor, ...]:
        """Return every array."""
        return (self.x, self.v, self.C, *self.S)


class Grid(NamedTuple):
    """What nodes hold in one substep, [environment, i, j, k]: momentum, mass, velocity."""

    q: torch.Tensor
    m: torch.Tensor
    v: torch.Tensor


class Solver:
    """Run up to `capacity` environments of one model at once, and differentiate where their control steps end.

    Setting `stop` ends a run within a control step, with InterruptedError. One solver at a time: Taichi has one thread.
    """

    def __init__(self, model: Model, *, capacity: int, device: str, stop: threading.Event | None = None) -> None:
        start(device)
        self.model, self.capacity, self.device = model, capacity, device
        self.stop = stop or threading.Event()
        self.dtype = precision(model.precision).torch
        self.transfers = transfers(model.precision)
        boundary: Any = model.boundary
        self.grid_op = grid_kernel(model.precision, boundary_contact(boundary, model.precision))
        self.materials = [kernels(body.material, model.precision) for body in model.bodies]
        self.first = np.cumsum([0, *(len(body.x) for body in model.bodies)]).tolist()
        self.mass = self._constant(model.mass)
        self.volume = self._constant(np.concatenate([body.volume for body in model.bodies]))
        self.origin = ti.Vector(model.origin)
        self.empty = EMPTY * float(model.mass.min())
        walls = zip(walls_that_reflect(model), (1, -1), strict=True)
        self.images = [  # planes before and beyond a wall, or its own
            (axis, (wall + inwards * far) // 2, (wall - inwards * far) // 2)
            for places, inwards in walls
            for axis, wall in enumerate(places)
            for far in range(wall % 2, 4, 2)
            if wall
        ]
        self.smooth = [b for b, body in enumerate(model.bodies) if body.material.smoothing]
        self.checkpoints = self._states(model.steps + 1)
        self.tape = self._states(model.substeps + 1)
        self.A = self._zeros(model.substeps, capacity, model.particles, 3, 3)
        shape = capacity, *model.nodes
        self.grid = Grid(self._zeros(*shape, 3), self._zeros(*shape), self._zeros(*shape, 3))
        self.tools = self._zeros(capacity, model.steps + 1, model.boundary.slots, 3)
        self.differentiated = (*self.tape.arrays(), self.A, *self.grid, self.tools)
        for array in self.differentiated:
            array.requires_grad_()
            array.grad = torch.zeros_like(array)
        self.escaped = torch.zeros(capacity, dtype=torch.bool, device=device)
        self.tape_step = -1  # the control step in the tape
        self._start()

    @one_torch_thread()
    def run(self, tools: torch.Tensor) -> torch.Tensor:
        """Simulate with the boundary's `tools`, shape (batch, step + 1, slot, 3); return x at their end [m]."""
        batch, steps = len(tools), tools.shape[1] - 1
        self.escaped.zero_()
        self.tools.detach()[:batch, : steps + 1] = tools.detach().to(self.tools)
        for step in range(steps):
            self._advance(step, batch)
            self.escaped |= self._outside()
            for checkpoint, array in zip(self.checkpoints.arrays(), self.tape.arrays(), strict=True):
                checkpoint[step + 1] = array.detach()[-1]
        return self.read_positions(steps, batch)

    def read_positions(self, step: int, batch: int) -> torch.Tensor:
        """Return x [m] before control step `step` of the last run, shape (batch, particle, 3)."""
        return self.checkpoints.x[step, :batch]

    def read_trajectory(self, environment: int) -> torch.Tensor:
        """Return x [m] of one environment of the last run at the ends of control steps, (step + 1, particle, 3)."""
        return copied(self.checkpoints.x[:, environment])

    def read_escaped(self, batch: int) -> torch.Tensor:
        """Say for each environment whether a particle has left the grid, shape (batch,)."""
        return self.escaped[:batch].clone()

    @one_torch_thread()
    def gradient(self, adj_x: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """Return the adjoint of the tools of the last run from those of x before some control steps, same shapes."""
        batch = len(next(iter(adj_x.values())))
        for array in self.differentiated:
            _grad(array).zero_()
        for step in reversed(range(max(adj_x))):
            if step + 1 in adj_x:
                _grad(self.tape.x)[-1, :batch] += adj_x[step + 1].to(self.tape.x)
            if self.tape_step != step:
                self._advance(step, batch)
            self._retreat(step, batch)
        return _grad(self.tools)[:batch].clone()

    def _advance(self, step: int, batch: int) -> None:
        if self.stop.is_set():
            raise InterruptedError("the simulation was stopped")
        self.tape_step = step
        for checkpoint, array in zip(self.checkpoints.arrays(), self.tape.arrays(), strict=True):
            array.detach()[0] = checkpoint[step]
            array.detach()[1:] = 0.0  # what g2p adds to
        for b in self.smooth:
            self.tape.S[b].detach()[0, :batch] = smooth_volume_ratios(self.model, b, *self._before(b, step, batch))
        for s in range(self.model.substeps):
            for (update, _), inputs in zip(self.materials, self._material_inputs(s, batch), strict=True):
                update(*inputs)
            self._fill_grid(step, s, batch)
            self.transfers.g2p(*self._g2p_inputs(s, batch))
            self.transfers.move(*self._move_inputs(s, batch))

    def _fill_grid(self, step: int, s: int, batch: int) -> None:
        for array in self.grid:
            array.detach().zero_()
        self.transfers.p2g(*self._p2g_inputs(s, batch))
        self._reflect(self.grid.q.detach(), self.grid.m.detach(), fold=True)
        self.grid_op(*self._grid_inputs(step, s, batch))
        self._reflect(self.grid.v.detach(), fold=False)

    def _reflect(self, vectors: torch.Tensor, masses: torch.Tensor | None = None, *, fold: bool) -> None:
        """Give nodes beyond walls that reflect the image of what those before them hold (`mirrors`).

        To `fold` is the adjoint of that: what nodes beyond hold is added to their images.
        """
        for axis, before, beyond in self.images if fold else reversed(self.images):
            if before == beyond:
                vectors.movedim(axis + 1, 0)[before, ..., axis] = 0.0
                continue
            for values in (vectors,) if masses is None else (vectors, masses):
                across = values.movedim(axis + 1, 0)
                image = across[beyond if fold else before].clone()
                if values is vectors:
                    image[..., axis] *= -1.0
                if fold:
                    across[before] += image
                across[beyond] = 0.0 if fold else image

    def _retreat(self, step: int, batch: int) -> None:
        """Take gradients from the tape's last state to its first, then to the last of the step before."""
        _grad(self.A).zero_()
        for s in reversed(range(self.model.substeps)):
            self._fill_grid(step, s, batch)
            for array in self.grid:
                _grad(array).zero_()
            self.transfers.move.grad(*self._move_inputs(s, batch))
            self.transfers.g2p.grad(*self._g2p_inputs(s, batch))
            self._reflect(_grad(self.grid.v), fold=True)
            self.grid_op.grad(*self._grid_inputs(step, s, batch))
            self._reflect(_grad(self.grid.q), _grad(self.grid.m), fold=False)
            self.transfers.p2g.grad(*self._p2g_inputs(s, batch))
            for (_, adjoint), inputs in zip(self.materials, self._material_inputs(s, batch), strict=True):
                adjoint(*inputs)
        for b in self.smooth:
            self._retreat_smoothing(b, step, batch)
        for array in self.tape.arrays():
            grad = _grad(array)
            grad[-1] = grad[0]
            grad[:-1] = 0.0

    def _before(self, b: int, step: int, batch: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return x [m] and J of body b before a control step, and before J is smoothed."""
        x = self.checkpoints.x[step, :batch, self.first[b] : self.first[b + 1]]
        return x, self.checkpoints.S[b][step, :batch]

    def _retreat_smoothing(self, b: int, step: int, batch: int) -> None:
        """Turn the gradient of the tape's first J of body b into that of J before smoothing; add to that of x."""
        x, J = (values.clone().requires_grad_() for values in self._before(b, step, batch))
        grad_J = _grad(self.tape.S[b])[0, :batch]
        with torch.enable_grad():
            smoothed = smooth_volume_ratios(self.model, b, x, J)
        found = torch.autograd.grad(smoothed, (x, J), grad_J)
        _grad(self.tape.x)[0, :batch, self.first[b] : self.first[b + 1]] += found[0]
        grad_J[:] = found[1]

    def _material_inputs(self, s: int, batch: int) -> list[tuple[Any, ...]]:
        model, tape = self.model, self.tape
        scale = -model.dt * 4.0 / model.dx**2
        each = self.mass, self.volume, tape.C
        return [
            (s, batch, first, model.dt, scale, *body.material.constants().values(), *each, S, self.A)
            for body, first, S in zip(model.bodies, self.first[:-1], tape.S, strict=True)
        ]

    def _p2g_inputs(self, s: int, batch: int) -> tuple[Any, ...]:
        tape, grid = self.tape, self.grid
        return s, batch, self.origin, self.model.dx, self.mass, tape.x, tape.v, self.A, grid.q, grid.m

    def _grid_inputs(self, step: int, s: int, batch: int) -> tuple[Any, ...]:
        model, fall = self.model, self.model.dt * self.model.gravity
        time = step, s / model.substeps, 1.0 / (model.substeps * model.dt)
        return batch, self.origin, model.dx, fall, self.empty, *time, self.tools, *self.grid

    def _g2p_inputs(self, s: int, batch: int) -> tuple[Any, ...]:
        tape = self.tape
        return s, batch, self.origin, self.model.dx, tape.x, self.grid.v, tape.v, tape.C

    def _move_inputs(self, s: int, batch: int) -> tuple[Any, ...]:
        return s, batch, self.model.dt, self.tape.v, self.tape.x

    def _outside(self) -> torch.Tensor:
        """Say for each environment whether particles in the tape had nodes that the grid has not."""
        origin, last = (self._constant(np.array(values)) for values in (self.model.origin, self.model.nodes))
        node = ((self.tape.x.detach()[:-1] - origin) / self.model.dx - 0.5).floor()
        return ~((node >= 0) & (node <= last - 3)).all(dim=3).all(dim=2).all(dim=0)

    def _states(self, times: int) -> States:
        count = times, self.capacity
        initial = [body.material.initial(body.ratio).shape for body in self.model.bodies]
        x, v, C = (self._zeros(*count, self.model.particles, *shape) for shape in ((3,), (3,), (3, 3)))
        return States(x, v, C, tuple(self._zeros(*count, *shape) for shape in initial))

    def _zeros(self, *shape: int) -> torch.Tensor:
        return torch.zeros(shape, dtype=self.dtype, device=self.device)

    def _constant(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(self.device, self.dtype)

    def _start(self) -> None:
        self.checkpoints.x[0] = self._constant(np.concatenate([body.x for body in self.model.bodies]))
        for body, S in zip(self.model.bodies, self.checkpoints.S, strict=True):
            S[0] = self._constant(body.material.initial(body.ratio))


def _grad(array: torch.Tensor) -> torch.Tensor:
    if array.grad is None:
        raise ValueError("this array has no gradient")
    return array.grad


@cache
@no_type_check
def transfers(name: str) -> SimpleNamespace:
    """Return the kernels `p2g, g2p, move` of one precision.

    Each particle's 27 nodes are taken in rows of three, or planes of nine, that are unrolled: to unroll them all takes
    the compiler three minutes, to unroll none halves the speed. Rows and planes are part of the one parallel loop. In a
    loop inside it, AD keeps only one turn's share of what was computed before, and may read what was never written.
    """
    real, array = types(name)
    vec3 = ti.types.vector(3, real)

    @ti.func
    def spline(d):
        """Return the quadratic B-spline's weight at a distance of d nodes."""
        far = ti.max(real(1.5) - ti.abs(d), real(0.0))
        return ti.select(ti.abs(d) < real(0.5), real(0.75) - d * d, real(0.5) * far * far)

    @ti.func
    def lowest(y, grid: ti.template()):
        """Return the lowest node that a particle at y [nodes] meets; one out of the grid meets its edge."""
        node = ti.floor(y - real(0.5), ti.i32)
        for a in ti.static(range(3)):
            node[a] = ti.max(0, ti.min(node[a], grid.shape[a + 1] - 3))
        return node

    @ti.kernel
    def p2g(
        s: ti.i32, batch: ti.i32, origin: vec3, dx: real, mass: array(1),
        x: array(3, 3), v: array(3, 3), A: array(3, 3, 3), q: array(4, 3), m: array(4),
    ):  # fmt: skip
        for e, p, i, j in ti.ndrange(batch, x.shape[2], 3, 3):
            y = (x[s, e, p] - origin) / dx
            for k in ti.static(range(3)):
                node = lowest(y, m) + ti.Vector([i, j, k])
                d = ti.cast(node, real) - y
                w = spline(d[0]) * spline(d[1]) * spline(d[2])
                q[e, node[0], node[1], node[2]] += w * (mass[p] * v[s, e, p] + dx * (A[s, e, p] @ d))
                m[e, node[0], node[1], node[2]] += w * mass[p]

    @ti.kernel
    def g2p(
        s: ti.i32, batch: ti.i32, origin: vec3, dx: real,
        x: array(3, 3), grid_v: array(4, 3), v: array(3, 3), C: array(3, 3, 3),
    ):  # fmt: skip
        for e, p, i in ti.ndrange(batch, x.shape[2], 3):
            y = (x[s, e, p] - origin) / dx
            plane_v = ti.Vector.zero(real, 3)
            plane_C = ti.Matrix.zero(real, 3, 3)
            for j, k in ti.static(ti.ndrange(3, 3)):
                node = lowest(y, grid_v) + ti.Vector([i, j, k])
                d = ti.cast(node, real) - y
                w = spline(d[0]) * spline(d[1]) * spline(d[2])
                share = w * grid_v[e, node[0], node[1], node[2]]
                plane_v += share
                plane_C += (real(4.0) / dx) * share.outer_product(d)
            v[s + 1, e, p] += plane_v
            C[s + 1, e, p] += plane_C

    @ti.kernel
    def move(s: ti.i32, batch: ti.i32, dt: real, v: array(3, 3), x: array(3, 3)):
        for e, p in ti.ndrange(batch, x.shape[2]):
            x[s + 1, e, p] = x[s, e, p] + dt * v[s + 1, e, p]

    return SimpleNamespace(p2g=p2g, g2p=g2p, move=move)


@cache
@no_type_check
def grid_kernel(name: str, contact: Any) -> Any:
    """Return the kernel that turns nodes' momentum into velocity after gravity and boundary; `fall` is dt g."""
    real, array = types(name)
    vec3 = ti.types.vector(3, real)

    @ti.kernel
    def grid_op(
        batch: ti.i32, origin: vec3, dx: real, fall: real, empty: real, step: ti.i32, fraction: real, rate: real,
        tools: array(3, 3), q: array(4, 3), m: array(4), v: array(4, 3),
    ):  # fmt: skip
        for e, i, j, k in ti.ndrange(batch, m.shape[1], m.shape[2], m.shape[3]):
            if m[e, i, j, k] > empty:
                p = origin + dx * ti.Vector([real(i), real(j), real(k)])
                free = q[e, i, j, k] / m[e, i, j, k] - ti.Vector([real(0.0), fall, real(0.0)])
                v[e, i, j, k] = contact(p, free, e, tools, step, fraction, rate)

    return grid_op
