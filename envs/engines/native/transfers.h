// The transfers of MLS-MPM for a CPU: `transfers` says what each does. A call has the row of one environment; sums come
// in the order of particles.
#pragma once
#include "eight.h"

namespace gradscape {

// The first number of a row.
template <typename T> inline T* row_of(const Rows<T>& values, int e, int first = 0) {
    return &wp::index(values, e, first);
}
template <unsigned rows, typename Real> inline Real* row_of(const Rows<wp::vec_t<rows, Real>>& values, int e, int first = 0) {
    return (Real*)&wp::index(values, e, first);
}
template <typename Real> inline Real* row_of(const Rows<Mat33<Real>>& values, int e, int first = 0) {
    return (Real*)&wp::index(values, e, first);
}
template <typename Real> inline Quad<Real>* nodes_of(const Rows<Vec4<Real>>& grid, int e) {
    return (Quad<Real>*)&wp::index(grid, e, 0);
}

// Each particle's weights, one node after another.
template <typename Real> struct NodeWeights {
    Eight<Real> w[27];
    explicit NodeWeights(const Stencils<Real>& at) {
        #pragma clang loop unroll(full)
        for (int n = 0; n < 27; ++n) w[n] = at.wx[n / 9] * at.wy[n / 3 % 3] * at.wz[n % 3];
    }
};

template <typename Real, typename Lattice>
inline void p2g(
    int e, const Lattice& lattice, const Rows<Real>& mass, const Rows<Vec3<Real>>& x, const Rows<Vec3<Real>>& v,
    const Rows<Mat33<Real>>& A, const Rows<Vec4<Real>>& grid_m) {
    const Real *M = row_of(mass, e), *X = row_of(x, e), *VV = row_of(v, e), *AA = row_of(A, e);
    const Real dx = Real(1.0) / lattice.inv_dx;
    Quad<Real>* G = nodes_of(grid_m, e);
    for (int p = 0, count = x.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        const Stencils<Real> at(lattice, X, group);
        const NodeWeights<Real> weights(at);
        for (int l = 0; l < group.some; ++l) {
            const int q = p + l, start = at.start(l);
            const Real fq[3] = {of_one(at.f[0], l), of_one(at.f[1], l), of_one(at.f[2], l)};
            const Real m = M[q];
            const Quad<Real> ax = read_column(AA + 9 * q) * dx, ay = read_column(AA + 9 * q + 1) * dx;
            const Quad<Real> az = read_column(AA + 9 * q + 2) * dx;
            Quad<Real> af = ax * fq[0];
            af += ay * fq[1];
            af += az * fq[2];
            Quad<Real> m0 = m * read3(VV + 3 * q) - af;
            m0[3] = m;
            #pragma clang loop unroll(full)
            for (int i = 0; i < 3; ++i)
                #pragma clang loop unroll(full)
                for (int j = 0; j < 3; ++j) {
                    const int row = start + (i * lattice.ny + j) * lattice.nz;
                    const Eight<Real>* w = weights.w + 9 * i + 3 * j;
                    const Quad<Real> mij = m0 + Real(i) * ax + Real(j) * ay;
                    G[row] += of_one(w[0], l) * mij;
                    G[row + 1] += of_one(w[1], l) * (mij + az);
                    G[row + 2] += of_one(w[2], l) * (mij + Real(2.0) * az);
                }
        }
    }
}

template <typename Real, typename Lattice>
inline void g2p(
    int e, const Lattice& lattice, Real dt, const Rows<Vec3<Real>>& x, const Rows<Vec4<Real>>& grid_v,
    const Rows<Vec3<Real>>& x_new, const Rows<Vec3<Real>>& v_new, const Rows<Mat33<Real>>& C_new,
    const wp::array_t<wp::int32>& left_box) {
    const Real* X = row_of(x, e);
    const Quad<Real>* G = nodes_of(grid_v, e);
    Real *XN = row_of(x_new, e), *VN = row_of(v_new, e), *CN = row_of(C_new, e);
    decltype(Eight<Real>{} < Eight<Real>{}) left = {};
    const Real c = Real(4.0) * lattice.inv_dx;
    for (int p = 0, count = x.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        const Stencils<Real> at(lattice, X, group);
        const NodeWeights<Real> weights(at);
        for (int l = 0; l < group.some; ++l) {
            const int q = p + l, start = at.start(l);
            const Real fq[3] = {of_one(at.f[0], l), of_one(at.f[1], l), of_one(at.f[2], l)};
            Quad<Real> s0 = {}, sx = s0, sy = s0, sz = s0;
            #pragma clang loop unroll(full)
            for (int i = 0; i < 3; ++i)
                #pragma clang loop unroll(full)
                for (int j = 0; j < 3; ++j) {
                    const int row = start + (i * lattice.ny + j) * lattice.nz;
                    const Eight<Real>* w = weights.w + 9 * i + 3 * j;
                    const Quad<Real> r1 = of_one(w[1], l) * G[row + 1], r2 = of_one(w[2], l) * G[row + 2];
                    const Quad<Real> r = of_one(w[0], l) * G[row] + r1 + r2;
                    s0 += r;
                    if (i) sx += Real(i) * r;
                    if (j) sy += Real(j) * r;
                    sz += r1 + Real(2.0) * r2;
                }
            write3(VN + 3 * q, s0);
            write3(XN + 3 * q, read3(X + 3 * q) + dt * s0);
            write_columns(CN + 9 * q, c * (sx - fq[0] * s0), c * (sy - fq[1] * s0), c * (sz - fq[2] * s0));
        }
        for (int a = 0; a < 3; ++a) left |= (at.f[a] < Real(0.49)) | (at.f[a] > Real(1.51));
    }
    if (__builtin_reduce_or(left)) wp::index(left_box, e) = 1;
}

template <typename Real, typename Lattice>
inline void adjoint_p2g(
    int e, const Lattice& lattice, const Rows<Real>& mass, const Rows<Vec3<Real>>& x, const Rows<Vec3<Real>>& v,
    const Rows<Mat33<Real>>& A, const Rows<Vec4<Real>>& adj_grid_m, const Rows<Vec3<Real>>& adj_x,
    const Rows<Vec3<Real>>& adj_v, const Rows<Mat33<Real>>& adj_A) {
    using V = Eight<Real>;
    const Real *M = row_of(mass, e), *X = row_of(x, e), *VV = row_of(v, e), *AA = row_of(A, e);
    const Real inv_dx = lattice.inv_dx, dx = Real(1.0) / lattice.inv_dx;
    const Quad<Real>* G = nodes_of(adj_grid_m, e);
    Real *XA = row_of(adj_x, e), *VA = row_of(adj_v, e), *AAA = row_of(adj_A, e);
    for (int p = 0, count = x.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        const Stencils<Real> at(lattice, X, group);
        const Slopes<Real> slopes(at.f);
        const V m = read(M, 1, group);
        V a9[9], v3[3], x_adjoints[3], ax[3], ay[3], az[3], m0[3];
        read_all(AA, 9, group, a9);
        read_all(VV, 3, group, v3);
        read_all(XA, 3, group, x_adjoints);
        for (int a = 0; a < 3; ++a) {
            ax[a] = a9[3 * a] * dx;
            ay[a] = a9[3 * a + 1] * dx;
            az[a] = a9[3 * a + 2] * dx;
            V af = ax[a] * at.f[0];
            af += ay[a] * at.f[1];
            af += az[a] * at.f[2];
            m0[a] = m * v3[a] - af;
        }
        V h0[3] = {}, hx[3] = {}, hy[3] = {}, hz[3] = {}, slope[3] = {};
        #pragma clang loop unroll(full)
        for (int i = 0; i < 3; ++i)
            #pragma clang loop unroll(full)
            for (int j = 0; j < 3; ++j) {
                const int row = (i * lattice.ny + j) * lattice.nz;
                const V wij = at.wx[i] * at.wy[j];
                const V along[3] = {slopes.x[i] * at.wy[j], at.wx[i] * slopes.y[j], wij};
                V mij[3], r[3] = {};
                for (int a = 0; a < 3; ++a) mij[a] = m0[a] + Real(i) * ax[a] + Real(j) * ay[a];
                #pragma clang loop unroll(full)
                for (int k = 0; k < 3; ++k) {
                    V h[4], t[3];
                    gather(G, at.corner, row + k, h);
                    const V w = wij * at.wz[k];
                    for (int a = 0; a < 3; ++a) {
                        t[a] = h[a] * (k ? mij[a] + Real(k) * az[a] : mij[a]);
                        const V wh = w * h[a];
                        r[a] += wh;
                        if (k) hz[a] += Real(k) * wh;
                    }
                    const V sigma = t[0] + t[1] + t[2] + h[3] * m;
                    for (int a = 0; a < 3; ++a) slope[a] += sigma * (along[a] * (a == 2 ? slopes.z[k] : at.wz[k]));
                }
                for (int a = 0; a < 3; ++a) {
                    h0[a] += r[a];
                    if (i) hx[a] += Real(i) * r[a];
                    if (j) hy[a] += Real(j) * r[a];
                }
            }
        for (int a = 0; a < 3; ++a) {
            write(VA + a, 3, group, m * h0[a]);
            write(AAA + 3 * a, 9, group, dx * (hx[a] - at.f[0] * h0[a]));
            write(AAA + 3 * a + 1, 9, group, dx * (hy[a] - at.f[1] * h0[a]));
            write(AAA + 3 * a + 2, 9, group, dx * (hz[a] - at.f[2] * h0[a]));
            V Ah = a9[a] * h0[0];
            Ah += a9[3 + a] * h0[1];
            Ah += a9[6 + a] * h0[2];
            write(XA + a, 3, group, x_adjoints[a] + inv_dx * slope[a] - Ah);
        }
    }
}

template <typename Real, typename Lattice>
inline void adjoint_g2p(
    int e, const Lattice& lattice, Real dt, const Rows<Vec3<Real>>& x, const Rows<Vec4<Real>>& grid_v,
    const Rows<Vec3<Real>>& adj_x_new, const Rows<Vec3<Real>>& adj_v_new, const Rows<Mat33<Real>>& adj_C_new,
    const Rows<Vec4<Real>>& adj_grid_v, const Rows<Vec3<Real>>& adj_x) {
    using V = Eight<Real>;
    const Real *X = row_of(x, e), *XN = row_of(adj_x_new, e), *VN = row_of(adj_v_new, e), *CN = row_of(adj_C_new, e);
    const Quad<Real>* G = nodes_of(grid_v, e);
    Quad<Real>* GA = nodes_of(adj_grid_v, e);
    Real* XA = row_of(adj_x, e);
    const Real inv_dx = lattice.inv_dx, c = Real(4.0) * inv_dx;
    for (int p = 0, count = x.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        const Stencils<Real> at(lattice, X, group);
        const Slopes<Real> slopes(at.f);
        V c9[9], xn[3], vn[3], cx[3], cy[3], cz[3], q0[3];
        read_all(CN, 9, group, c9);
        read_all(XN, 3, group, xn);
        read_all(VN, 3, group, vn);
        for (int a = 0; a < 9; ++a) c9[a] = c * c9[a];
        for (int a = 0; a < 3; ++a) {
            cx[a] = c9[3 * a];
            cy[a] = c9[3 * a + 1];
            cz[a] = c9[3 * a + 2];
            V cf = cx[a] * at.f[0];
            cf += cy[a] * at.f[1];
            cf += cz[a] * at.f[2];
            q0[a] = vn[a] + dt * xn[a] - cf;
        }
        V s0[3] = {}, slope[3] = {};
        V given[27][4];
        #pragma clang loop unroll(full)
        for (int i = 0; i < 3; ++i)
            #pragma clang loop unroll(full)
            for (int j = 0; j < 3; ++j) {
                const int row = (i * lattice.ny + j) * lattice.nz;
                const V wij = at.wx[i] * at.wy[j];
                const V along[3] = {slopes.x[i] * at.wy[j], at.wx[i] * slopes.y[j], wij};
                V qij[3];
                for (int a = 0; a < 3; ++a) qij[a] = q0[a] + Real(i) * cx[a] + Real(j) * cy[a];
                #pragma clang loop unroll(full)
                for (int k = 0; k < 3; ++k) {
                    V v[4], t[3], q[3];
                    const V w = wij * at.wz[k];
                    gather(G, at.corner, row + k, v);
                    for (int a = 0; a < 3; ++a) {
                        q[a] = k ? qij[a] + Real(k) * cz[a] : qij[a];
                        t[a] = q[a] * v[a];
                        s0[a] += w * v[a];
                    }
                    deal(w * q[0], w * q[1], w * q[2], given[9 * i + 3 * j + k]);
                    const V sigma = t[0] + t[1] + t[2];
                    for (int a = 0; a < 3; ++a) slope[a] += sigma * (along[a] * (a == 2 ? slopes.z[k] : at.wz[k]));
                }
            }
        for (int a = 0; a < 3; ++a) {
            V Cs = c9[a] * s0[0];
            Cs += c9[3 + a] * s0[1];
            Cs += c9[6 + a] * s0[2];
            write(XA + a, 3, group, xn[a] + inv_dx * (slope[a] - Cs));
        }
        for (int l = 0; l < group.some; ++l)
            #pragma clang loop unroll(full)
            for (int i = 0; i < 3; ++i)
                #pragma clang loop unroll(full)
                for (int j = 0; j < 3; ++j) {
                    const int row = at.start(l) + (i * lattice.ny + j) * lattice.nz;
                    for (int k = 0; k < 3; ++k) GA[row + k] += dealt(given[9 * i + 3 * j + k], l);
                }
    }
}

}  // namespace gradscape
