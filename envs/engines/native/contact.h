// Contact of sheets for a CPU: `contact` says what it does. Vertices that are held or may be inside a surface are found
// eight at a time, listed, and left to its Warp function and the adjoint that Warp makes of it; the others fly on.
// A call has one sheet's row.
#pragma once
#include "springs.h"

namespace gradscape {

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

// List vertices that are held or may be inside a surface, at a step's end or at its start, after how many these are.
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
