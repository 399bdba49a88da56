// Reads and writes of elements: wide ones on a GPU, Warp's own on a CPU.
//
// A matrix of each particle lies as Warp has it on a CPU. On a GPU an environment's row holds the first numbers of all
// matrices, then the second ones, and so on: neighbouring threads read what lies side by side. The four numbers
// of a node are read and written as one. Indices are not looked at for whether they count from the end, as Warp does.
#pragma once
#include "builtin.h"

namespace gradscape {

template <typename T> using Rows = wp::array_t<T>;  // [environment, element]
template <typename Real> using Vec3 = wp::vec_t<3, Real>;
template <typename Real> using Vec4 = wp::vec_t<4, Real>;
template <typename Real> using Mat33 = wp::mat_t<3, 3, Real>;
template <typename Real> struct alignas(16) Four { Real a, b, c, d; };

template <typename Real> inline CUDA_CALLABLE Mat33<Real> read_matrix(const Rows<Mat33<Real>>& values, int e, int p) {
#if defined(__CUDA_ARCH__)
    const Real *row = (const Real *)&wp::index(values, e, 0) + p;
    const int count = values.shape[1];
    return Mat33<Real>(
        row[0], row[count], row[2 * count], row[3 * count], row[4 * count], row[5 * count], row[6 * count],
        row[7 * count], row[8 * count]);
#else
    return wp::index(values, e, p);
#endif
}

template <typename Real>
inline CUDA_CALLABLE void write_matrix(const Rows<Mat33<Real>>& values, int e, int p, const Mat33<Real>& value) {
#if defined(__CUDA_ARCH__)
    Real *row = (Real *)&wp::index(values, e, 0) + p;
    const int count = values.shape[1];
    for (int number = 0; number < 9; ++number) row[number * count] = value.data[number / 3][number % 3];
#else
    wp::index(values, e, p) = value;
#endif
}

template <typename Real> inline CUDA_CALLABLE Vec4<Real> read_node(const Rows<Vec4<Real>>& grid, int e, int i) {
#if defined(__CUDA_ARCH__)
    const Four<Real> four = ((const Four<Real> *)&wp::index(grid, e, 0))[i];
    return Vec4<Real>(four.a, four.b, four.c, four.d);
#else
    return wp::index(grid, e, i);
#endif
}

template <typename Real>
inline CUDA_CALLABLE void write_node(const Rows<Vec4<Real>>& grid, int e, int i, const Vec4<Real>& value) {
#if defined(__CUDA_ARCH__)
    ((Four<Real> *)&wp::index(grid, e, 0))[i] = Four<Real>{value[0], value[1], value[2], value[3]};
#else
    wp::index(grid, e, i) = value;
#endif
}

// The i-th element of a row, and of a whole array.
template <typename T> inline CUDA_CALLABLE T read_element(const Rows<T>& values, int e, int i) {
    return (&wp::index(values, e, 0))[i];
}
template <typename T> inline CUDA_CALLABLE T read_flat(const wp::array_t<T>& values, int i) { return values.data[i]; }

// Warp's own adjoints of these, for a CPU, where tests hold those by hand against them.
template <typename T>
inline CUDA_CALLABLE void adj_read_element(
    const Rows<T>&, int e, int i, const Rows<T>& adj_values, int, int, const T& adj_ret) {
    if (adj_values.data) wp::index(adj_values, e, i) += adj_ret;
}
template <typename T>
inline CUDA_CALLABLE void adj_write_matrix(
    const Rows<T>&, int e, int p, const T&, const Rows<T>& adj_values, int, int, T& adj_value) {
    if (adj_values.data) adj_value += wp::index(adj_values, e, p);
}

// An element of an array whose elements need not lie one after another.
template <typename T> inline CUDA_CALLABLE T read_strided(const Rows<T>& values, int row, int i) {
    return wp::index(values, row, i);
}

// Adjoints that set what Warp would add to atomically: of what is read once, and is set once.
template <typename T>
inline CUDA_CALLABLE void set_adj_read_strided(
    const Rows<T>&, int e, int i, const Rows<T>& adj_values, int, int, const T& adj_ret) {
    if (adj_values.data) wp::index(adj_values, e, i) = adj_ret;
}
template <typename Real>
inline CUDA_CALLABLE void set_adj_read_node(
    const Rows<Vec4<Real>>&, int e, int i, const Rows<Vec4<Real>>& adj_grid, int, int, const Vec4<Real>& adj_ret) {
    write_node(adj_grid, e, i, adj_ret);
}
template <typename Real>
inline CUDA_CALLABLE void set_adj_write_node(
    const Rows<Vec4<Real>>&, int e, int i, const Vec4<Real>&, const Rows<Vec4<Real>>& adj_grid, int, int,
    Vec4<Real>& adj_value) {
    adj_value += read_node(adj_grid, e, i);
}

}  // namespace gradscape
