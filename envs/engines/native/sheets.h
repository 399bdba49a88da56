// Springs and contact of sheets for a CPU, eight vertices at a time: `springs` and `contact` say what each does. A call
// has the row of one sheet. Every number has the bits that their Warp kernels for a GPU give it.
#pragma once
#include "materials.h"

namespace gradscape {

// Numbers of every vertex, as many of a kind side by side; eight zeros before and behind them are neighbours of nobody.
template <typename Real> struct Columns {
    Real* first;
    int size;

    Columns(const wp::array_t<Real>& work, int count)
        : first(work.data + lanes), size((count + lanes - 1) / lanes * lanes + 2 * lanes) {}
    Real* operator[](int kind) const { return first + kind * size; }
    void keep(int kind, const Real* values, int count, int kinds = 3) const {
        for (int a = 0; a < kinds; ++a)
            for (int i = 0; i < count; ++i) (*this)[kind + a][i] = values[kinds * i + a];
    }
    Eight<Real> at(int kind, int i) const {
        Eight<Real> v;
        __builtin_memcpy(&v, (*this)[kind] + i, sizeof(v));
        return v;
    }
    Triple<Eight<Real>> at3(int kind, int i) const { return {at(kind, i), at(kind + 1, i), at(kind + 2, i)}; }
};

template <typename V> inline Triple<V> minus(Triple<V> a, Triple<V> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <typename V> inline Triple<V> times(V s, Triple<V> a) { return {s * a.x, s * a.y, s * a.z}; }
template <typename V> inline Triple<V> plus(Triple<V> a, Triple<V> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <typename Real> inline Triple<Eight<Real>> read3(const Real* a, const Group& group) {
    return {read(a, 3, group), read(a + 1, 3, group), read(a + 2, 3, group)};
}
template <typename V, typename Real> inline void write3(Real* a, const Group& group, Triple<V> v) {
    write(a, 3, group, v.x);
    write(a + 1, 3, group, v.y);
    write(a + 2, 3, group, v.z);
}

// A spring of each of eight vertices to those that are as much further, or none where `rest` is negative.
template <typename Real> struct Springs {
    Eight<Real> rest, weight, plate;

    template <typename Network> Springs(const Network& network, int slot) {
        __builtin_memcpy(&rest, network.rest.data + lanes * slot, sizeof(rest));
        __builtin_memcpy(&weight, network.weight.data + lanes * slot, sizeof(rest));
        __builtin_memcpy(&plate, network.plates.data + lanes * slot, sizeof(rest));
    }
};

template <typename Real, typename Network>
inline void pull(
    int e, const Network& network, Real dt, const Rows<Real>& stiffness, const Rows<Vec3<Real>>& x,
    const Rows<Vec3<Real>>& v, const Rows<Vec3<Real>>& pulled, const wp::array_t<Real>& work) {
    using V = Eight<Real>;
    enum { X, VV = 3, S = 6 };
    const int count = x.shape[1];
    const Columns<Real> all(work, count);
    all.keep(X, row_of(x, e), count);
    all.keep(VV, row_of(v, e), count);
    all.keep(S, row_of(stiffness, e), count, 1);
    Real* out = row_of(pulled, e);
    for (int p = 0, slot = 0; p < count; p += lanes) {
        const Group group(p, count);
        const Triple<V> xi = all.at3(X, p), vi = all.at3(VV, p);
        const V si = all.at(S, p);
        Triple<V> f = {};
        for (const int end = slot + network.count.data[p / lanes]; slot < end; ++slot) {
            const Springs<Real> springs(network, slot);
            const int j = p + network.neighbor.data[slot];
            const auto there = springs.rest >= Real(0.0);
            const Triple<V> d = minus(all.at3(X, j), xi), w = minus(all.at3(VV, j), vi);
            const V both = si + all.at(S, j), far = length(d);
            const V inverse = far > Real(0.0) ? Real(1.0) / far : V{};
            const Triple<V> n = times(inverse, d);
            const V tension = (Real(0.5) * both) * (far - springs.rest) + network.damping * dot(w, n);
            const Triple<V> bent = plus(f, times(springs.plate, d));
            f = choose(there, plus(bent, times(springs.weight * tension, n)), f);
        }
        Triple<V> a = minus(over(f, read(network.mass.data, 1, group)), times(V{} + network.drag, vi));
        a.y -= network.gravity;
        write3(out, group, plus(vi, times(V{} + dt, a)));
    }
}

template <typename Real, typename Network>
inline void adjoint_pull(
    int e, const Network& network, Real dt, const Rows<Real>& stiffness, const Rows<Vec3<Real>>& x,
    const Rows<Vec3<Real>>& v, const Rows<Vec3<Real>>& adj_here, const Rows<Vec3<Real>>& adj_pulled,
    const Rows<Vec3<Real>>& adj_x, const Rows<Vec3<Real>>& adj_v, const Rows<Real>& adj_stiffness,
    const wp::array_t<Real>& work) {
    using V = Eight<Real>;
    enum { X, VV = 3, S = 6, MU = 7 };
    const int count = x.shape[1];
    const Columns<Real> all(work, count);
    all.keep(X, row_of(x, e), count);
    all.keep(VV, row_of(v, e), count);
    all.keep(S, row_of(stiffness, e), count, 1);
    const Real *HERE = row_of(adj_here, e), *PULLED = row_of(adj_pulled, e);
    for (int a = 0; a < 3; ++a)
        for (int i = 0; i < count; ++i) all[MU + a][i] = network.inverse_mass.data[i] * PULLED[3 * i + a];
    Real *XA = row_of(adj_x, e), *VA = row_of(adj_v, e), *SA = row_of(adj_stiffness, e);
    const Real damping = network.damping;
    for (int p = 0, slot = 0; p < count; p += lanes) {
        const Group group(p, count);
        const Triple<V> xi = all.at3(X, p), vi = all.at3(VV, p), mui = all.at3(MU, p);
        const V si = all.at(S, p);
        Triple<V> gx = {}, gv = {};
        V gs = {};
        for (const int end = slot + network.count.data[p / lanes]; slot < end; ++slot) {
            const Springs<Real> springs(network, slot);
            const int j = p + network.neighbor.data[slot];
            const auto there = springs.rest >= Real(0.0);
            const Triple<V> d = minus(all.at3(X, j), xi), w = minus(all.at3(VV, j), vi);
            const Triple<V> difference = minus(all.at3(MU, j), mui);
            const V both = si + all.at(S, j), far = length(d);
            const V inverse = far > Real(0.0) ? Real(1.0) / far : V{};
            const Triple<V> n = times(inverse, d), mu = times(springs.weight, difference);
            const V s = Real(0.5) * both, along = dot(mu, n), rate = dot(w, n), longer = far - springs.rest;
            const V tension = s * longer + damping * rate, damped = damping * along;
            const Triple<V> across = minus(mu, times(along, n));
            Triple<V> more = plus(gx, times(springs.plate, difference));
            more = plus(more, plus(times(s * along, n), times(tension * inverse, across)));
            more = plus(more, times(damped * inverse, minus(w, times(rate, n))));
            gx = choose(there, more, gx);
            gv = choose(there, plus(gv, times(damped, n)), gv);
            gs = there ? gs - Real(0.5) * along * longer : gs;
        }
        write3(XA, group, plus(read3(HERE, group), times(V{} + dt, gx)));
        write3(VA, group, plus(times(V{} + (Real(1.0) - dt * network.drag), read3(PULLED, group)), times(V{} + dt, gv)));
        write(SA, 1, group, read(SA, 1, group) + dt * gs);
    }
}

// Which of eight places are inside a surface of a `pose`, or may be: its own Warp function decides.
template <typename Real, typename Data> struct InFloor {
    const Data& floor;
    InFloor(const Data& floor, const Vec3<Real>&) : floor(floor) {}
    auto holds(Triple<Eight<Real>> q) const { return q.y - floor.height < Real(0.0); }
};
template <typename Real, typename Data> struct InPan {
    const Data& pan;
    const Vec3<Real>& pose;
    Real c, s;
    InPan(const Data& pan, const Vec3<Real>& pose) : pan(pan), pose(pose), c(wp::cos(pose[2])), s(wp::sin(pose[2])) {}
    auto holds(Triple<Eight<Real>> q) const {
        const Eight<Real> dx = q.x - pose[0], dy = q.y - pose[1], x = c * dx + s * dy, y = c * dy - s * dx;
        const Eight<Real> squared = x * x + q.z * q.z, out = root(squared) - pan.flat, up = pan.bend - y;
        const Eight<Real> edge = pan.bend - root(out * out + up * up), d = squared > pan.flat * pan.flat ? edge : y;
        return (d < Real(0.0)) & ~(d < -pan.thickness);
    }
};
template <typename Real, typename Data> struct InEither {
    InPan<Real, decltype(Data::pan)> pan;
    InFloor<Real, decltype(Data::floor)> floor;
    InEither(const Data& both, const Vec3<Real>& pose) : pan(both.pan, pose), floor(both.floor, pose) {}
    auto holds(Triple<Eight<Real>> q) const { return pan.holds(q) | floor.holds(q); }
};

// List the numbers of vertices that are held or may be inside a surface, at a step's end or at its start, after how many.
template <template <typename, typename> class Inside, bool end, typename Real, typename Data>
inline void list_touched(
    int e, Real dt, const Data& data, const wp::array_t<bool>& held, const Rows<Vec3<Real>>& pose,
    const Rows<Vec3<Real>>& following, const Rows<Vec3<Real>>& x, const Rows<Vec3<Real>>& pulled,
    const Rows<wp::int32>& touched) {
    const Vec3<Real> when = wp::index(end ? following : pose, e, 0);
    const Inside<Real, Data> inside(data, when);
    const Real *X = row_of(x, e), *V = row_of(pulled, e);
    int *TOUCHED = row_of(touched, e), found = 0;
    for (int p = 0, count = x.shape[1]; p < count; p += lanes) {
        const Group group(p, count);
        Triple<Eight<Real>> q = read3(X, group);
        if (end) q = plus(q, times(Eight<Real>{} + dt, read3(V, group)));
        const auto holds = inside.holds(q);
        for (int l = 0; l < group.some; ++l)
            if (holds[l] || held.data[p + l]) TOUCHED[++found] = p + l;
    }
    TOUCHED[0] = found;
}

// Call `at(k)` of every number k of vertices that are not listed.
template <typename At> inline void each_number_of_others(const int* touched, int count, At at) {
    for (int n = 1, from = 0; n <= touched[0] + 1; ++n) {
        const int to = n <= touched[0] ? touched[n] : count;
        for (int k = 3 * from; k < 3 * to; ++k) at(k);
        from = to + 1;
    }
}

// Move the vertices that nothing stops, and set the adjoints of where they were and of their velocities.
template <typename Real>
inline void move_others(
    int e, Real dt, const Rows<wp::int32>& touched, const Rows<Vec3<Real>>&, const Rows<Vec3<Real>>&,
    const Rows<Vec3<Real>>& x, const Rows<Vec3<Real>>& pulled, const Rows<Vec3<Real>>& x_next,
    const Rows<Vec3<Real>>& v_next) {
    const Real *X = row_of(x, e), *V = row_of(pulled, e);
    Real *XN = row_of(x_next, e), *VN = row_of(v_next, e);
    each_number_of_others(row_of(touched, e), x.shape[1], [=](int k) {
        const Real v = V[k] + Real(0.0);
        VN[k] = v;
        XN[k] = X[k] + dt * v;
    });
}
template <typename Real>
inline void adj_move_others(
    int e, Real dt, const Rows<wp::int32>& touched, const Rows<Vec3<Real>>&, const Rows<Vec3<Real>>&,
    const Rows<Vec3<Real>>& x, const Rows<Vec3<Real>>&, const Rows<Vec3<Real>>&, const Rows<Vec3<Real>>&, int, Real,
    const Rows<wp::int32>&, const Rows<Vec3<Real>>& adj_pose, const Rows<Vec3<Real>>& adj_following,
    const Rows<Vec3<Real>>& adj_x, const Rows<Vec3<Real>>& adj_pulled, const Rows<Vec3<Real>>& adj_x_next,
    const Rows<Vec3<Real>>& adj_v_next) {
    const int *TOUCHED = row_of(touched, e), count = x.shape[1];
    const Real *XN = row_of(adj_x_next, e), *VN = row_of(adj_v_next, e);
    Real *XA = row_of(adj_x, e), *VA = row_of(adj_pulled, e);
    each_number_of_others(TOUCHED, count, [=](int k) {
        XA[k] = XN[k] + Real(0.0);
        VA[k] = (dt * XN[k] + Real(0.0)) + VN[k];
    });
    if (!adj_pose.data) return;
    Real *PA = row_of(adj_pose, e), *FA = row_of(adj_following, e);
    each_number_of_others(TOUCHED, count, [=](int k) { PA[k] = FA[k] = Real(0.0); });
}

// Add to a row's vector the sum of its vertices'; of every so many first, as of a square's columns.
template <typename Vector>
inline void add_vertices(int e, const Rows<Vector>& by_vertex, const wp::array_t<Vector>& by_row) {
    const Vector* given = &wp::index(by_vertex, e, 0);
    const int count = by_vertex.shape[1];
    int parts = 1;
    while ((parts + 1) * (parts + 1) <= count) ++parts;
    Vector all;
    for (int part = 0; part < parts; ++part) {
        Vector total;
        for (int i = part; i < count; i += parts) total += given[i];
        all += total;
    }
    by_row.data[e] = by_row.data[e] + all;
}

}  // namespace gradscape
