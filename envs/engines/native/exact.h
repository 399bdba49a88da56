// Sums of floating-point numbers that come out the same whatever their order, since they are sums of integers.
//
// A number is added as an integer, its mantissa, to one of many sums that stand for ranges of exponents, 16 of them
// each; the last sum of all counts what is no number.
#pragma once
#include "layout.h"

namespace gradscape {

#if defined(__CUDA_ARCH__)
template <int count> inline CUDA_CALLABLE void add_exactly(unsigned long long *sums, float value) {
    const unsigned bits = __float_as_uint(value), exponent = bits >> 23 & 255u;
    const long long mantissa = (bits & 0x7fffffu) | (exponent ? 0x800000u : 0u);
    const int shift = exponent ? exponent - 1 : 0;
    const int last = exponent == 255u;
    const long long part = last ? 1 : mantissa << (shift & 15);
    atomicAdd(sums + (last ? count - 1 : shift >> 4), (unsigned long long)(bits >> 31 && !last ? -part : part));
}
template <int count> inline CUDA_CALLABLE void add_exactly(unsigned long long *sums, double value) {
    const unsigned long long bits = __double_as_longlong(value), exponent = bits >> 52 & 2047u;
    const unsigned long long mantissa = (bits & 0xfffffffffffffull) | (exponent ? 0x10000000000000ull : 0ull);
    if (exponent == 2047u) {
        atomicAdd(sums + count - 1, 1ull);
        return;
    }
    for (int third = 0; third < 3; ++third) {
        const int shift = (exponent ? (int)exponent - 1 : 0) + 18 * third;
        const long long part = (long long)(mantissa >> 18 * third & 0x3ffffull) << (shift & 15);
        if (part) atomicAdd(sums + (shift >> 4), (unsigned long long)(bits >> 63 ? -part : part));
    }
}
#endif

// Where a tool is `after` a control step has begun (0) or ended (1).
template <typename Real>
inline CUDA_CALLABLE Vec3<Real> look_at_tool(
    const wp::array_t<Vec3<Real>>& tools, int e, int step, int after, int slot) {
    return wp::index(tools, e, step + after, slot);
}
template <int lanes, int count, typename Real>
inline CUDA_CALLABLE Vec3<Real> read_tool(
    const wp::array_t<Vec3<Real>>& tools, const Rows<wp::int64>&, int e, int, int step, int after, int slot) {
    return wp::index(tools, e, step + after, slot);
}
template <int lanes, int count, typename Real>
inline CUDA_CALLABLE void adj_read_tool(
    [[maybe_unused]] const wp::array_t<Vec3<Real>>& tools, [[maybe_unused]] const Rows<wp::int64>& sums, int e,
    [[maybe_unused]] int lane, [[maybe_unused]] int step, int after, int slot,
    [[maybe_unused]] const wp::array_t<Vec3<Real>>& adj_tools, const Rows<wp::int64>&, int, int, int, int, int,
    const Vec3<Real>& adj_ret) {
#if defined(__CUDA_ARCH__)
    unsigned long long *all = (unsigned long long *)&wp::index(sums, e * lanes + lane, 0);
    for (int axis = 0; axis < 3; ++axis) {
        const Real value = adj_ret[axis];
        if (value == Real(0.0)) continue;
        add_exactly<count>(all + ((after * tools.shape[2] + slot) * 3 + axis) * count, value);
    }
#else
    wp::adj_atomic_add(&wp::index(adj_tools, e, step + after, slot), adj_ret);
#endif
}

// What an environment's lanes have added to a sum, which is 0 then.
template <int lanes> inline CUDA_CALLABLE long long take_sum(const Rows<wp::int64>& sums, int e, int at) {
    long long *first = (long long *)&wp::index(sums, e * lanes, at), total = 0;
    const int across = sums.shape[1];
#pragma unroll
    for (int lane = 0; lane < lanes; ++lane) total += first[lane * across];
#pragma unroll
    for (int lane = 0; lane < lanes; ++lane) first[lane * across] = 0;
    return total;
}

// A sum of the range that begins at exponent `bits` * range - lowest.
template <int bits, int lowest> inline CUDA_CALLABLE double weigh_sum(long long sum, int range) {
    return ldexp((double)sum, bits * range - lowest);
}
inline CUDA_CALLABLE double no_number() { return NAN; }

}  // namespace gradscape
