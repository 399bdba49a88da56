"""Singular value decomposition, eight matrices at a time on a CPU in float32: C++ with the bits of `decomposition`."""

from ..eight_cpu import EIGHT
from .decomposition import ROUND_OFF, SWEEPS, TINY

# Matrices are V[9] in rows, as they are stored, U and W the rotations of a
# decomposition. Expressions are those of `decomposition` and of Warp's vectors and matrices, in their order.
DECOMPOSE = (
    EIGHT
    + f"""
    struct Vec {{ V x, y, z; }};
    const float round_off = {ROUND_OFF["float32"]}f, tiny = {TINY}f;
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
"""
)
