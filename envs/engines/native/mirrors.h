// Walls that reflect: what is beyond such a wall is the image of what is before it.
//
// A wall lies on nodes or half-way between them, and particles before it also meet nodes beyond, one or two deep. `fold`
// adds what those hold to their images, and leaves nothing of a wall's own momentum into it. `unfold` gives nodes beyond
// a wall the image of what those before it hold. Each is the adjoint of the other. A lattice says where walls are that
// reflect, `below` and `above` along each axis, in halves of a cell from the whole grid's first node; 0 is none.
#pragma once
#include "layout.h"

namespace gradscape {

constexpr int farthest = 3;  // halves of a cell beyond a wall that particles before it meet

// Along one axis: the image of node i of the box and whether it is beyond a wall, or on it, or before it within reach.
struct Seen {
    int image;
    bool beyond, on, before;
};
template <typename Lattice> inline CUDA_CALLABLE Seen see(const Lattice& lattice, int axis, int i) {
    const int k = 2 * (i + lattice.first[axis]), low = lattice.below[axis], high = lattice.above[axis];
    const int from_low = low ? k - low : farthest + 1, from_high = high ? high - k : farthest + 1;  // before a wall
    const bool by_low = from_low * from_low <= farthest * farthest, by_high = from_high * from_high <= farthest * farthest;
    const int image = by_low ? i - from_low : by_high ? i + from_high : i;
    const bool beyond = (by_low && from_low < 0) || (by_high && from_high < 0);
    return {image, beyond, from_low == 0 || from_high == 0, image != i && !beyond};
}

// ---- a CPU: the rows of environments

// Call `at(axis, before, beyond)` of pairs of nodes that are images of each other, and of a wall's own with itself.
template <typename Lattice, typename At> inline void each_image(const Lattice& lattice, bool last_first, At at) {
    const int n[3] = {lattice.nx, lattice.ny, lattice.nz}, step[3] = {lattice.ny * lattice.nz, lattice.nz, 1};
    for (int a = 0; a < 3; ++a) {
        const int axis = last_first ? 2 - a : a, b = (axis + 1) % 3, c = (axis + 2) % 3;
        for (int side = 0; side < 2; ++side) {
            const int wall = (side ? lattice.above : lattice.below)[axis], inwards = side ? -1 : 1;
            for (int far = wall % 2; wall && far <= farthest; far += 2) {
                const int before = (wall + inwards * far) / 2 - lattice.first[axis];
                const int beyond = (wall - inwards * far) / 2 - lattice.first[axis];
                if (before < 0 || before >= n[axis] || beyond < 0 || beyond >= n[axis]) continue;  // where no particle is
                for (int i = 0; i < n[b]; ++i)
                    for (int j = 0; j < n[c]; ++j) {
                        const int along = i * step[b] + j * step[c];
                        at(axis, before * step[axis] + along, beyond * step[axis] + along);
                    }
            }
        }
    }
}
template <typename Lattice, typename Real>
inline void fold(int e, const Lattice& lattice, const Rows<Vec4<Real>>& grid) {
    Vec4<Real>* G = &wp::index(grid, e, 0);
    each_image(lattice, false, [&](int axis, int before, int beyond) {
        Vec4<Real> image = G[beyond];
        image[axis] = before == beyond ? Real(0.0) : -image[axis];
        G[before] = before == beyond ? image : G[before] + image;
        if (before != beyond) G[beyond] = Vec4<Real>();
    });
}
template <typename Lattice, typename Real>
inline void unfold(int e, const Lattice& lattice, const Rows<Vec4<Real>>& grid) {
    Vec4<Real>* G = &wp::index(grid, e, 0);
    each_image(lattice, true, [&](int axis, int before, int beyond) {
        Vec4<Real> image = G[before];
        image[axis] = before == beyond ? Real(0.0) : -image[axis];
        G[beyond] = image;
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
