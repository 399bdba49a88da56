// What particles gather from their nodes, and on which nodes they are.
#pragma once
#include "layout.h"

namespace gradscape {

// The node where a particle's stencil begins, s being counted in cells. A compiler that makes one operation of a
// product and a sum would round otherwise in one kernel than in another, and a particle close to the border of two
// cells would be listed in one and add to the nodes of the other.
inline CUDA_CALLABLE int lowest_node(float s) {
#if defined(__CUDA_ARCH__)
    return (int)floor(__fadd_rn(s, -0.5f));
#else
    return (int)floor(s - 0.5f);
#endif
}
inline CUDA_CALLABLE int lowest_node(double s) {
#if defined(__CUDA_ARCH__)
    return (int)floor(__dadd_rn(s, -0.5));
#else
    return (int)floor(s - 0.5);
#endif
}

// Sums over the nodes of a particle, which is at `f` from its corner, node (0, 0, 0): of w v, w i v, w j v, w k v, v
// being a node's first three numbers and w its weight, and of the slopes of w, times what the node is given of v: its
// product with q + a (i, j, k), and, `with_mass`, mass times its fourth number. Sums that are not wanted a compiler
// leaves out. Along z first, then y, then x.
template <bool with_mass, typename Real, typename Lattice>
inline CUDA_CALLABLE wp::mat_t<5, 3, Real> gather_sums(
    const Lattice& lattice, const Rows<wp::int32>& starts, const Rows<Vec4<Real>>& grid, int e,
    const wp::vec_t<3, wp::int32>& corner, const Vec3<Real>& f, const Vec3<Real>& q, const Mat33<Real>& a, Real mass) {
    struct Vec {
        Real x, y, z;
        CUDA_CALLABLE Vec operator+(const Vec &b) const { return Vec{x + b.x, y + b.y, z + b.z}; }
        CUDA_CALLABLE Vec operator*(Real s) const { return Vec{x * s, y * s, z * s}; }
        CUDA_CALLABLE Real dot(const Vec &b) const { return x * b.x + y * b.y + z * b.z; }
    };
    const Real half = Real(0.5), one = Real(1.0), more = Real(1.5), two = Real(2.0);
    Real w[3][3], d[3][3];
    for (int axis = 0; axis < 3; ++axis) {
        const Real low = f[axis] - more, middle = f[axis] - one, high = f[axis] - half;
        w[axis][0] = half * low * low, w[axis][1] = Real(0.75) - middle * middle, w[axis][2] = half * high * high;
        d[axis][0] = low, d[axis][1] = -two * middle, d[axis][2] = high;
    }
    const auto column = [&](int k) { return Vec{a.data[0][k], a.data[1][k], a.data[2][k]}; };
    const auto given = [&](const Vec& q, const Vec& v, const Four<Real>& n) {
        if constexpr (with_mass) return q.dot(v) + mass * n.d;
        else return q.dot(v);
    };
    const Vec ax = column(0), ay = column(1), az = column(2);
    const Four<Real> *nodes = (const Four<Real> *)&wp::index(grid, e, 0);
    const int *start = &wp::index(starts, e, corner[0] * lattice.ny + corner[1]), last = grid.shape[1] - 3;
    Vec s{}, si{}, sj{}, sk{}, slope{};
#pragma unroll
    for (int i = 0; i < 3; ++i, start += lattice.ny) {
        const Real wi = w[0][i];
        const Vec first{q[0], q[1], q[2]}, qi = i ? first + ax * Real(i) : first;
        Vec r{}, rj{}, rk{}, change{};
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            const int at = wp::min(wp::max(start[j] + corner[2], 0), last);  // of a particle that is nowhere, too
            const Four<Real> n0 = nodes[at], n1 = nodes[at + 1], n2 = nodes[at + 2];
            const Vec v0{n0.a, n0.b, n0.c}, v1{n1.a, n1.b, n1.c}, v2{n2.a, n2.b, n2.c};
            const Real wj = w[1][j];
            const Vec w1 = v1 * w[2][1], w2 = v2 * w[2][2], wv = v0 * w[2][0] + w1 + w2;
            const Vec q0 = j ? qi + ay * Real(j) : qi, q1 = q0 + az, q2 = q1 + az;
            r = r + wv * wj, rk = rk + (w1 + w2 * two) * wj;
            if (j) rj = rj + wv * (wj * Real(j));
            const Real t0 = given(q0, v0, n0), t1 = given(q1, v1, n1), t2 = given(q2, v2, n2);
            const Real t = w[2][0] * t0 + w[2][1] * t1 + w[2][2] * t2;
            const Real u = d[2][0] * t0 + d[2][1] * t1 + d[2][2] * t2;
            change = change + Vec{wj * t, d[1][j] * t, wj * u};
        }
        s = s + r * wi, sj = sj + rj * wi, sk = sk + rk * wi;
        if (i) si = si + r * (wi * Real(i));
        slope = slope + Vec{d[0][i] * change.x, wi * change.y, wi * change.z};
    }
    wp::mat_t<5, 3, Real> sums;
    const Vec rows[] = {s, si, sj, sk, slope};
    for (int row = 0; row < 5; ++row)
        sums.data[row][0] = rows[row].x, sums.data[row][1] = rows[row].y, sums.data[row][2] = rows[row].z;
    return sums;
}

}  // namespace gradscape
