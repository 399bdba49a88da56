"""The kernels of `plasticine` for a CPU in float32, in C++: eight particles at a time, and the same bits.

A decomposition waits for square roots and quotients that follow on each other; those of eight particles wait together.
Rotations go on until the last of the eight is diagonal, and change the others no more. Logarithms and exponentials are
those of the C library, one by one, since others would round otherwise.
"""

from functools import cache
from typing import Any, no_type_check

import warp as wp

from ...runtime import precision, take_rows
from .decomposition import ROUND_OFF, SWEEPS, TINY
from .plasticine import ROUNDED, SMALLEST, kernels

# V has a number of each of eight particles; matrices are V[9] in rows, as they are stored, U and W the rotations of a
# decomposition, s its singular values. Expressions are those of `plasticine` and `decomposition`, in their order.
PRELUDE = (
    f"""
    typedef float V __attribute__((vector_size(32)));
    struct Vec {{ V x, y, z; }};
    const int lanes = 8;
    const float round_off = {ROUND_OFF["float32"]}f, tiny = {TINY}f, least = {SMALLEST}f, rounded = {ROUNDED}f;
    const int sweeps = {SWEEPS};
"""
    + """
    auto root = [](V a) { return __builtin_elementwise_sqrt(a); };
    auto larger = [](V a, float b) { return __builtin_elementwise_max(a, V{} + b); };
    auto any = [](auto mask) { return __builtin_reduce_or(mask) != 0; };
    auto dot = [](Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
    auto length = [&](Vec a) { return root(dot(a, a)); };
    auto cross = [](Vec a, Vec b) {
        return Vec{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    };
    auto over = [](Vec a, V b) { return Vec{a.x / b, a.y / b, a.z / b}; };
    auto choose = [](auto mask, Vec a, Vec b) {
        return Vec{mask ? a.x : b.x, mask ? a.y : b.y, mask ? a.z : b.z};
    };
    auto turn = [](V c, Vec a, V s, Vec b) {
        return Vec{c * a.x - s * b.x, c * a.y - s * b.y, c * a.z - s * b.z};
    };
    auto lean = [](V s, Vec a, V c, Vec b) {
        return Vec{s * a.x + c * b.x, s * a.y + c * b.y, s * a.z + c * b.z};
    };
    auto apply = [](const V* m, Vec v) {
        Vec r = {m[0] * v.x, m[3] * v.x, m[6] * v.x};
        r = {r.x + m[1] * v.y, r.y + m[4] * v.y, r.z + m[7] * v.y};
        return Vec{r.x + m[2] * v.z, r.y + m[5] * v.z, r.z + m[8] * v.z};
    };
    auto multiply = [](const V* a, const V* b, V* out) {
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                V sum = {};
                for (int k = 0; k < 3; ++k) sum = __builtin_elementwise_fma(a[3 * i + k], b[3 * k + j], sum);
                out[3 * i + j] = sum;
            }
    };
    auto transpose = [](const V* a, V* out) {
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) out[3 * i + j] = a[3 * j + i];
    };
    auto stretch = [&](const V* a, Vec f, V* out) {
        const V zero = {}, d[9] = {f.x, zero, zero, zero, f.y, zero, zero, zero, f.z};
        multiply(a, d, out);
    };
    auto read = [&](const float* a, int size, int first, int count, V* out) {
        for (int l = 0; l < lanes; ++l) {
            const float* one = a + size * (first + (l < count ? l : count - 1));
            for (int k = 0; k < size; ++k) out[k][l] = one[k];
        }
    };
    auto write = [&](float* a, int size, int first, int count, const V* values) {
        for (int l = 0; l < count; ++l)
            for (int k = 0; k < size; ++k) a[size * (first + l) + k] = values[k][l];
    };
    auto rotation = [&](V app, V aqq, V apq, V& c, V& s, V& t) {
        const V twice = 2.0f * apq, gap = aqq - app;
        const V span = __builtin_elementwise_abs(gap) + root(gap * gap + twice * twice);
        t = (gap < 0.0f ? -twice : twice) / larger(span, tiny);
        c = 1.0f / root(t * t + 1.0f);
        s = t * c;
    };
    auto decompose = [&](const V* F, V* U, Vec& sizes, V* W) {
        const Vec x = {F[0], F[3], F[6]}, y = {F[1], F[4], F[7]}, z = {F[2], F[5], F[8]};
        V a00 = dot(x, x), a11 = dot(y, y), a22 = dot(z, z), a01 = dot(x, y), a02 = dot(x, z), a12 = dot(y, z);
        const V zero = {}, one = zero + 1.0f;
        Vec v0 = {one, zero, zero}, v1 = {zero, one, zero}, v2 = {zero, zero, one};
        const V bound = round_off * round_off * (a00 + a11 + a22) * (a00 + a11 + a22);
        for (int sweep = 0; sweep < sweeps; ++sweep) {
            const auto on = a01 * a01 + a02 * a02 + a12 * a12 > bound;
            if (!any(on)) break;
            V c, s, t;
            rotation(a00, a11, a01, c, s, t);
            V b00 = a00 - t * a01, b11 = a11 + t * a01;
            V b02 = c * a02 - s * a12, b12 = s * a02 + c * a12;
            Vec w0 = turn(c, v0, s, v1), w1 = lean(s, v0, c, v1), w2 = v2;
            rotation(b00, a22, b02, c, s, t);
            b00 = b00 - t * b02;
            V b22 = a22 + t * b02;
            V b01 = -s * b12;
            b12 = c * b12;
            const Vec first = w0;
            w0 = turn(c, first, s, w2);
            w2 = lean(s, first, c, w2);
            rotation(b11, b22, b12, c, s, t);
            b11 = b11 - t * b12;
            b22 = b22 + t * b12;
            b02 = s * b01;
            b01 = c * b01;
            const Vec second = w1;
            w1 = turn(c, second, s, w2);
            w2 = lean(s, second, c, w2);
            a00 = on ? b00 : a00;
            a11 = on ? b11 : a11;
            a22 = on ? b22 : a22;
            a01 = on ? b01 : a01;
            a02 = on ? b02 : a02;
            a12 = on ? zero : a12;
            v0 = choose(on, w0, v0);
            v1 = choose(on, w1, v1);
            v2 = choose(on, w2, v2);
        }
        const V l0 = length(apply(F, v0)), l1 = length(apply(F, v1)), l2 = length(apply(F, v2));
        const auto zeroth = (l0 < l1) & (l0 < l2), middle = ~zeroth & (l1 < l2);
        const Vec n0 = choose(zeroth, v1, choose(middle, v2, v0)), n1 = choose(zeroth, v2, choose(middle, v0, v1));
        v2 = choose(zeroth, v0, choose(middle, v1, v2));
        const auto less = length(apply(F, n0)) < length(apply(F, n1));
        v0 = choose(less, n1, n0);
        v1 = choose(less, Vec{-n0.x, -n0.y, -n0.z}, n1);
        const Vec f0 = apply(F, v0), f1 = apply(F, v1);
        const V size0 = length(f0);
        const Vec u0 = choose(size0 <= tiny, Vec{one, zero, zero}, over(f0, size0));
        const V along = dot(u0, f1);
        const Vec rest = {f1.x - along * u0.x, f1.y - along * u0.y, f1.z - along * u0.z};
        const V size1 = length(rest);
        const auto thin = size1 <= round_off * dot(u0, f0);
        Vec u1 = over(rest, size1);
        if (any(thin)) {
            const auto steep = __builtin_elementwise_abs(u0.x) < 0.6f;
            const Vec beside = choose(steep, cross(u0, Vec{one, zero, zero}), cross(u0, Vec{zero, one, zero}));
            u1 = choose(thin, over(beside, length(beside)), u1);
        }
        const Vec u2 = cross(u0, u1);
        sizes = {dot(u0, f0), dot(u1, f1), dot(u2, apply(F, v2))};
        const V left[9] = {u0.x, u1.x, u2.x, u0.y, u1.y, u2.y, u0.z, u1.z, u2.z};
        const V right[9] = {v0.x, v1.x, v2.x, v0.y, v1.y, v2.y, v0.z, v1.z, v2.z};
        for (int k = 0; k < 9; ++k) {
            U[k] = left[k];
            W[k] = right[k];
        }
    };
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
    for (int p = 0; p < count; p += lanes) {
        const int some = count - p < lanes ? count - p : lanes;
        V f9[9], c9[9], moved[9], trial[9], U[9], W[9], m, v;
        read(FF, 9, p, some, f9);
        read(CC, 9, p, some, c9);
        read(M, 1, p, some, &m);
        read(VOLUME, 1, p, some, &v);
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
        write(FN, 9, p, some, out);
        stretch(U, t, stretched);
        transpose(U, turned);
        multiply(stretched, turned, out);
        const V weight = scale * v;
        for (int k = 0; k < 9; ++k) out[k] = out[k] * weight + c9[k] * m;
        write(AA, 9, p, some, out);
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
    for (int p = 0; p < count; p += lanes) {
        const int some = count - p < lanes ? count - p : lanes;
        V f9[9], c9[9], advance[9], trial[9], U[9], W[9], fa[9], aa[9], m, v;
        read(FF, 9, p, some, f9);
        read(CC, 9, p, some, c9);
        read(FA, 9, p, some, fa);
        read(AA, 9, p, some, aa);
        read(M, 1, p, some, &m);
        read(VOLUME, 1, p, some, &v);
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
        write(FO, 9, p, some, out);
        transpose(f9, other);
        for (int k = 0; k < 9; ++k) part[k] = adj_trial[k] * dt;
        multiply(part, other, out);
        for (int k = 0; k < 9; ++k) out[k] = aa[k] * m + out[k];
        write(CO, 9, p, some, out);
    }
"""
)


@cache
@no_type_check
def kernels_in_rows() -> tuple[Any, Any]:
    """Return (update, adjoint), each of whose threads has the row of an environment."""
    types, module = precision("float32"), "gradscape.plasticine.rows"
    real, mat33 = types.real, types.mat33

    @wp.func_native(UPDATE)
    def update_row(
        e: int,
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        kappa: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        F_new: wp.array2d[mat33],
        A: wp.array2d[mat33],
    ): ...

    @wp.func_native(ADJOINT)
    def adjoint_row(
        e: int,
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        kappa: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        F_new_adjoint: wp.array2d[mat33],
        A_adjoint: wp.array2d[mat33],
        F_adjoint: wp.array2d[mat33],
        C_adjoint: wp.array2d[mat33],
    ): ...

    @wp.kernel(module=module, enable_backward=False)
    def update(
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        kappa: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        F_new: wp.array2d[mat33],
        A: wp.array2d[mat33],
    ):
        e, _ = wp.tid()
        update_row(e, first, dt, scale, mu, lam, kappa, mass, volume, F, C, F_new, A)

    @wp.kernel(module=module, enable_backward=False)
    def adjoint(
        first: int,
        dt: real,
        scale: real,
        mu: real,
        lam: real,
        kappa: real,
        mass: wp.array2d[real],
        volume: wp.array2d[real],
        F: wp.array2d[mat33],
        C: wp.array2d[mat33],
        adj_F_new: wp.array2d[mat33],
        adj_A: wp.array2d[mat33],
        adj_F: wp.array2d[mat33],
        adj_C: wp.array2d[mat33],
    ):
        e, _ = wp.tid()
        adjoint_row(e, first, dt, scale, mu, lam, kappa, mass, volume, F, C, adj_F_new, adj_A, adj_F, adj_C)

    for kernel, plain in zip((update, adjoint), kernels("float32"), strict=True):
        take_rows(kernel, plain, "F")
    return update, adjoint
