"""The kernels of `plasticine` for a CPU in float32, in C++: eight particles at a time, and the same bits.

A decomposition waits for square roots and quotients that follow on each other; those of eight particles wait together.
Rotations go on until the last of the eight is diagonal, and change the others no more. Logarithms and exponentials are
those of the C library, one by one, since others would round otherwise.
"""

from functools import cache
from typing import Any

from ...rows import kernel_in_rows
from ..eight_cpu import GROUPS
from .decomposition_cpu import DECOMPOSE
from .plasticine import ROUNDED, SMALLEST, kernels

# Of each particle: its strain in its principal axes and the mean of one; where arrays are. Expressions are those of
# `plasticine`, in their order.
PRELUDE = (
    DECOMPOSE
    + f"""
    const float least = {SMALLEST}f, rounded = {ROUNDED}f;
"""
    + """
    auto log_strain = [&](Vec s) {
        Vec e;
        for (int l = 0; l < lanes; ++l) {
            e.x[l] = ::logf(__builtin_fmaxf(s.x[l], least));
            e.y[l] = ::logf(__builtin_fmaxf(s.y[l], least));
            e.z[l] = ::logf(__builtin_fmaxf(s.z[l], least));
        }
        return e;
    };
    auto mean = [](Vec e) { return (e.x + e.y + e.z) / 3.0f; };
    const float *M = &wp::index(mass, e, first), *VOLUME = &wp::index(volume, e, first);
    const float *CC = (const float*)&wp::index(C, e, first), *FF = (const float*)&wp::index(F, e, 0);
    const int count = F.shape[1];
"""
)
UPDATE = (
    PRELUDE
    + """
    float *FN = (float*)&wp::index(F_new, e, 0), *AA = (float*)&wp::index(A, e, first);
"""
    + GROUPS
    + """
        V f9[9], c9[9], moved[9], trial[9], U[9], W[9], m, v;
        read_all(FF, 9, at, f9);
        read_all(CC, 9, at, c9);
        read_all(M, 1, at, &m);
        read_all(VOLUME, 1, at, &v);
        for (int k = 0; k < 9; ++k) moved[k] = c9[k] * dt;
        multiply(moved, f9, trial);
        for (int k = 0; k < 9; ++k) trial[k] = f9[k] + trial[k];
        Vec s;
        decompose(trial, U, s, W);
        const Vec strain = log_strain(s);
        const V third = mean(strain);
        const Vec d = {strain.x - third, strain.y - third, strain.z - third};
        const V n = root(dot(d, d) + rounded);
        Vec f = s;
        const auto yields = ~(n <= kappa);
        if (any(yields)) {
            const V shorter = kappa / n;
            const Vec k = {third + shorter * d.x, third + shorter * d.y, third + shorter * d.z};
            for (int l = 0; l < lanes; ++l)
                if (yields[l]) {
                    f.x[l] = ::expf(k.x[l]);
                    f.y[l] = ::expf(k.y[l]);
                    f.z[l] = ::expf(k.z[l]);
                }
        }
        const V J = f.x * f.y * f.z, bulk = lam * J * (J - 1.0f);
        const float shear = 2.0f * mu;
        const Vec t = {
            shear * (f.x * (f.x - 1.0f)) + bulk,
            shear * (f.y * (f.y - 1.0f)) + bulk,
            shear * (f.z * (f.z - 1.0f)) + bulk};
        V stretched[9], turned[9], out[9];
        stretch(U, f, stretched);
        transpose(W, turned);
        multiply(stretched, turned, out);
        write_all(FN, 9, p, some, out);
        stretch(U, t, stretched);
        transpose(U, turned);
        multiply(stretched, turned, out);
        const V weight = scale * v;
        for (int k = 0; k < 9; ++k) out[k] = out[k] * weight + c9[k] * m;
        write_all(AA, 9, p, some, out);
    }
"""
)
ADJOINT = (
    PRELUDE
    + """
    const float* FA = (const float*)&wp::index(F_new_adjoint, e, 0);
    const float* AA = (const float*)&wp::index(A_adjoint, e, first);
    float *FO = (float*)&wp::index(F_adjoint, e, 0), *CO = (float*)&wp::index(C_adjoint, e, first);
    auto shrink = [](float a, float b) {
        const float h = 0.5f * (a - b);
        float ratio = 1.0f + h * h / 6.0f * (1.0f + h * h / 20.0f);
        if (__builtin_fabsf(h) > 0.1f) ratio = ::sinhf(h) / h;
        return ::expf(0.5f * (a + b)) * ratio;
    };
    auto slope = [&](float si, float sj, float ei, float ej) {
        if (si > least && sj > least) return 1.0f / shrink(ei, ej);
        if (si <= least && sj <= least) return 0.0f;
        return (ei - ej) / (si - sj);
    };
"""
    + GROUPS
    + """
        V f9[9], c9[9], advance[9], trial[9], U[9], W[9], fa[9], aa[9], m, v;
        read_all(FF, 9, at, f9);
        read_all(CC, 9, at, c9);
        read_all(FA, 9, at, fa);
        read_all(AA, 9, at, aa);
        read_all(M, 1, at, &m);
        read_all(VOLUME, 1, at, &v);
        for (int k = 0; k < 9; ++k) advance[k] = (k % 4 ? 0.0f : 1.0f) + c9[k] * dt;
        multiply(advance, f9, trial);
        Vec s;
        decompose(trial, U, s, W);
        const Vec strain = log_strain(s);
        const V third = mean(strain);
        const Vec d = {strain.x - third, strain.y - third, strain.z - third};
        const V size = root(dot(d, d) + rounded);
        const V one = V{} + 1.0f;
        Vec f = s;
        V a01 = one, a02 = one, a12 = one, c = one;
        const auto yields = size > kappa;
        if (any(yields)) {
            const V shorter = kappa / size;
            const Vec k = {third + shorter * d.x, third + shorter * d.y, third + shorter * d.z};
            c = yields ? shorter : c;
            for (int l = 0; l < lanes; ++l)
                if (yields[l]) {
                    f.x[l] = ::expf(k.x[l]);
                    f.y[l] = ::expf(k.y[l]);
                    f.z[l] = ::expf(k.z[l]);
                    a01[l] = c[l] * shrink(k.x[l], k.y[l]) * slope(s.x[l], s.y[l], strain.x[l], strain.y[l]);
                    a02[l] = c[l] * shrink(k.x[l], k.z[l]) * slope(s.x[l], s.z[l], strain.x[l], strain.z[l]);
                    a12[l] = c[l] * shrink(k.y[l], k.z[l]) * slope(s.y[l], s.z[l], strain.y[l], strain.z[l]);
                }
        }
        const V J = f.x * f.y * f.z;
        V Ut[9], Wt[9], part[9], G[9], T[9];
        transpose(U, Ut);
        transpose(W, Wt);
        multiply(Ut, fa, part);
        multiply(part, W, G);
        multiply(Ut, aa, part);
        multiply(part, U, T);
        const V weight = scale * v;
        for (int k = 0; k < 9; ++k) T[k] = T[k] * weight;
        const float shear = 2.0f * mu;
        Vec g = {G[0], G[4], G[8]};
        g = {
            g.x + shear * (T[0] * (f.x + f.x - 1.0f)),
            g.y + shear * (T[4] * (f.y + f.y - 1.0f)),
            g.z + shear * (T[8] * (f.z + f.z - 1.0f))};
        const V bulk = lam * (J + J - 1.0f) * (T[0] + T[4] + T[8]);
        g = {g.x + bulk * (f.y * f.z), g.y + bulk * (f.x * f.z), g.z + bulk * (f.x * f.y)};
        if (any(yields)) {
            const Vec h = {g.x * f.x, g.y * f.y, g.z * f.z};
            const V all = mean(h), less = c * dot(d, h) / (size * size);
            const Vec back = {
                all + c * (h.x - all) - less * d.x,
                all + c * (h.y - all) - less * d.y,
                all + c * (h.z - all) - less * d.z};
            auto steep = [&](V one) { return one > least ? 1.0f / one : V{}; };
            g = choose(yields, Vec{back.x * steep(s.x), back.y * steep(s.y), back.z * steep(s.z)}, g);
        }
        V P[9] = {g.x, g.x, g.x, g.x, g.y, g.x, g.x, g.x, g.z};
        auto pair = [&](int i, int j, V a, V fi, V fj, V si, V sj) {
            const V total = larger(si + sj, 1e-12f), b = (fi + fj) / total;
            const V bend = shear * (fi + fj - 1.0f) * a * (T[3 * i + j] + T[3 * j + i]) / total;
            const V even = 0.5f * (a + b), odd = 0.5f * (a - b), Gij = G[3 * i + j], Gji = G[3 * j + i];
            P[3 * i + j] = even * Gij + odd * Gji + bend * sj;
            P[3 * j + i] = even * Gji + odd * Gij + bend * si;
        };
        pair(0, 1, a01, f.x, f.y, s.x, s.y);
        pair(0, 2, a02, f.x, f.z, s.x, s.z);
        pair(1, 2, a12, f.y, f.z, s.y, s.z);
        V adj_trial[9], out[9], other[9];
        multiply(U, P, part);
        multiply(part, Wt, adj_trial);
        transpose(advance, other);
        multiply(other, adj_trial, out);
        write_all(FO, 9, p, some, out);
        transpose(f9, other);
        for (int k = 0; k < 9; ++k) part[k] = adj_trial[k] * dt;
        multiply(part, other, out);
        for (int k = 0; k < 9; ++k) out[k] = aa[k] * m + out[k];
        write_all(CO, 9, p, some, out);
    }
"""
)


@cache
def kernels_in_rows() -> tuple[Any, Any]:
    """Return (update, adjoint), each of whose threads has the row of an environment."""
    (update, adjoint, *_), module = kernels("float32"), "gradscape.plasticine.rows"
    return kernel_in_rows(update, UPDATE, "F", module), kernel_in_rows(adjoint, ADJOINT, "F", module)
