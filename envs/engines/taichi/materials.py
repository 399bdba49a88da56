"""What particles are made of, as Taichi kernels: stress from state, and how motion changes the state.

Each material is a pair (update, adjoint) of functions of the same arguments. `update` takes substep s to s + 1,

    S' = deform(S, C),    A = -dt V 4/dx^2 tau(S', C) + m C,

and `adjoint` adds to the gradients of S[s] and C[s] what those of S[s + 1] and A[s] say: by the compiler's AD, but for
plasticine, whose singular value decomposition the compiler cannot differentiate. tau is the Kirchhoff stress [Pa].
"""

from functools import cache
from typing import Any, no_type_check

from ..mpm.materials import Elastic, Fluid, Material, Plasticine
from ..mpm.materials.fluid import TORN
from ..mpm.materials.plasticine import ROUNDED, SMALLEST
from .runtime import real as real_type
from .runtime import ti

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

    @ti.kernel
    def update(
        s: ti.i32, batch: ti.i32, first: ti.i32, dt: real, scale: real, bulk: real, viscosity: real,
        mass: array(1), volume: array(1), C: array(3, 3, 3), J: array(3), A: array(3, 3, 3),
    ):  # fmt: skip
        for e, p in ti.ndrange(batch, J.shape[2]):
            c = C[s, e, first + p]
            one = ti.Matrix.identity(real, 3)
            j = ti.min(ti.exp(dt * c.trace()) * J[s, e, p], real(TORN))
            shear = c + c.transpose() - real(2.0 / 3.0) * c.trace() * one
            tau = bulk * ti.log(j) * one + j * viscosity * shear
            J[s + 1, e, p] = j
            A[s, e, first + p] = scale * volume[first + p] * tau + mass[first + p] * c

    return update, update.grad


@cache
@no_type_check
def _elastic(name: str) -> tuple[Any, Any]:
    """F' = (I + dt C) F, tau = mu (F' F'^T - I) + lam log(det F') I."""
    real, array = types(name)

    @ti.kernel
    def update(
        s: ti.i32, batch: ti.i32, first: ti.i32, dt: real, scale: real, mu: real, lam: real,
        mass: array(1), volume: array(1), C: array(3, 3, 3), F: array(3, 3, 3), A: array(3, 3, 3),
    ):  # fmt: skip
        for e, p in ti.ndrange(batch, F.shape[2]):
            c = C[s, e, first + p]
            one = ti.Matrix.identity(real, 3)
            f = (one + dt * c) @ F[s, e, p]
            tau = mu * (f @ f.transpose() - one) + lam * ti.log(f.determinant()) * one
            F[s + 1, e, p] = f
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
