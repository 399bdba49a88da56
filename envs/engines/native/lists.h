// Which particles lie in which cells, and which nodes they touch: what the kernels of `cells` and `nodes` do in C++.
#pragma once
#include "layout.h"

namespace gradscape {

template <int count> using Ints = wp::vec_t<count, wp::int32>;
using IntRows = Rows<wp::int32>;

// Neighbours in memory are mostly of one cell: on a GPU one of them counts for all of a warp.
inline CUDA_CALLABLE int take_number(const IntRows& counts, int e, int cell) {
#if defined(__CUDA_ARCH__)
    const unsigned place = (unsigned)((unsigned long long)&wp::index(counts, e, cell) >> 2);
    const unsigned alike = __match_any_sync(__activemask(), place);
    const int lane = threadIdx.x & 31, leader = __ffs(alike) - 1;
    int number = 0;
    if (lane == leader) number = atomicAdd(&wp::index(counts, e, cell), __popc(alike));
    return __shfl_sync(alike, number, leader) + __popc(alike & ((1u << lane) - 1u));
#else
    return wp::index(counts, e, cell)++;
#endif
}

// The numbers of a segment of `cells` cells are read and written by fours.
template <int cells> inline CUDA_CALLABLE Ints<cells> take_counts(const IntRows& counts, int e, int segment) {
    struct alignas(16) Four { int n[4]; };
    Four *four = (Four *)&wp::index(counts, e, segment * cells);
    Ints<cells> found;
    int any = 0;
    for (int k = 0; k < cells; k += 4) {
        const Four given = four[k / 4];
        for (int l = 0; l < 4; ++l) any |= found[k + l] = given.n[l];
    }
    for (int k = 0; any && k < cells / 4; ++k) four[k] = Four{};
    return found;
}

template <int cells>
inline CUDA_CALLABLE void write_places(
    const Rows<Ints<2>>& places, int e, int segment, int at, const Ints<cells>& counted) {
    struct alignas(16) Two { int low, high, next_low, next_high; };
    Two *two = (Two *)&wp::index(places, e, segment * cells);
    for (int k = 0; k < cells; k += 2) {
        const int middle = at + counted[k], end = middle + counted[k + 1];
        two[k / 2] = Two{at, middle, middle, end};
        at = end;
    }
}

// How many of those that arrived at a cell's places lie before particle p in memory.
inline CUDA_CALLABLE int count_before(const IntRows& arrived, int e, const Ints<2>& places, int p) {
    const int *row = &wp::index(arrived, e, 0);
    int before = 0;
    for (int i = places[0]; i < places[1]; ++i) before += row[i] < p;
    return before;
}

// The next `count` places of an environment, and the next `parts` of another kind: a warp's lanes take theirs together.
inline CUDA_CALLABLE Ints<2> take_places(const IntRows& used, int e, int count, int parts) {
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    if (!__ballot_sync(all, count > 0)) return Ints<2>(0, 0);
    const int lane = threadIdx.x & 31;
    int before = count, more = parts;
    for (int step = 1; step < 32; step *= 2) {
        const int other = __shfl_up_sync(all, before, step), others = __shfl_up_sync(all, more, step);
        if (lane >= step) before += other, more += others;
    }
    int place = 0, part = 0;
    if (lane == 31) {
        place = atomicAdd(&wp::index(used, e, 0), before);
        part = atomicAdd(&wp::index(used, e, 1), more);
    }
    place = __shfl_sync(all, place, 31) + before - count;
    part = __shfl_sync(all, part, 31) + more - parts;
#else
    const int place = wp::index(used, e, 0), part = wp::index(used, e, 1);
    wp::index(used, e, 0) += count;
    wp::index(used, e, 1) += parts;
#endif
    return Ints<2>(place, part);
}

// From which node of a column to which one, along z, particles of its nine columns of cells touch.
template <int highest, typename Lattice>
inline CUDA_CALLABLE Ints<2> find_touched(const Lattice& lattice, const IntRows& spans, int e, int column) {
    struct alignas(8) Two { int above, high; };
    const Two *span = (const Two *)&wp::index(spans, e, 0);
    const int x = column / lattice.ny, y = column % lattice.ny;
    int above = 0, high = 0;
    for (int c = 0; c < 9; ++c) {
        if (x >= lattice.nx || x < c / 3 || y < c % 3) continue;
        const Two found = span[(x - c / 3) * lattice.ny + y - c % 3];
        above = wp::max(above, found.above);
        high = wp::max(high, found.high);
    }
    return high ? Ints<2>(highest - above, high) : Ints<2>(0, 0);
}

// Lanes of a warp have neighbouring columns, whose nodes have places one after the other. They write all of these
// together, a place each, and find out to whose column it belongs.
inline CUDA_CALLABLE void name_nodes(
    const IntRows& nodes, int e, int column, int depth, int low, int count, int start) {
    const int room = nodes.shape[1], first = column * depth + low;
    int *row = &wp::index(nodes, e, 0);
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31, begin = __shfl_sync(all, start, 0), end = __shfl_sync(all, start + count, 31);
    for (int from = begin; from < end; from += 32) {
        const int place = from + lane;
        int owner = 0;
        for (int step = 16; step > 0; step /= 2)
            if (__shfl_sync(all, start, owner + step) <= place) owner += step;
        const int node = __shfl_sync(all, first - start, owner) + place;
        if (place < wp::min(end, room)) row[place] = node;
    }
#else
    for (int place = start; place < wp::min(start + count, room); ++place) row[place] = first + place - start;
#endif
}

// The least and the greatest of what a warp's lanes have, axis by axis.
template <typename Real> inline CUDA_CALLABLE Vec3<Real> least_of_warp(Vec3<Real> x) {
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step /= 2)
        for (int axis = 0; axis < 3; ++axis) x[axis] = min(x[axis], __shfl_xor_sync(0xffffffffu, x[axis], step));
#endif
    return x;
}
template <typename Real> inline CUDA_CALLABLE Vec3<Real> greatest_of_warp(Vec3<Real> x) {
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step /= 2)
        for (int axis = 0; axis < 3; ++axis) x[axis] = max(x[axis], __shfl_xor_sync(0xffffffffu, x[axis], step));
#endif
    return x;
}

// The greatest count of a warp's lanes.
inline CUDA_CALLABLE int greatest_count(int count) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
    return __reduce_max_sync(0xffffffffu, count);
#elif defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step /= 2) count = max(count, __shfl_xor_sync(0xffffffffu, count, step));
    return count;
#else
    return count;
#endif
}

}  // namespace gradscape
