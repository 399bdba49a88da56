// Walls that reflect: what is beyond such a wall is the image of what is before it.
//
// A wall has nodes of its own, and particles before it also meet the nodes next to it, beyond. `fold` adds what those
// hold to their images, the nodes next to the wall before it, and leaves nothing of a wall's own momentum into it.
// `unfold` gives nodes beyond a wall the image of what those before it hold. Each is the adjoint of the other. A lattice
// names the nodes `below` and `above` which there is a wall, along each axis, counted in the whole grid; 0 is none.
#pragma once
#include "layout.h"

namespace gradscape {

// Along one axis: the image of node i of the box and whether it is beyond a wall, or on it, or next to it before it.
struct Seen {
    int image;
    bool beyond, on, before;
};
template <typename Lattice> inline CUDA_CALLABLE Seen see(const Lattice& lattice, int axis, int i) {
    const int k = i + lattice.first[axis], low = lattice.below[axis], high = lattice.above[axis];
    const int from_low = low ? k - low : 2, from_high = high ? high - k : 2;  // how far before a wall
    const int image = from_low * from_low == 1 ? i - 2 * from_low : from_high * from_high == 1 ? i + 2 * from_high : i;
    const bool beyond = from_low == -1 || from_high == -1;
    return {image, beyond, from_low == 0 || from_high == 0, image != i && !beyond};
}

// ---- a CPU: the rows of environments

template <typename Lattice, typename At> inline void each_image(const Lattice& lattice, bool last_first, At at) {
    const int n[3] = {lattice.nx, lattice.ny, lattice.nz}, step[3] = {lattice.ny * lattice.nz, lattice.nz, 1};
    for (int a = 0; a < 3; ++a) {
        const int axis = last_first ? 2 - a : a, b = (axis + 1) % 3, c = (axis + 2) % 3;
        for (int side = 0; side < 2; ++side) {
            const int wall = (side ? lattice.above : lattice.below)[axis], on = wall - lattice.first[axis];
            if (wall == 0 || on < 0 || on >= n[axis]) continue;
            const int before = on > 0 && on < n[axis] - 1 ? (side ? -step[axis] : step[axis]) : 0;
            for (int i = 0; i < n[b]; ++i)
                for (int j = 0; j < n[c]; ++j) at(axis, on * step[axis] + i * step[b] + j * step[c], before);
        }
    }
}
template <typename Lattice, typename Real>
inline void fold(int e, const Lattice& lattice, const Rows<Vec4<Real>>& grid) {
    Vec4<Real>* G = &wp::index(grid, e, 0);
    each_image(lattice, false, [&](int axis, int on, int before) {
        G[on][axis] = Real(0.0);
        if (!before) return;  // then no particle meets nodes beyond
        Vec4<Real> image = G[on - before];
        image[axis] = -image[axis];
        G[on + before] = G[on + before] + image;
        G[on - before] = Vec4<Real>();
    });
}
template <typename Lattice, typename Real>
inline void unfold(int e, const Lattice& lattice, const Rows<Vec4<Real>>& grid) {
    Vec4<Real>* G = &wp::index(grid, e, 0);
    each_image(lattice, true, [&](int axis, int on, int before) {
        G[on][axis] = Real(0.0);
        if (!before) return;
        Vec4<Real> image = G[on + before];
        image[axis] = -image[axis];
        G[on - before] = image;
    });
}

// ---- a GPU: nodes one by one

// What `fold` makes of what `sum(node)` says of nodes.
template <typename Real, typename Lattice, typename Sum>
inline CUDA_CALLABLE Vec4<Real> folded(const Lattice& lattice, int node, Sum sum) {
    const int n[3] = {lattice.nx, lattice.ny, lattice.nz}, step[3] = {lattice.ny * lattice.nz, lattice.nz, 1};
    const int place[3] = {node / step[0], node / lattice.nz % lattice.ny, node % lattice.nz};
    int shift[3], images = 0, walls = 0;
    for (int a = 0; a < 3; ++a) {
        const Seen seen = see(lattice, a, place[a]);
        if (seen.beyond) return Vec4<Real>();
        shift[a] = (seen.image - place[a]) * step[a];
        if (seen.on) walls |= 1 << a;
        if (seen.before && seen.image >= 0 && seen.image < n[a]) images |= 1 << a;
    }
    Vec4<Real> total = sum(node);
    for (int mask = 1; mask < 8; ++mask) {
        if (mask & ~images) continue;
        int there = node;
        for (int a = 0; a < 3; ++a) there += mask >> a & 1 ? shift[a] : 0;
        const Vec4<Real> image = sum(there);
        for (int a = 0; a < 4; ++a) total[a] += a < 3 && mask >> a & 1 ? -image[a] : image[a];
    }
    for (int a = 0; a < 3; ++a) if (walls >> a & 1) total[a] = Real(0.0);
    return total;
}
// Give node `node`, which has place i in the grid, what `unfold` does, if it is on a wall or beyond one.
template <typename Real, typename Lattice>
inline CUDA_CALLABLE void unfold_node(
    const Lattice& lattice, const Rows<wp::int32>& starts, const Rows<Vec4<Real>>& grid, int e, int i, int node) {
    const int n[3] = {lattice.nx, lattice.ny, lattice.nz};
    const int place[3] = {node / (n[1] * n[2]), node / n[2] % n[1], node % n[2]};
    int there[3];
    bool changed = false, moved = false, beyond[3], on[3];
    for (int a = 0; a < 3; ++a) {
        const Seen seen = see(lattice, a, place[a]);
        beyond[a] = seen.beyond, on[a] = seen.on;
        there[a] = seen.beyond ? seen.image : place[a];
        if (there[a] < 0 || there[a] >= n[a]) return;  // then no particle meets this node
        moved = moved || seen.beyond, changed = changed || seen.beyond || seen.on;
    }
    if (!changed) return;
    const int from = moved ? wp::index(starts, e, there[0] * lattice.ny + there[1]) + there[2] : i;
    Vec4<Real> value = wp::index(grid, e, from);
    for (int a = 0; a < 3; ++a) value[a] = on[a] ? Real(0.0) : beyond[a] ? -value[a] : value[a];
    wp::index(grid, e, i) = value;
}

}  // namespace gradscape
