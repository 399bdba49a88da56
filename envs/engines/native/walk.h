// How a warp of a GPU walks along the cells of a segment, and adds up what its particles give to nodes.
//
// Nine lanes take the particles of a segment one after the other. Each holds the sums of three of the 27 nodes around
// the present cell, a row along z. Where the next cell begins, the lowest nine are written down, side by side, and
// the others become lower by one. A `span` is the lowest plane of nodes that a walk leaves, 256 times the one beyond
// the highest, and 65536 times the cell where it begins.
#pragma once
#include "layout.h"
#include "mirrors.h"

namespace gradscape {

// A lane's group, or segment, none from three on, and its row of nodes. Eight lanes read shared memory at once, and of
// one particle by this numbering.
inline CUDA_CALLABLE int group_of_lane(int lane) { return (lane < 24 ? lane / 8 : lane - 24); }
inline CUDA_CALLABLE int row_of_lane(int lane) { return (lane < 24 ? lane % 8 : 8); }

template <typename Real> using WalkState = wp::vec_t<13, Real>;  // sums of three nodes, and the plane of the lowest

template <typename Real>
inline CUDA_CALLABLE WalkState<Real> open_segment(
    [[maybe_unused]] const Rows<Vec4<Real>>& parts, [[maybe_unused]] int e, [[maybe_unused]] int at, int span) {
#if !defined(__CUDA_ARCH__)
    for (int i = 9 * (span & 255); i < 9 * (span >> 8 & 255); ++i) wp::index(parts, e, at + i) = Vec4<Real>();
#endif
    WalkState<Real> state;
    state[12] = Real(span >> 16);
    return state;
}

#if defined(__CUDA_ARCH__)
template <typename Real> struct alignas(2 * sizeof(Real)) Two { Real a, b; };
template <typename Real> struct alignas(16) Weights { Real low, middle, high; int cell; };

// What is staged of a particle in shared memory: what it gives to rows of nodes, and, where that has a slope along z
// and mass, these.
template <typename Real, bool sloping> struct Staged;
template <typename Real> struct Staged<Real, true> {
    using Row = Four<Real>;
    Row rows[9];
    Four<Real> slope;
    Weights<Real> weights;
};
template <typename Real> struct Staged<Real, false> {
    using Row = Two<Real>;
    Row rows[9];
    Weights<Real> weights;
};

// The sums of a lane: of the lowest node of its row, the middle and the highest one, and where the lowest is written.
template <typename Real> struct Sums {
    Four<Real> low, middle, high;
    int now;
    Four<Real> *out;

    CUDA_CALLABLE Sums(const WalkState<Real>& state, const Rows<Vec4<Real>>& parts, int e, int at, int row)
        : low{state[0], state[1], state[2], state[3]},
          middle{state[4], state[5], state[6], state[7]},
          high{state[8], state[9], state[10], state[11]},
          now((int)state[12]),
          out((Four<Real> *)&wp::index(parts, e, at + 9 * now) + row) {}

    CUDA_CALLABLE void emit(int span) {
        if (now >= (span & 255)) *out = low;
        out += 9, ++now;
        low = middle, middle = high, high = Four<Real>{};
    }

    CUDA_CALLABLE void add(const Four<Real>& b, const Weights<Real>& z, const Staged<Real, true>& given) {
        const Four<Real> a = given.slope;
        const Real w0 = b.d * z.low, w1 = b.d * z.middle, w2 = b.d * z.high;
        Real qa = b.a, qb = b.b, qc = b.c;
        low.a += w0 * qa, low.b += w0 * qb, low.c += w0 * qc, low.d += w0 * a.d;
        qa += a.a, qb += a.b, qc += a.c;
        middle.a += w1 * qa, middle.b += w1 * qb, middle.c += w1 * qc, middle.d += w1 * a.d;
        qa += a.a, qb += a.b, qc += a.c;
        high.a += w2 * qa, high.b += w2 * qb, high.c += w2 * qc, high.d += w2 * a.d;
    }

    CUDA_CALLABLE void add(const Two<Real>& b, const Weights<Real>& z, const Staged<Real, false>&) {
        low.a += z.low * b.a, low.b += z.low * b.b;
        middle.a += z.middle * b.a, middle.b += z.middle * b.b;
        high.a += z.high * b.a, high.b += z.high * b.b;
    }
};

template <typename Real, typename Given>
inline CUDA_CALLABLE void stage(Staged<Real, true>& to, const Given& p, const Real (&w)[3][3]) {
#pragma unroll
    for (int i = 0; i < 3; ++i)
#pragma unroll
        for (int j = 0; j < 3; ++j)
            to.rows[3 * i + j] = Four<Real>{
                p.q[0] + Real(i) * p.a.data[0][0] + Real(j) * p.a.data[0][1],
                p.q[1] + Real(i) * p.a.data[1][0] + Real(j) * p.a.data[1][1],
                p.q[2] + Real(i) * p.a.data[2][0] + Real(j) * p.a.data[2][1], w[0][i] * w[1][j]};
    to.slope = {p.a.data[0][2], p.a.data[1][2], p.a.data[2][2], p.mass};
    to.weights = {w[2][0], w[2][1], w[2][2], p.cell};
}

template <typename Real, typename Given>
inline CUDA_CALLABLE void stage(Staged<Real, false>& to, const Given& p, const Real (&w)[3][3]) {
#pragma unroll
    for (int i = 0; i < 3; ++i)
#pragma unroll
        for (int j = 0; j < 3; ++j)
            to.rows[3 * i + j] = Two<Real>{w[0][i] * w[1][j] * p.q[0], w[0][i] * w[1][j] * p.q[1]};
    to.weights = {w[2][0], w[2][1], w[2][2], p.cell};
}
#endif

// Add what the next `count` particles of each group give to their nodes, of which a lane knows that of its row: w (q +
// a i) and w mass, i counted from the base node. Of what is not `sloping` a, mass and the third of q are 0. No more
// than nine particles of a segment are in shared memory at once. `warps` are those of a block.
template <bool sloping, int warps, typename Real, typename Given>
inline CUDA_CALLABLE WalkState<Real> walk_segment(
    const Rows<Vec4<Real>>& parts, int e, int at, [[maybe_unused]] int span, [[maybe_unused]] int count,
    const Given& p, const WalkState<Real>& state) {
    Real w[3][3];
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
        const Real f = p.f[axis], half = Real(0.5), one = Real(1.0), more = Real(1.5);
        w[axis][0] = half * (f - more) * (f - more);
        w[axis][1] = Real(0.75) - (f - one) * (f - one);
        w[axis][2] = half * (f - half) * (f - half);
    }
#if defined(__CUDA_ARCH__)
    __shared__ Staged<Real, sloping> block[warps][3][9];
    const int lane = threadIdx.x & 31, group = group_of_lane(lane), row = row_of_lane(lane);
    Staged<Real, sloping> *staged = block[threadIdx.x >> 5][lane < 27 ? group : 0];
    __syncwarp();
    if (lane < 27) stage(staged[row], p, w);
    __syncwarp();
    Sums<Real> sums(state, parts, e, at, row);
    for (int t = 0; t < count; ++t) {
        const auto given = staged[t].rows[row];
        const Weights<Real> weights = staged[t].weights;
#pragma unroll 1
        while (sums.now < weights.cell) sums.emit(span);
        sums.add(given, weights, staged[t]);
    }
    WalkState<Real> left;
    left[0] = sums.low.a, left[1] = sums.low.b, left[2] = sums.low.c, left[3] = sums.low.d;
    left[4] = sums.middle.a, left[5] = sums.middle.b, left[6] = sums.middle.c, left[7] = sums.middle.d;
    left[8] = sums.high.a, left[9] = sums.high.b, left[10] = sums.high.c, left[11] = sums.high.d;
    left[12] = Real(sums.now);
    return left;
#else
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) {
                if (p.cell + k < (span & 255) || p.cell + k >= (span >> 8 & 255)) continue;
                const Real weight = w[0][i] * w[1][j] * w[2][k];
                Vec4<Real>& sum = wp::index(parts, e, at + 9 * (p.cell + k) + 3 * i + j);
                for (int d = 0; d < 3; ++d) {
                    const Real *a = p.a.data[d], move = Real(i) * a[0] + Real(j) * a[1] + Real(k) * a[2];
                    sum[d] += weight * (p.q[d] + move);
                }
                sum[3] += weight * p.mass;
            }
    return state;
#endif
}

template <typename Real>
inline CUDA_CALLABLE void close_segment(
    [[maybe_unused]] const Rows<Vec4<Real>>& parts, [[maybe_unused]] int e, [[maybe_unused]] int at,
    [[maybe_unused]] int span, [[maybe_unused]] const WalkState<Real>& state) {
#if defined(__CUDA_ARCH__)
    Sums<Real> sums(state, parts, e, at, row_of_lane(threadIdx.x & 31));
#pragma unroll 1
    while (sums.now < (span >> 8 & 255)) sums.emit(span);
#endif
}

// What the parts that walks leave come to at a node, in one order. A segment has `cells` cells and `numbers` parts.
template <int cells, int numbers, typename Real, typename Lattice>
inline CUDA_CALLABLE Vec4<Real> add_up_node(
    const Lattice& lattice, const Rows<wp::int32>& planes, const Rows<Vec4<Real>>& parts, int e, int node) {
    const int nz = lattice.nz, ny = lattice.ny, column = node / nz;
    const int x = column / ny, y = column % ny, z = lattice.first[2] + node % nz;
    const int bottom = lattice.first[2] / cells, depth = (lattice.first[2] + nz - 1) / cells - bottom + 1;
    const int segment = z / cells - bottom, plane = z % cells;
    const bool both = plane < 2 && segment > 0;
    const int *row = &wp::index(planes, e, 0);
    const Four<Real> *given = (const Four<Real> *)&wp::index(parts, e, 0);
    int lower[9], upper[9];
#pragma unroll
    for (int c = 0; c < 9; ++c) {
        const bool there = x >= c / 3 && y >= c % 3;
        const int here = ((x - c / 3) * ny + y - c % 3) * depth + segment;
        lower[c] = there && both ? row[here - 1] : 0;
        upper[c] = there ? row[here] : 0;
    }
    Four<Real> low{}, high{};
#pragma unroll
    for (int c = 0; c < 9; ++c) {
        const int here = ((x - c / 3) * ny + y - c % 3) * depth + segment, at = plane + cells;
        const Four<Real> none{};
        const Four<Real> a = lower[c] >> at & 1 ? given[(here - 1) * numbers + 9 * at + c] : none;
        const Four<Real> b = upper[c] >> plane & 1 ? given[here * numbers + 9 * plane + c] : none;
        low.a += a.a, low.b += a.b, low.c += a.c, low.d += a.d;
        high.a += b.a, high.b += b.b, high.c += b.c, high.d += b.d;
    }
    return Vec4<Real>(low.a + high.a, low.b + high.b, low.c + high.c, low.d + high.d);
}

// The same, after walls that reflect have folded it.
template <int cells, int numbers, typename Real, typename Lattice>
inline CUDA_CALLABLE Vec4<Real> add_up_folded(
    const Lattice& lattice, const Rows<wp::int32>& planes, const Rows<Vec4<Real>>& parts, int e, int node) {
    return folded<Real>(lattice, node, [&](int one) {
        return add_up_node<cells, numbers>(lattice, planes, parts, e, one);
    });
}

// Write what a node's parts come to, which has place i in the grid.
template <int cells, int numbers, typename Real, typename Lattice>
inline CUDA_CALLABLE void write_sum(
    const Lattice& lattice, const Rows<wp::int32>& planes, const Rows<Vec4<Real>>& parts, const Rows<Vec4<Real>>& grid,
    int e, int i, int node) {
    write_node(grid, e, i, add_up_folded<cells, numbers>(lattice, planes, parts, e, node));
}

// Write a node's value; its adjoint is what the node's parts come to.
template <int cells, int numbers, typename Real, typename Lattice>
inline CUDA_CALLABLE void write_with_parts(
    const Lattice&, const Rows<wp::int32>&, const Rows<Vec4<Real>>&, const Rows<Vec4<Real>>& grid, int e, int i, int,
    const Vec4<Real>& value) {
    write_node(grid, e, i, value);
}
template <int cells, int numbers, typename Real, typename Lattice>
inline CUDA_CALLABLE void adj_write_with_parts(
    const Lattice& lattice, const Rows<wp::int32>& planes, const Rows<Vec4<Real>>& parts, const Rows<Vec4<Real>>&,
    int e, int, int node, const Vec4<Real>&, const Lattice&, const Rows<wp::int32>&, const Rows<Vec4<Real>>&,
    const Rows<Vec4<Real>>&, int, int, int, Vec4<Real>& adj_value) {
    adj_value += add_up_folded<cells, numbers>(lattice, planes, parts, e, node);
}

}  // namespace gradscape
