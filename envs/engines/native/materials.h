// The materials of MLS-MPM for a CPU, eight particles at a time: `materials` has the formulas.
//
// A decomposition waits for square roots and quotients that follow on each other; those of eight particles wait
// together. Rotations go on until the last of the eight is diagonal, and change the others no more.
#pragma once
#include "transfers.h"

namespace gradscape {

// ---- a viscous fluid: its trial volume ratio and shear

template <typename Real> inline Eight<Real> trace(const Eight<Real>* a) { return a[0] + a[4] + a[8]; }
template <typename Real> inline void find_shear(const Eight<Real>* C, Eight<Real>* out) {
    const Eight<Real> mean = (Real(2.0) / Real(3.0)) * trace<Real>(C), none = mean * Real(0.0);
    for (int k = 0; k < 9; ++k) out[k] = C[k] + C[k % 3 * 3 + k / 3] - (k % 4 ? none : mean);
}
template <typename Real> struct FluidTrial {
    Eight<Real> c[9], shear[9], m, weight, growth, grown, j;
    FluidTrial(
        const Group& group, const Real* M, const Real* VOLUME, const Real* JJ, const Real* CC, Real dt, Real scale,
        Real torn) {
        read_all(CC, 9, group, c);
        find_shear<Real>(c, shear);
        m = read(M, 1, group);
        weight = scale * read(VOLUME, 1, group);
        growth = exponential(dt * trace<Real>(c));
        grown = growth * read(JJ, 1, group);
        j = grown <= torn ? grown : Eight<Real>{} + torn;
    }
};

template <typename Real, typename Law>
inline void fluid_update(
    int e, const Law& law, const Rows<Real>& J, const Rows<Mat33<Real>>& C, const Rows<Real>& J_new,
    const Rows<Mat33<Real>>& A, double torn) {
    const int first = law.first;
    const Real dt = law.dt, scale = law.scale, bulk = law.bulk, viscosity = law.viscosity;
    const Real *M = row_of(law.mass, e, first), *VOLUME = row_of(law.volume, e, first), *JJ = row_of(J, e);
    const Real* CC = row_of(C, e, first);
    Real *JN = row_of(J_new, e), *AA = row_of(A, e, first);
    for (int p = 0, count = J.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        const FluidTrial<Real> trial(group, M, VOLUME, JJ, CC, dt, scale, Real(torn));
        const Eight<Real> pressure = bulk * logarithm(trial.j), none = pressure * Real(0.0);
        const Eight<Real> stiff = trial.j * viscosity;
        write<Real>(JN, 1, group, trial.j);
        Eight<Real> a[9];
        for (int k = 0; k < 9; ++k)
            a[k] = ((k % 4 ? none : pressure) + trial.shear[k] * stiff) * trial.weight + trial.c[k] * trial.m;
        write_all(AA, 9, group, a);
    }
}

template <typename Real, typename Law>
inline void fluid_adjoint(
    int e, const Law& law, const Rows<Real>& J, const Rows<Mat33<Real>>& C, const Rows<Real>& adj_J_new,
    const Rows<Mat33<Real>>& adj_A, const Rows<Real>& adj_J, const Rows<Mat33<Real>>& adj_C, double torn) {
    const int first = law.first;
    const Real dt = law.dt, scale = law.scale, bulk = law.bulk, viscosity = law.viscosity;
    const Real *M = row_of(law.mass, e, first), *VOLUME = row_of(law.volume, e, first), *JJ = row_of(J, e);
    const Real *CC = row_of(C, e, first), *JN = row_of(adj_J_new, e), *AA = row_of(adj_A, e, first);
    Real *JA = row_of(adj_J, e), *CA = row_of(adj_C, e, first);
    for (int p = 0, count = J.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        const FluidTrial<Real> trial(group, M, VOLUME, JJ, CC, dt, scale, Real(torn));
        Eight<Real> a[9], g[9], t[9], work = {};
        read_all(AA, 9, group, a);
        for (int k = 0; k < 9; ++k) {
            g[k] = a[k] * trial.weight;
            work = __builtin_elementwise_fma(g[k], trial.shear[k], work);
        }
        Eight<Real> adj_j = read(JN, 1, group) + bulk * trace<Real>(g) / trial.j + viscosity * work;
        adj_j = trial.grown > Real(torn) ? Eight<Real>{} : adj_j;
        write<Real>(JA, 1, group, trial.growth * adj_j);
        find_shear<Real>(g, t);
        const Eight<Real> dilation = dt * trial.j * adj_j, none = dilation * Real(0.0), stiff = trial.j * viscosity;
        for (int k = 0; k < 9; ++k) a[k] = a[k] * trial.m + t[k] * stiff + (k % 4 ? none : dilation);
        write_all(CA, 9, group, a);
    }
}

// ---- vectors and matrices of eight particles; matrices are in rows, as they are stored

template <typename V> struct Triple { V x, y, z; };

template <typename V> inline V root(V a) { return __builtin_elementwise_sqrt(a); }
template <typename V> inline V larger(V a, Element<V> b) { return __builtin_elementwise_max(a, V{} + b); }
template <typename Mask> inline bool any(Mask mask) { return __builtin_reduce_or(mask) != 0; }
template <typename V> inline V dot(Triple<V> a, Triple<V> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <typename V> inline V length(Triple<V> a) { return root(dot(a, a)); }
template <typename V> inline Triple<V> cross(Triple<V> a, Triple<V> b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <typename V> inline Triple<V> over(Triple<V> a, V b) { return {a.x / b, a.y / b, a.z / b}; }
template <typename V> inline V mean(Triple<V> e) { return (e.x + e.y + e.z) / Element<V>(3.0); }
template <typename Mask, typename V> inline Triple<V> choose(Mask mask, Triple<V> a, Triple<V> b) {
    return {mask ? a.x : b.x, mask ? a.y : b.y, mask ? a.z : b.z};
}
template <typename V> inline Triple<V> turn(V c, Triple<V> a, V s, Triple<V> b) {
    return {c * a.x - s * b.x, c * a.y - s * b.y, c * a.z - s * b.z};
}
template <typename V> inline Triple<V> lean(V s, Triple<V> a, V c, Triple<V> b) {
    return {s * a.x + c * b.x, s * a.y + c * b.y, s * a.z + c * b.z};
}
template <typename V> inline Triple<V> apply(const V* m, Triple<V> v) {
    Triple<V> r = {m[0] * v.x, m[3] * v.x, m[6] * v.x};
    r = {r.x + m[1] * v.y, r.y + m[4] * v.y, r.z + m[7] * v.y};
    return {r.x + m[2] * v.z, r.y + m[5] * v.z, r.z + m[8] * v.z};
}
template <typename V> inline void multiply(const V* a, const V* b, V* out) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            V sum = {};
            for (int k = 0; k < 3; ++k) sum = __builtin_elementwise_fma(a[3 * i + k], b[3 * k + j], sum);
            out[3 * i + j] = sum;
        }
}
template <typename V> inline void transpose(const V* a, V* out) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[3 * i + j] = a[3 * j + i];
}
template <typename V> inline void stretch(const V* a, Triple<V> f, V* out) {
    const V zero = {}, d[9] = {f.x, zero, zero, zero, f.y, zero, zero, zero, f.z};
    multiply(a, d, out);
}

// ---- the singular value decomposition of `decomposition`

template <typename V> inline void rotation(V app, V aqq, V apq, V& c, V& s, V& t, Element<V> tiny) {
    using Real = Element<V>;
    const V twice = Real(2.0) * apq, gap = aqq - app;
    const V span = __builtin_elementwise_abs(gap) + root(gap * gap + twice * twice);
    t = (gap < Real(0.0) ? -twice : twice) / larger(span, tiny);
    c = Real(1.0) / root(t * t + Real(1.0));
    s = t * c;
}

// The eigenvectors of the symmetric matrix of these entries.
template <typename V>
inline void diagonalise(V a00, V a11, V a22, V a01, V a02, V a12, Triple<V>* v, int sweeps, Element<V> round_off,
    Element<V> tiny) {
    const V zero = {}, one = zero + Element<V>(1.0);
    v[0] = {one, zero, zero}, v[1] = {zero, one, zero}, v[2] = {zero, zero, one};
    const V bound = round_off * round_off * (a00 + a11 + a22) * (a00 + a11 + a22);
    for (int sweep = 0; sweep < sweeps; ++sweep) {
        const auto on = a01 * a01 + a02 * a02 + a12 * a12 > bound;
        if (!any(on)) break;
        V c, s, t;
        rotation(a00, a11, a01, c, s, t, tiny);
        V b00 = a00 - t * a01, b11 = a11 + t * a01;
        V b02 = c * a02 - s * a12, b12 = s * a02 + c * a12;
        Triple<V> w0 = turn(c, v[0], s, v[1]), w1 = lean(s, v[0], c, v[1]), w2 = v[2];
        rotation(b00, a22, b02, c, s, t, tiny);
        b00 = b00 - t * b02;
        V b22 = a22 + t * b02;
        V b01 = -s * b12;
        b12 = c * b12;
        const Triple<V> first = w0;
        w0 = turn(c, first, s, w2);
        w2 = lean(s, first, c, w2);
        rotation(b11, b22, b12, c, s, t, tiny);
        b11 = b11 - t * b12;
        b22 = b22 + t * b12;
        b02 = s * b01;
        b01 = c * b01;
        const Triple<V> second = w1;
        w1 = turn(c, second, s, w2);
        w2 = lean(s, second, c, w2);
        a00 = on ? b00 : a00;
        a11 = on ? b11 : a11;
        a22 = on ? b22 : a22;
        a01 = on ? b01 : a01;
        a02 = on ? b02 : a02;
        a12 = on ? zero : a12;
        v[0] = choose(on, w0, v[0]);
        v[1] = choose(on, w1, v[1]);
        v[2] = choose(on, w2, v[2]);
    }
}

template <typename V>
inline void decompose(const V* F, V* U, Triple<V>& sizes, V* W, int sweeps, Element<V> round_off, Element<V> tiny) {
    using Real = Element<V>;
    const Triple<V> x = {F[0], F[3], F[6]}, y = {F[1], F[4], F[7]}, z = {F[2], F[5], F[8]};
    const V zero = {}, one = zero + Real(1.0);
    Triple<V> v[3];
    diagonalise(dot(x, x), dot(y, y), dot(z, z), dot(x, y), dot(x, z), dot(y, z), v, sweeps, round_off, tiny);
    const V l0 = length(apply(F, v[0])), l1 = length(apply(F, v[1])), l2 = length(apply(F, v[2]));
    const auto zeroth = (l0 < l1) & (l0 < l2), middle = ~zeroth & (l1 < l2);
    const Triple<V> n0 = choose(zeroth, v[1], choose(middle, v[2], v[0]));
    const Triple<V> n1 = choose(zeroth, v[2], choose(middle, v[0], v[1]));
    const Triple<V> v2 = choose(zeroth, v[0], choose(middle, v[1], v[2]));
    const auto less = length(apply(F, n0)) < length(apply(F, n1));
    const Triple<V> v0 = choose(less, n1, n0), v1 = choose(less, Triple<V>{-n0.x, -n0.y, -n0.z}, n1);
    const Triple<V> f0 = apply(F, v0), f1 = apply(F, v1);
    const V size0 = length(f0);
    const Triple<V> u0 = choose(size0 <= tiny, Triple<V>{one, zero, zero}, over(f0, size0));
    const V along = dot(u0, f1);
    const Triple<V> rest = {f1.x - along * u0.x, f1.y - along * u0.y, f1.z - along * u0.z};
    const V size1 = length(rest);
    const auto thin = size1 <= round_off * dot(u0, f0);
    Triple<V> u1 = over(rest, size1);
    if (any(thin)) {
        const auto steep = __builtin_elementwise_abs(u0.x) < Real(0.6);
        const Triple<V> normal =
            choose(steep, cross(u0, Triple<V>{one, zero, zero}), cross(u0, Triple<V>{zero, one, zero}));
        u1 = choose(thin, over(normal, length(normal)), u1);
    }
    const Triple<V> u2 = cross(u0, u1);
    sizes = {dot(u0, f0), dot(u1, f1), dot(u2, apply(F, v2))};
    const V left[9] = {u0.x, u1.x, u2.x, u0.y, u1.y, u2.y, u0.z, u1.z, u2.z};
    const V right[9] = {v0.x, v1.x, v2.x, v0.y, v1.y, v2.y, v0.z, v1.z, v2.z};
    for (int k = 0; k < 9; ++k) {
        U[k] = left[k];
        W[k] = right[k];
    }
}

// ---- plasticine

template <typename Real> struct Yield {
    Real least, rounded, round_off, tiny;  // as `plasticine` and `decomposition` name them
    int sweeps;
};

// A trial U diag(s) W^T, its strain in principal axes, the mean of that, what differs from it, and how far that is.
template <typename Real> struct PlasticTrial {
    using V = Eight<Real>;
    V U[9], W[9], third, size;
    Triple<V> s, strain, d;

    PlasticTrial(const V* trial, const Yield<Real>& yield) {
        decompose(trial, U, s, W, yield.sweeps, yield.round_off, yield.tiny);
        for (int l = 0; l < lanes; ++l) {
            strain.x[l] = logarithm_of(wp::max(Real(s.x[l]), yield.least));
            strain.y[l] = logarithm_of(wp::max(Real(s.y[l]), yield.least));
            strain.z[l] = logarithm_of(wp::max(Real(s.z[l]), yield.least));
        }
        third = mean(strain);
        d = {strain.x - third, strain.y - third, strain.z - third};
        size = root(dot(d, d) + yield.rounded);
    }
    // The strain of a trial that is `shorter` times as far from its mean.
    Triple<V> returned(V shorter) const {
        return {third + shorter * d.x, third + shorter * d.y, third + shorter * d.z};
    }
};

template <typename Real, typename Law>
inline void plasticine_update(
    int e, const Law& law, const Rows<Mat33<Real>>& F, const Rows<Mat33<Real>>& C, const Rows<Mat33<Real>>& F_new,
    const Rows<Mat33<Real>>& A, double least, double rounded, double round_off, double tiny, int sweeps) {
    const int first = law.first;
    const Real dt = law.dt, scale = law.scale, mu = law.mu, lam = law.lam, kappa = law.kappa;
    const Yield<Real> yield{Real(least), Real(rounded), Real(round_off), Real(tiny), sweeps};
    using V = Eight<Real>;
    const Real *M = row_of(law.mass, e, first), *VOLUME = row_of(law.volume, e, first);
    const Real *CC = row_of(C, e, first), *FF = row_of(F, e);
    Real *FN = row_of(F_new, e), *AA = row_of(A, e, first);
    for (int p = 0, count = F.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        V f9[9], c9[9], moved[9], trial[9];
        read_all(FF, 9, group, f9);
        read_all(CC, 9, group, c9);
        const V m = read(M, 1, group), v = read(VOLUME, 1, group);
        for (int k = 0; k < 9; ++k) moved[k] = c9[k] * dt;
        multiply(moved, f9, trial);
        for (int k = 0; k < 9; ++k) trial[k] = f9[k] + trial[k];
        const PlasticTrial<Real> at(trial, yield);
        Triple<V> f = at.s;
        const auto yields = ~(at.size <= kappa);
        if (any(yields)) {
            const Triple<V> k = at.returned(kappa / at.size);
            for (int l = 0; l < lanes; ++l)
                if (yields[l]) {
                    f.x[l] = exponential_of(Real(k.x[l]));
                    f.y[l] = exponential_of(Real(k.y[l]));
                    f.z[l] = exponential_of(Real(k.z[l]));
                }
        }
        const V J = f.x * f.y * f.z, bulk = lam * J * (J - Real(1.0));
        const Real shear = Real(2.0) * mu;
        const Triple<V> t = {
            shear * (f.x * (f.x - Real(1.0))) + bulk,
            shear * (f.y * (f.y - Real(1.0))) + bulk,
            shear * (f.z * (f.z - Real(1.0))) + bulk};
        V stretched[9], turned[9], out[9];
        stretch(at.U, f, stretched);
        transpose(at.W, turned);
        multiply(stretched, turned, out);
        write_all(FN, 9, group, out);
        stretch(at.U, t, stretched);
        transpose(at.U, turned);
        multiply(stretched, turned, out);
        const V weight = scale * v;
        for (int k = 0; k < 9; ++k) out[k] = out[k] * weight + c9[k] * m;
        write_all(AA, 9, group, out);
    }
}

// Divided differences: (e^a - e^b) / (a - b), and log(max(s, least)) over s.
template <typename Real> inline Real shrink(Real a, Real b) {
    const Real h = Real(0.5) * (a - b);
    Real ratio = Real(1.0) + h * h / Real(6.0) * (Real(1.0) + h * h / Real(20.0));
    if (wp::abs(h) > Real(0.1)) ratio = hyperbolic_sine_of(h) / h;
    return exponential_of(Real(0.5) * (a + b)) * ratio;
}
template <typename Real> inline Real log_slope(Real si, Real sj, Real ei, Real ej, Real least) {
    if (si > least && sj > least) return Real(1.0) / shrink(ei, ej);
    if (si <= least && sj <= least) return Real(0.0);
    return (ei - ej) / (si - sj);
}

// The singular values f after the return map, its shares c, and the divided differences of f over s.
template <typename Real> struct PlasticReturn {
    using V = Eight<Real>;
    Triple<V> f;
    V a01, a02, a12, c;
    decltype(V{} < V{}) yields;

    PlasticReturn(const PlasticTrial<Real>& at, Real kappa, Real least) {
        const V one = V{} + Real(1.0);
        f = at.s;
        a01 = one, a02 = one, a12 = one, c = one;
        yields = at.size > kappa;
        if (!any(yields)) return;
        const V shorter = kappa / at.size;
        const Triple<V> k = at.returned(shorter);
        c = yields ? shorter : c;
        for (int l = 0; l < lanes; ++l)
            if (yields[l]) {
                const Real kx = k.x[l], ky = k.y[l], kz = k.z[l], sx = at.s.x[l], sy = at.s.y[l], sz = at.s.z[l];
                const Real ex = at.strain.x[l], ey = at.strain.y[l], ez = at.strain.z[l];
                f.x[l] = exponential_of(kx);
                f.y[l] = exponential_of(ky);
                f.z[l] = exponential_of(kz);
                a01[l] = c[l] * shrink(kx, ky) * log_slope(sx, sy, ex, ey, least);
                a02[l] = c[l] * shrink(kx, kz) * log_slope(sx, sz, ex, ez, least);
                a12[l] = c[l] * shrink(ky, kz) * log_slope(sy, sz, ey, ez, least);
            }
    }
};

// The adjoint of a trial from that of F', and T, that of tau between its principal axes.
template <typename Real>
inline void turn_back_trial(
    const PlasticTrial<Real>& at, const Eight<Real>* adj_F_new, const Eight<Real>* T, Real mu, Real lam, Real kappa,
    Real least, Eight<Real>* adj_trial) {
    using V = Eight<Real>;
    const PlasticReturn<Real> after(at, kappa, least);
    const Triple<V>&f = after.f, &s = at.s, &d = at.d;
    const V J = f.x * f.y * f.z;
    V Ut[9], Wt[9], part[9], G[9];
    transpose(at.U, Ut);
    transpose(at.W, Wt);
    multiply(Ut, adj_F_new, part);
    multiply(part, at.W, G);
    const Real shear = Real(2.0) * mu;
    Triple<V> g = {G[0], G[4], G[8]};
    g = {
        g.x + shear * (T[0] * (f.x + f.x - Real(1.0))),
        g.y + shear * (T[4] * (f.y + f.y - Real(1.0))),
        g.z + shear * (T[8] * (f.z + f.z - Real(1.0)))};
    const V bulk = lam * (J + J - Real(1.0)) * (T[0] + T[4] + T[8]);
    g = {g.x + bulk * (f.y * f.z), g.y + bulk * (f.x * f.z), g.z + bulk * (f.x * f.y)};
    if (any(after.yields)) {
        const V c = after.c;
        const Triple<V> h = {g.x * f.x, g.y * f.y, g.z * f.z};
        const V all = mean(h), less = c * dot(d, h) / (at.size * at.size);
        const Triple<V> back = {
            all + c * (h.x - all) - less * d.x, all + c * (h.y - all) - less * d.y, all + c * (h.z - all) - less * d.z};
        auto steep = [&](V one) { return one > least ? Real(1.0) / one : V{}; };
        g = choose(after.yields, Triple<V>{back.x * steep(s.x), back.y * steep(s.y), back.z * steep(s.z)}, g);
    }
    V P[9] = {g.x, g.x, g.x, g.x, g.y, g.x, g.x, g.x, g.z};
    auto pair = [&](int i, int j, V a, V fi, V fj, V si, V sj) {
        const V total = larger(si + sj, Real(1e-12)), b = (fi + fj) / total;
        const V bend = shear * (fi + fj - Real(1.0)) * a * (T[3 * i + j] + T[3 * j + i]) / total;
        const V even = Real(0.5) * (a + b), odd = Real(0.5) * (a - b), Gij = G[3 * i + j], Gji = G[3 * j + i];
        P[3 * i + j] = even * Gij + odd * Gji + bend * sj;
        P[3 * j + i] = even * Gji + odd * Gij + bend * si;
    };
    pair(0, 1, after.a01, f.x, f.y, s.x, s.y);
    pair(0, 2, after.a02, f.x, f.z, s.x, s.z);
    pair(1, 2, after.a12, f.y, f.z, s.y, s.z);
    multiply(at.U, P, part);
    multiply(part, Wt, adj_trial);
}

template <typename Real, typename Law>
inline void plasticine_adjoint(
    int e, const Law& law, const Rows<Mat33<Real>>& F, const Rows<Mat33<Real>>& C,
    const Rows<Mat33<Real>>& adj_F_new, const Rows<Mat33<Real>>& adj_A, const Rows<Mat33<Real>>& adj_F,
    const Rows<Mat33<Real>>& adj_C, double least, double rounded, double round_off, double tiny, int sweeps) {
    const int first = law.first;
    const Real dt = law.dt, scale = law.scale, mu = law.mu, lam = law.lam, kappa = law.kappa;
    const Yield<Real> yield{Real(least), Real(rounded), Real(round_off), Real(tiny), sweeps};
    using V = Eight<Real>;
    const Real *M = row_of(law.mass, e, first), *VOLUME = row_of(law.volume, e, first);
    const Real *CC = row_of(C, e, first), *FF = row_of(F, e), *FA = row_of(adj_F_new, e), *AA = row_of(adj_A, e, first);
    Real *FO = row_of(adj_F, e), *CO = row_of(adj_C, e, first);
    for (int p = 0, count = F.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        V f9[9], c9[9], advance[9], trial[9], fa[9], aa[9];
        read_all(FF, 9, group, f9);
        read_all(CC, 9, group, c9);
        read_all(FA, 9, group, fa);
        read_all(AA, 9, group, aa);
        const V m = read(M, 1, group), v = read(VOLUME, 1, group);
        for (int k = 0; k < 9; ++k) advance[k] = (k % 4 ? Real(0.0) : Real(1.0)) + c9[k] * dt;
        multiply(advance, f9, trial);
        const PlasticTrial<Real> at(trial, yield);
        V Ut[9], part[9], T[9];
        transpose(at.U, Ut);
        multiply(Ut, aa, part);
        multiply(part, at.U, T);
        const V weight = scale * v;
        for (int k = 0; k < 9; ++k) T[k] = T[k] * weight;
        V adj_trial[9], out[9], other[9];
        turn_back_trial<Real>(at, fa, T, mu, lam, kappa, yield.least, adj_trial);
        transpose(advance, other);
        multiply(other, adj_trial, out);
        write_all(FO, 9, group, out);
        transpose(f9, other);
        for (int k = 0; k < 9; ++k) part[k] = adj_trial[k] * dt;
        multiply(part, other, out);
        for (int k = 0; k < 9; ++k) out[k] = aa[k] * m + out[k];
        write_all(CO, 9, group, out);
    }
}

}  // namespace gradscape
