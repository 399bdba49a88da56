// The grid's velocities for a CPU: an environment's nodes one after another, four numbers at a time.
//
// What walls do is a few comparisons. The nodes that a tool may reach are listed, and left to the boundary's Warp
// function and the adjoint that Warp makes of it. Three numbers of a node are its momentum or velocity, the fourth its
// mass or nothing. Expressions are those of `grid`, of the boundaries' functions, and of what Warp's adjoints of them
// compute, in their order; its sums begin with 0, and make 0 of -0.
#pragma once
#include "eight.h"

namespace gradscape {

template <typename Real, typename Lattice>
inline Quad<Real> node_position(const Lattice& lattice, int i, int j, int k) {
    const Real h = Real(1.0) / lattice.inv_dx;
    const auto& o = lattice.origin;
    const auto& first = lattice.first;
    const Quad<Real> node = {Real(i + first[0]), Real(j + first[1]), Real(k + first[2]), Real(0.0)};
    return Quad<Real>{o[0], o[1], o[2], Real(0.0)} + node * h;
}
template <typename Real> inline Quad<Real> velocity_after_gravity(Quad<Real> g, Real dt, Real gravity) {
    return g / g[3] - Quad<Real>{Real(0.0), dt * gravity, Real(0.0), Real(0.0)};
}
template <typename Real> inline Quad<Real> adj_velocity_after_gravity(Quad<Real> g, Quad<Real> a) {
    Quad<Real> back = Real(0.0) + a / g[3];
    back[3] = Real(0.0) - (g[0] * a[0] + g[1] * a[1] + g[2] * a[2]) / (g[3] * g[3]);
    return back;
}

// Walls of a kind of boundary, and the reach of its tools. `find_reach(p, from, to)` says between which z a tool may
// reach nodes that lie in line with p along z: further apart from them, the boundary's own function would change
// nothing, and no adjoint of theirs be anything but 0. `along(p, v)` is what floor and walls leave of a velocity along
// them, linear and its own adjoint; `below(p)` and `above(p)` say along which axes a node is at a wall that lets
// velocities only rise, only fall.
template <typename Real> struct Reach {
    static constexpr Real far = Real(__builtin_inf());
    static constexpr Real rounded = Real(1.001);  // rounding moves a node by less than a thousandth of a tool's reach

    static Quad<Real> find_place(
        const wp::array_t<Vec3<Real>>& tools, int e, int step, Real fraction, int slot) {
        const auto &a = wp::index(tools, e, step, slot), &b = wp::index(tools, e, step + 1, slot);
        return Quad<Real>{a[0], a[1], a[2], Real(0.0)}
            + fraction * Quad<Real>{b[0] - a[0], b[1] - a[1], b[2] - a[2], Real(0.0)};
    }
    static void widen(Real z, Real reach, Real& from, Real& to) {
        from = wp::min(from, z - reach);
        to = wp::max(to, z + reach);
    }
    static void widen_by_ball(Real x, Real y, Real z, Real radius, Real& from, Real& to) {
        const Real left = radius * radius - x * x - y * y;
        if (left > Real(0.0)) widen(z, rounded * wp::sqrt(left), from, to);
    }
};

template <typename Real, typename Data> struct OpenWalls : Reach<Real> {
    OpenWalls(const Data&, const wp::array_t<Vec3<Real>>&, int, int, Real) {}
    void find_reach(Quad<Real>, Real&, Real&) const {}
    Quad<Real> along(Quad<Real>, Quad<Real> v) const { return v; }
    auto below(Quad<Real> p) const { return p != p; }
    auto above(Quad<Real> p) const { return p != p; }
};

template <typename Real, typename Data> struct TankWalls : Reach<Real> {
    using Reach<Real>::far;
    const Data& data;
    Real near_bowl, near_rod, edge, slip;
    Quad<Real> ladle, lower, upper;

    TankWalls(const Data& data, const wp::array_t<Vec3<Real>>& tools, int e, int step, Real fraction) : data(data) {
        const Real shell = data.half_thickness + data.band;
        near_bowl = this->rounded * (data.radius + shell);
        near_rod = this->rounded * shell;
        edge = data.half_width - Real(1e-6);
        slip = data.slip;
        ladle = this->find_place(tools, e, step, fraction, 0);
        lower = {-edge, Real(1e-6), -edge, -far};
        upper = {edge, data.lid, edge, far};
    }
    void find_reach(Quad<Real> p, Real& from, Real& to) const {
        const Real x = p[0] - ladle[0], y = p[1] - ladle[1];
        if (y < near_rod) this->widen_by_ball(x, y, ladle[2], near_bowl, from, to);
        if (data.height > Real(0.0) && wp::abs(x + data.radius) < near_rod) this->widen(ladle[2], near_rod, from, to);
    }
    auto below(Quad<Real> p) const { return p < lower; }
    auto above(Quad<Real> p) const { return p > upper; }
    Quad<Real> along(Quad<Real> p, Quad<Real> v) const {
        const auto at = (p < lower) | (p > Quad<Real>{edge, far, edge, far});
        return at[0] | at[1] | at[2] ? (at ? v : v * slip) : v;
    }
};

// Walls of a room whose floor holds what lies on it where its friction is `sticky` or more.
template <int sticky> struct Room {
    template <typename Real, typename Data> struct Walls : Reach<Real> {
        using Reach<Real>::far;
        const Data& data;
        const wp::array_t<Vec3<Real>>& tools;
        int e, step;
        Real fraction;
        bool sticks;
        Quad<Real> lower, upper;

        Walls(const Data& data, const wp::array_t<Vec3<Real>>& tools, int e, int step, Real fraction)
            : data(data), tools(tools), e(e), step(step), fraction(fraction), sticks(data.floor_friction >= Real(sticky)) {
            lower = {data.lower[0], sticks ? data.floor : -far, data.lower[2], -far};
            upper = {data.upper[0], data.upper[1], data.upper[2], far};
        }
        void find_reach(Quad<Real> p, Real& from, Real& to) const {
            for (int t = 0; t < data.reach.shape[0]; ++t) {
                const Real reach = this->rounded * wp::index(data.reach, t);
                const Quad<Real> gap = p - this->find_place(tools, e, step, fraction, wp::index(data.slot, t));
                this->widen_by_ball(gap[0], gap[1], p[2] - gap[2], reach, from, to);
            }
            if (p[1] <= data.floor && !sticks) this->widen(Real(0.0), far, from, to);
        }
        auto below(Quad<Real> p) const { return p <= lower; }
        auto above(Quad<Real> p) const { return p >= upper; }
        Quad<Real> along(Quad<Real> p, Quad<Real> v) const {
            return p[1] <= data.floor ? Quad<Real>{Real(0.0), v[1], Real(0.0), Real(0.0)} : v;
        }
    };
};

// The velocity of one node before the boundary, and where the node is.
template <typename Real, typename Lattice> inline Vec3<Real> place_of_node(const Lattice& lattice, int i) {
    const Quad<Real> p = node_position<Real>(
        lattice, i / (lattice.nz * lattice.ny), i / lattice.nz % lattice.ny, i % lattice.nz);
    return Vec3<Real>(p[0], p[1], p[2]);
}
template <typename Real, typename Substep>
inline Vec3<Real> free_velocity(const Substep& now, const Rows<Vec4<Real>>& grid_m, int e, int i) {
    const Quad<Real>* G = (const Quad<Real>*)&wp::index(grid_m, e, 0);
    const Quad<Real> v = velocity_after_gravity<Real>(G[i], now.dt, now.gravity);
    return Vec3<Real>(v[0], v[1], v[2]);
}
template <typename Real, typename Substep>
inline void adj_free_velocity(
    const Substep&, const Rows<Vec4<Real>>& grid_m, int e, int i, const Substep&, const Rows<Vec4<Real>>& adj_grid_m,
    int, int, const Vec3<Real>& adj_ret) {
    const Quad<Real>* G = (const Quad<Real>*)&wp::index(grid_m, e, 0);
    *(Quad<Real>*)&wp::index(adj_grid_m, e, i) =
        adj_velocity_after_gravity<Real>(G[i], Quad<Real>{adj_ret[0], adj_ret[1], adj_ret[2], Real(0.0)});
}

// List the numbers of nodes that carry a velocity and are within reach of a tool, in their order, after how many.
template <template <typename, typename> class Walls, typename Real, typename Lattice, typename Data, typename Substep>
inline void list_near(
    int e, const Lattice& lattice, const Data& data, const Substep& now, const wp::array_t<Vec3<Real>>& tools,
    const Rows<Vec4<Real>>& grid_m, const Rows<wp::int32>& near) {
    const Walls<Real, Data> walls(data, tools, e, now.step, now.fraction);
    const Real empty = now.empty;
    const Real* MASS = (const Real*)&wp::index(grid_m, e, 0) + 3;
    int *NEAR = &wp::index(near, e, 0), count = 0;
    for (int i = 0; i < lattice.nx; ++i)
        for (int j = 0; j < lattice.ny; ++j) {
            Real from = Reach<Real>::far, to = -from;
            walls.find_reach(node_position<Real>(lattice, i, j, 0), from, to);
            const int row = (i * lattice.ny + j) * lattice.nz;
            for (int k = 0; from < to && k < lattice.nz; ++k) {
                const Real z = node_position<Real>(lattice, i, j, k)[2];
                if (z > from && z < to && MASS[4 * (row + k)] > empty) NEAR[++count] = row + k;
            }
        }
    NEAR[0] = count;
}

// Call `at(n, i, j, k)` of each node that is not listed.
template <typename Lattice, typename At>
inline void each_other_node(const Lattice& lattice, const Rows<wp::int32>& near, int e, At at) {
    const int *NEAR = &wp::index(near, e, 1), *end = NEAR + NEAR[-1];
    for (int i = 0, n = 0; i < lattice.nx; ++i)
        for (int j = 0; j < lattice.ny; ++j)
            for (int k = 0; k < lattice.nz; ++k, ++n) {
                if (NEAR < end && *NEAR == n) {
                    ++NEAR;
                    continue;
                }
                at(n, i, j, k);
            }
}

// Set the velocities of nodes that are not listed, and the adjoints of their momenta.
template <template <typename, typename> class Walls, typename Real, typename Lattice, typename Data, typename Substep>
inline void velocity_of_others(
    int e, const Lattice& lattice, const Data& data, const Substep& now, const wp::array_t<Vec3<Real>>& tools,
    const Rows<Vec4<Real>>& grid_m, const Rows<wp::int32>& near, const Rows<Vec4<Real>>& grid_v) {
    const Walls<Real, Data> walls(data, tools, e, now.step, now.fraction);
    const Real dt = now.dt, gravity = now.gravity, empty = now.empty;
    const Quad<Real> zero = {}, *G = (const Quad<Real>*)&wp::index(grid_m, e, 0);
    Quad<Real>* V = (Quad<Real>*)&wp::index(grid_v, e, 0);
    each_other_node(lattice, near, e, [&](int n, int i, int j, int k) {
        Quad<Real> v = zero;
        if (G[n][3] > empty) {
            const Quad<Real> p = node_position<Real>(lattice, i, j, k);
            v = walls.along(p, velocity_after_gravity<Real>(G[n], dt, gravity));
            v = walls.below(p) & ~(v >= Real(0.0)) ? zero : v;
            v = walls.above(p) & ~(v <= Real(0.0)) ? zero : v;
            v[3] = Real(0.0);
        }
        V[n] = v;
    });
}
template <template <typename, typename> class Walls, typename Real, typename Lattice, typename Data, typename Substep>
inline void adj_velocity_of_others(
    int e, const Lattice& lattice, const Data& data, const Substep& now, const wp::array_t<Vec3<Real>>& tools,
    const Rows<Vec4<Real>>& grid_m, const Rows<wp::int32>& near, const Rows<Vec4<Real>>&, int, const Lattice&,
    const Data&, const Substep&, const wp::array_t<Vec3<Real>>&, const Rows<Vec4<Real>>& adj_grid_m,
    const Rows<wp::int32>&, const Rows<Vec4<Real>>& adj_grid_v) {
    const Walls<Real, Data> walls(data, tools, e, now.step, now.fraction);
    const Real dt = now.dt, gravity = now.gravity, empty = now.empty;
    const Quad<Real> zero = {}, *G = (const Quad<Real>*)&wp::index(grid_m, e, 0);
    const Quad<Real>* VA = (const Quad<Real>*)&wp::index(adj_grid_v, e, 0);
    Quad<Real>* GA = (Quad<Real>*)&wp::index(adj_grid_m, e, 0);
    each_other_node(lattice, near, e, [&](int n, int i, int j, int k) {
        Quad<Real> back = zero;
        if (G[n][3] > empty) {
            const Quad<Real> p = node_position<Real>(lattice, i, j, k);
            const Quad<Real> v = walls.along(p, velocity_after_gravity<Real>(G[n], dt, gravity));
            const auto stopped = (walls.below(p) & ~(v > Real(0.0))) | (walls.above(p) & ~(v < Real(0.0)));
            back = adj_velocity_after_gravity<Real>(G[n], walls.along(p, stopped ? zero : VA[n]));
        }
        GA[n] = back;
    });
}

}  // namespace gradscape
