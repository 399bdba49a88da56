// CUDA on a CPU, for tests: a block at a time, its threads as threads of the CPU, whose warps meet where lanes do.
#pragma once
#include <atomic>
#include <barrier>
#include <bit>
#include <cstring>
#include <memory>
#include <thread>
#include <vector>

const unsigned BLOCK = 128, LANES = 32;

struct Place { unsigned x = 0, y = 0, z = 0; };
struct Warp {
    std::barrier<> meeting{LANES};
    unsigned long long said[LANES];
};
inline thread_local Place threadIdx, blockIdx;
inline const Place blockDim{BLOCK, 1, 1};
inline Place gridDim{1, 1, 1};
inline Warp *warps;

inline int lane() { return threadIdx.x % LANES; }
inline Warp &warp() { return warps[threadIdx.x / LANES]; }
inline void __syncwarp() { warp().meeting.arrive_and_wait(); }

// Tell all lanes of the warp a value, and return what `read` makes of what they said.
template <class T, class F> auto agree(T value, F read) {
    static_assert(sizeof(T) <= sizeof(unsigned long long));
    std::memcpy(&warp().said[lane()], &value, sizeof(T));
    __syncwarp();
    const auto found = read([](int other) { T one; std::memcpy(&one, &warp().said[other], sizeof(T)); return one; });
    __syncwarp();
    return found;
}
// Where lanes may have parted, each is told that it is alone.
inline unsigned __activemask() { return 1u << lane(); }
inline bool alone(unsigned mask) { return mask == 1u << lane(); }
inline unsigned __match_any_sync(unsigned mask, unsigned value) {
    if (alone(mask)) return mask;
    return agree(value, [&](auto of) { unsigned same = 0; for (int i = 0; i < 32; ++i) same |= (of(i) == value) << i; return same; });
}
inline unsigned __ballot_sync(unsigned, bool value) {
    return agree(value, [](auto of) { unsigned set = 0; for (int i = 0; i < 32; ++i) set |= (unsigned)of(i) << i; return set; });
}
template <class T> T __shfl_sync(unsigned mask, T value, int from) {
    return alone(mask) ? value : agree(value, [&](auto of) { return of(from % LANES); });
}
template <class T> T __shfl_up_sync(unsigned, T value, int by) {
    return agree(value, [&](auto of) { return of(lane() < by ? lane() : lane() - by); });
}
template <class T> T __shfl_xor_sync(unsigned, T value, int by) {
    return agree(value, [&](auto of) { return of(lane() ^ by); });
}
inline int __reduce_max_sync(unsigned, int value) {
    return agree(value, [](auto of) { int most = of(0); for (int i = 1; i < 32; ++i) most = std::max(most, of(i)); return most; });
}
inline int __popc(unsigned value) { return __builtin_popcount(value); }
inline int __ffs(unsigned value) { return __builtin_ffs(value); }
inline float __fadd_rn(float a, float b) { return a + b; }
inline double __dadd_rn(double a, double b) { return a + b; }
inline unsigned __float_as_uint(float value) { return std::bit_cast<unsigned>(value); }
inline long long __double_as_longlong(double value) { return std::bit_cast<long long>(value); }
template <class T> T atomicAdd(T *place, T value) { return __atomic_fetch_add(place, value, __ATOMIC_SEQ_CST); }

template <class F> void launch(size_t count, F kernel) {
    gridDim.x = (count + BLOCK - 1) / BLOCK;
    for (unsigned block = 0; block < gridDim.x; ++block) {
        const auto fresh = std::make_unique<Warp[]>(BLOCK / LANES);
        warps = fresh.get();
        std::vector<std::jthread> threads;
        for (unsigned t = 0; t < BLOCK; ++t)
            threads.emplace_back([=] {
                threadIdx.x = t, blockIdx.x = block;
                kernel();
                warp().meeting.arrive_and_drop();
            });
    }
}

#define __CUDA_ARCH__ 900
#define __global__ static
#define __shared__ static
