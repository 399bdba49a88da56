// Eight particles at a time on a CPU, whose compiler makes one instruction of what is calculated for all of them.
//
// An Eight has a number of each of eight particles, a Quad three numbers of one and another that is 0, or four of a
// node. Every number has the bits that it has where each particle is calculated alone, by Warp's own vectors and
// matrices. Logarithms and exponentials are those of the C library, one by one, since others would round otherwise.
#pragma once
#include "layout.h"

namespace gradscape {

constexpr int lanes = 8;
typedef int EightInts __attribute__((vector_size(32)));

template <typename Real> struct Wide;
template <> struct Wide<float> {
    typedef float Eight __attribute__((vector_size(32)));
    typedef float Quad __attribute__((vector_size(16), aligned(4)));
};
template <> struct Wide<double> {
    typedef double Eight __attribute__((vector_size(64)));
    typedef double Quad __attribute__((vector_size(32), aligned(8)));
};
template <typename Real> using Eight = typename Wide<Real>::Eight;
template <typename Real> using Quad = typename Wide<Real>::Quad;
template <typename Vector> using Element = decltype(Vector{}[0] + Vector{}[0]);

// The particles from p on, of which `count` there are: where fewer than eight are left, the last stands for the others.
struct Group {
    int p, some, at[lanes];
    Group(int p, int count) : p(p), some(count - p < lanes ? count - p : lanes) {
        for (int l = 0; l < lanes; ++l) at[l] = p + (l < some ? l : some - 1);
    }
};

// Numbers of a group's particles, which are `size` apart in their array.
template <typename Real> inline Eight<Real> read(const Real* a, int size, const Group& group) {
    Eight<Real> v;
    #pragma clang loop unroll(full)
    for (int l = 0; l < lanes; ++l) v[l] = a[size * group.at[l]];
    return v;
}
template <typename Real> inline void write(Real* a, int size, const Group& group, Eight<Real> v) {
    #pragma clang loop unroll(full)
    for (int l = 0; l < lanes; ++l)
        if (l < group.some) a[size * (group.p + l)] = v[l];
}
template <typename Real> inline void read_all(const Real* a, int size, const Group& group, Eight<Real>* out) {
    for (int k = 0; k < size; ++k) out[k] = read(a + k, size, group);
}
template <typename Real> inline void write_all(Real* a, int size, const Group& group, const Eight<Real>* v) {
    for (int k = 0; k < size; ++k) write(a + k, size, group, v[k]);
}

// Three numbers of one particle.
template <typename Real> inline Quad<Real> read3(const Real* a) { return Quad<Real>{a[0], a[1], a[2], Real(0)}; }
template <typename Real> inline Quad<Real> read_column(const Real* a) { return Quad<Real>{a[0], a[3], a[6], Real(0)}; }
template <typename Real> inline void write3(Real* a, Quad<Real> v) { a[0] = v[0]; a[1] = v[1]; a[2] = v[2]; }
template <typename Real> inline void write_columns(Real* a, Quad<Real> x, Quad<Real> y, Quad<Real> z) {
    a[0] = x[0]; a[1] = y[0]; a[2] = z[0];
    a[3] = x[1]; a[4] = y[1]; a[5] = z[1];
    a[6] = x[2]; a[7] = y[2]; a[8] = z[2];
}
template <typename Vector> inline Element<Vector> of_one(const Vector& v, int l) {
    return ((const Element<Vector>*)&v)[l];
}

inline float logarithm_of(float a) { return ::logf(a); }
inline double logarithm_of(double a) { return ::log(a); }
inline float exponential_of(float a) { return ::expf(a); }
inline double exponential_of(double a) { return ::exp(a); }
inline float hyperbolic_sine_of(float a) { return ::sinhf(a); }
inline double hyperbolic_sine_of(double a) { return ::sinh(a); }
template <typename Vector> inline Vector logarithm(Vector a) {
    for (int l = 0; l < lanes; ++l) a[l] = logarithm_of(Element<Vector>(a[l]));
    return a;
}
template <typename Vector> inline Vector exponential(Vector a) {
    for (int l = 0; l < lanes; ++l) a[l] = exponential_of(Element<Vector>(a[l]));
    return a;
}

template <typename Vector> inline Vector first_two(Vector a, Vector b) {
    return __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13);
}
template <typename Vector> inline Vector last_two(Vector a, Vector b) {
    return __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
}
template <typename Vector> inline Vector first_pairs(Vector a, Vector b) {
    return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13);
}
template <typename Vector> inline Vector last_pairs(Vector a, Vector b) {
    return __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
}

// Take the four numbers of a node of each particle.
template <typename Vector>
inline void gather(const Quad<Element<Vector>>* a, EightInts at, int further, Vector* out) {
    auto two = [&](int l) {
        return __builtin_shufflevector(a[at[l] + further], a[at[l + 4] + further], 0, 1, 2, 3, 4, 5, 6, 7);
    };
    const Vector a0 = two(0), a1 = two(1), a2 = two(2), a3 = two(3);
    out[0] = first_pairs(first_two(a0, a1), first_two(a2, a3));
    out[1] = last_pairs(first_two(a0, a1), first_two(a2, a3));
    out[2] = first_pairs(last_two(a0, a1), last_two(a2, a3));
    out[3] = last_pairs(last_two(a0, a1), last_two(a2, a3));
}
// Give each particle its three numbers; `dealt` returns those of one.
template <typename Vector> inline void deal(Vector x, Vector y, Vector z, Vector* out) {
    out[0] = first_pairs(first_two(x, y), first_two(z, Vector{}));
    out[1] = last_pairs(first_two(x, y), first_two(z, Vector{}));
    out[2] = first_pairs(last_two(x, y), last_two(z, Vector{}));
    out[3] = last_pairs(last_two(x, y), last_two(z, Vector{}));
}
template <typename Vector> inline Quad<Element<Vector>> dealt(const Vector* all, int l) {
    return ((const Quad<Element<Vector>>*)all)[l % 4 * 2 + l / 4];
}

// The stencils of a group: the nodes where they begin, how far particles are from there [cells], weights and slopes.
template <typename Real> struct Stencils {
    Eight<Real> x[3], f[3], wx[3], wy[3], wz[3];
    EightInts corner;

    template <typename Lattice> Stencils(const Lattice& lattice, const Real* X, const Group& group) {
        const int nodes[3] = {lattice.nx, lattice.ny, lattice.nz};
        EightInts base[3];
        read_all(X, 3, group, x);
        for (int a = 0; a < 3; ++a) {
            const Eight<Real> s = (x[a] - lattice.origin[a]) * lattice.inv_dx;
            base[a] = find_base(s, lattice.first[a], nodes[a]);
            f[a] = s - __builtin_convertvector(base[a], Eight<Real>);
            base[a] -= lattice.first[a];
        }
        corner = (base[0] * nodes[1] + base[1]) * nodes[2] + base[2];
        find_weights(f[0], wx);
        find_weights(f[1], wy);
        find_weights(f[2], wz);
    }
    static EightInts find_base(Eight<Real> s, int first, int count) {
        const EightInts i = __builtin_convertvector(__builtin_elementwise_floor(s - Real(0.5)), EightInts);
        const EightInts least = EightInts{} + first, last = EightInts{} + (first + count - 3);
        return i < least ? least : i > last ? last : i;
    }
    static void find_weights(Eight<Real> f, Eight<Real>* w) {
        w[0] = Real(0.5) * (Real(1.5) - f) * (Real(1.5) - f);
        w[1] = Real(0.75) - (f - Real(1.0)) * (f - Real(1.0));
        w[2] = Real(0.5) * (f - Real(0.5)) * (f - Real(0.5));
    }
    int start(int l) const { return ((const int*)&corner)[l]; }
};
template <typename Real> struct Slopes {
    Eight<Real> x[3], y[3], z[3];

    explicit Slopes(const Eight<Real>* f) {
        find(f[0], x);
        find(f[1], y);
        find(f[2], z);
    }
    static void find(Eight<Real> f, Eight<Real>* w) {
        w[0] = f - Real(1.5);
        w[1] = Real(2.0) - Real(2.0) * f;
        w[2] = f - Real(0.5);
    }
};

}  // namespace gradscape
