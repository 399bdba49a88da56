// The smoothing of a fluid's volume ratios for a CPU: `smoothing` has the formulas. Three nodes of a row at a time: what
// lies behind the third is read and written as it was.
#pragma once
#include "transfers.h"

namespace gradscape {

template <typename Real> inline Quad<Real> inverse_or_zero(Quad<Real> w) {
    return w > Real(0.0) ? Real(1.0) / w : Quad<Real>{};
}
template <typename Real> inline Quad<Real> at_row(const Real* a, int row) { return *(const Quad<Real>*)(a + row); }
template <typename Real> inline void add_row(Real* a, int row, Quad<Real> v) {
    Quad<Real> sum = *(Quad<Real>*)(a + row) + v;
    sum[3] = a[row + 3];
    *(Quad<Real>*)(a + row) = sum;
}

// The weights of a particle's rows of nodes, and of their slopes.
template <typename Real> struct RowWeights {
    Eight<Real> wz[4], wij[9];
    explicit RowWeights(const Stencils<Real>& at) {
        deal(at.wz[0], at.wz[1], at.wz[2], wz);
        #pragma clang loop unroll(full)
        for (int n = 0; n < 9; ++n) wij[n] = at.wx[n / 3] * at.wy[n % 3];
    }
    Quad<Real> of(int i, int j, int l) const { return of_one(wij[3 * i + j], l) * dealt(wz, l); }
};
template <typename Real> struct RowSlopes {
    Eight<Real> x[3][4], y[3][4], z[3][4];
    explicit RowSlopes(const Stencils<Real>& at) {
        const Slopes<Real> slopes(at.f);
        #pragma clang loop unroll(full)
        for (int i = 0; i < 3; ++i) {
            deal(slopes.x[i], at.wx[i], at.wx[i], x[i]);
            deal(at.wy[i], slopes.y[i], at.wy[i], y[i]);
            deal(at.wz[i], at.wz[i], slopes.z[i], z[i]);
        }
    }
};

template <typename Real, typename Lattice, typename Fluid>
inline void smoothing_spread(
    int e, const Lattice& lattice, const Fluid& fluid, const Rows<Real>& amount, const Rows<Real>& weight) {
    const Real *X = row_of(fluid.x, e, fluid.first), *JJ = row_of(fluid.J, e);
    const Real *VOLUME = row_of(fluid.volume, e, fluid.first), slope = fluid.slope;
    Real *AMOUNT = row_of(amount, e), *WEIGHT = row_of(weight, e);
    for (int p = 0, count = fluid.J.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        const Stencils<Real> at(lattice, X, group);
        const RowWeights<Real> weights(at);
        const Eight<Real> beyond = logarithm(read(JJ, 1, group)) - slope * at.x[1];
        for (int l = 0; l < group.some; ++l) {
            const Real volume = VOLUME[p + l], excess = of_one(beyond, l);
            #pragma clang loop unroll(full)
            for (int i = 0; i < 3; ++i)
                #pragma clang loop unroll(full)
                for (int j = 0; j < 3; ++j) {
                    const int row = at.start(l) + (i * lattice.ny + j) * lattice.nz;
                    const Quad<Real> w = weights.of(i, j, l);
                    add_row<Real>(AMOUNT, row, w * volume * excess);
                    add_row<Real>(WEIGHT, row, w * volume);
                }
        }
    }
}

template <typename Real, typename Lattice, typename Fluid>
inline void smoothing_collect(
    int e, const Lattice& lattice, const Fluid& fluid, const Rows<Real>& amount, const Rows<Real>& weight) {
    const Real *X = row_of(fluid.x, e, fluid.first), *JJ = row_of(fluid.J, e);
    const Real *AMOUNT = row_of(amount, e), *WEIGHT = row_of(weight, e), slope = fluid.slope, share = fluid.share;
    Real* JN = row_of(fluid.J_new, e);
    for (int p = 0, count = fluid.J.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        const Stencils<Real> at(lattice, X, group);
        const RowWeights<Real> weights(at);
        Eight<Real> mean = {};
        for (int l = 0; l < group.some; ++l) {
            Real sum = Real(0.0);
            #pragma clang loop unroll(full)
            for (int i = 0; i < 3; ++i)
                #pragma clang loop unroll(full)
                for (int j = 0; j < 3; ++j) {
                    const int row = at.start(l) + (i * lattice.ny + j) * lattice.nz;
                    const Quad<Real> w = weights.of(i, j, l);
                    const Quad<Real> part = w * at_row(AMOUNT, row) * inverse_or_zero<Real>(at_row(WEIGHT, row));
                    for (int k = 0; k < 3; ++k) sum += part[k];
                }
            ((Real*)&mean)[l] = sum;
        }
        const Eight<Real> here = logarithm(read(JJ, 1, group));
        write<Real>(JN, 1, group, exponential(here + share * (mean - (here - slope * at.x[1]))));
    }
}

template <typename Real, typename Lattice, typename Fluid>
inline void smoothing_adjoint_collect(
    int e, const Lattice& lattice, const Fluid& fluid, const Rows<Real>& amount, const Rows<Real>& weight,
    const Rows<Real>& adj_mean, const Rows<Real>& adj_J, const Rows<Vec3<Real>>& adj_x) {
    const Real *X = row_of(fluid.x, e, fluid.first), *JN = row_of(fluid.J_new, e);
    const Real *AMOUNT = row_of(amount, e), *WEIGHT = row_of(weight, e), share = fluid.share;
    Real *MEAN = row_of(adj_mean, e), *JA = row_of(adj_J, e), *XA = row_of(adj_x, e, fluid.first);
    for (int p = 0, count = fluid.J_new.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        const Stencils<Real> at(lattice, X, group);
        const RowWeights<Real> weights(at);
        const RowSlopes<Real> slopes(at);
        for (int l = 0; l < group.some; ++l) {
            const int q = p + l;
            const Real g = JA[q] * JN[q];
            Quad<Real> steep = {};
            #pragma clang loop unroll(full)
            for (int i = 0; i < 3; ++i)
                #pragma clang loop unroll(full)
                for (int j = 0; j < 3; ++j) {
                    const int row = at.start(l) + (i * lattice.ny + j) * lattice.nz;
                    const Quad<Real> w = weights.of(i, j, l), along = dealt(slopes.x[i], l) * dealt(slopes.y[j], l);
                    const Quad<Real> mean = at_row(AMOUNT, row) * inverse_or_zero<Real>(at_row(WEIGHT, row));
                    for (int k = 0; k < 3; ++k) steep += mean[k] * (along * dealt(slopes.z[k], l));
                    add_row<Real>(MEAN, row, w * share * g);
                }
            write3<Real>(XA + 3 * q, read3(XA + 3 * q) + (share * g * lattice.inv_dx) * steep);
            JA[q] = g;
        }
    }
}

template <typename Real, typename Lattice, typename Fluid>
inline void smoothing_adjoint_spread(
    int e, const Lattice& lattice, const Fluid& fluid, const Rows<Real>& amount, const Rows<Real>& weight,
    const Rows<Real>& adj_mean, const Rows<Real>& adj_J, const Rows<Vec3<Real>>& adj_x) {
    const Real *X = row_of(fluid.x, e, fluid.first), *JJ = row_of(fluid.J, e);
    const Real *VOLUME = row_of(fluid.volume, e, fluid.first), slope = fluid.slope, share = fluid.share;
    const Real *AMOUNT = row_of(amount, e), *WEIGHT = row_of(weight, e), *MEAN = row_of(adj_mean, e);
    Real *JA = row_of(adj_J, e), *XA = row_of(adj_x, e, fluid.first);
    for (int p = 0, count = fluid.J.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        const Stencils<Real> at(lattice, X, group);
        const RowWeights<Real> weights(at);
        const RowSlopes<Real> slopes(at);
        const Eight<Real> beyond = logarithm(read(JJ, 1, group)) - slope * at.x[1];
        for (int l = 0; l < group.some; ++l) {
            const int q = p + l;
            const Real excess = of_one(beyond, l), volume = VOLUME[q];
            Real here = Real(0.0);
            Quad<Real> steep = {};
            #pragma clang loop unroll(full)
            for (int i = 0; i < 3; ++i)
                #pragma clang loop unroll(full)
                for (int j = 0; j < 3; ++j) {
                    const int row = at.start(l) + (i * lattice.ny + j) * lattice.nz;
                    const Quad<Real> w = weights.of(i, j, l), along = dealt(slopes.x[i], l) * dealt(slopes.y[j], l);
                    const Quad<Real> part = inverse_or_zero<Real>(at_row(WEIGHT, row)), a = at_row(MEAN, row) * part;
                    const Quad<Real> off = a * (excess - at_row(AMOUNT, row) * part), wa = w * a;
                    for (int k = 0; k < 3; ++k) {
                        here += wa[k];
                        steep += off[k] * (along * dealt(slopes.z[k], l));
                    }
                }
            const Real g = JA[q];
            here = volume * here - share * g;
            const Quad<Real> lift = {Real(0.0), slope * here, Real(0.0), Real(0.0)};
            write3<Real>(XA + 3 * q, read3(XA + 3 * q) + (volume * lattice.inv_dx) * steep - lift);
            JA[q] = (g + here) / JJ[q];
        }
    }
}

}  // namespace gradscape
