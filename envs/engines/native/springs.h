// Springs of sheets for a CPU, eight vertices at a time: `springs` says what each kernel does. A call has one sheet's
// row. Every number has the bits that the Warp kernels for a GPU give it, where these are run on a CPU.
#pragma once
#include "materials.h"

namespace gradscape {

template <typename Real> inline Eight<Real> read_eight(const Real* a) {
    Eight<Real> v;
    __builtin_memcpy(&v, a, sizeof(v));
    return v;
}

// Numbers of a row's vertices, those of a kind side by side, between eight zeros before and behind them.
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
    Eight<Real> at(int kind, int i) const { return read_eight((*this)[kind] + i); }
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

// A spring of each of eight vertices to those that are as much further, or none where `rest` is minus infinity.
template <typename Real> struct Springs {
    Eight<Real> rest, weight, plate;

    template <typename Network>
    Springs(const Network& network, int slot)
        : rest(read_eight(network.rest.data + lanes * slot)),
          weight(read_eight(network.weight.data + lanes * slot)),
          plate(read_eight(network.plates.data + lanes * slot)) {}
    auto exist() const { return rest > -Real(__builtin_inf()); }
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
            const Triple<V> d = minus(all.at3(X, j), xi), w = minus(all.at3(VV, j), vi);
            const V both = si + all.at(S, j), far = length(d);
            const V inverse = far > Real(0.0) ? Real(1.0) / far : V{};
            const Triple<V> n = times(inverse, d);
            const V tension = (Real(0.5) * both) * (far - springs.rest) + network.damping * dot(w, n);
            const Triple<V> bent = plus(f, times(springs.plate, d));
            f = choose(springs.exist(), plus(bent, times(springs.weight * tension, n)), f);
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
            gx = choose(springs.exist(), more, gx);
            gv = choose(springs.exist(), plus(gv, times(damped, n)), gv);
            gs = springs.exist() ? gs - Real(0.5) * along * longer : gs;
        }
        write3(XA, group, plus(read3(HERE, group), times(V{} + dt, gx)));
        const V left = V{} + (Real(1.0) - dt * network.drag);
        write3(VA, group, plus(times(left, read3(PULLED, group)), times(V{} + dt, gv)));
        write(SA, 1, group, read(SA, 1, group) + dt * gs);
    }
}

}  // namespace gradscape
