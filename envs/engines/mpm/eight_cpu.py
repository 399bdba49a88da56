"""Eight particles at a time in C++: texts of which kernels for a CPU are made.

A `V` has a number of each of eight particles, and a `V4` three numbers of one and another that is 0, or four of a node.
Compilers make one instruction of what is calculated for all of them, and the same bits as for each alone.
"""

# `read` takes a number of each of the particles `at`, which are `size` apart in their array; `write` stores one of each
# of `some` from p on. `gather` takes the four numbers of a node of each particle, `deal` gives each its three numbers.
EIGHT = """
    typedef float V4 __attribute__((vector_size(16), aligned(4)));
    typedef float V __attribute__((vector_size(32)));
    typedef int Int __attribute__((vector_size(32)));
    const int lanes = 8;
    auto read = [](const float* a, int size, const int* at) {
        V v;
        #pragma clang loop unroll(full)
        for (int l = 0; l < lanes; ++l) v[l] = a[size * at[l]];
        return v;
    };
    auto write = [](float* a, int size, int p, int some, V v) {
        #pragma clang loop unroll(full)
        for (int l = 0; l < lanes; ++l)
            if (l < some) a[size * (p + l)] = v[l];
    };
    auto read_all = [&](const float* a, int size, const int* at, V* out) {
        for (int k = 0; k < size; ++k) out[k] = read(a + k, size, at);
    };
    auto write_all = [&](float* a, int size, int p, int some, const V* v) {
        for (int k = 0; k < size; ++k) write(a + k, size, p, some, v[k]);
    };
    auto read3 = [](const float* a) { return V4{a[0], a[1], a[2], 0.0f}; };
    auto read_column = [](const float* a) { return V4{a[0], a[3], a[6], 0.0f}; };
    auto write3 = [](float* a, V4 v) { a[0] = v[0]; a[1] = v[1]; a[2] = v[2]; };
    auto write_columns = [](float* a, V4 x, V4 y, V4 z) {
        a[0] = x[0]; a[1] = y[0]; a[2] = z[0];
        a[3] = x[1]; a[4] = y[1]; a[5] = z[1];
        a[6] = x[2]; a[7] = y[2]; a[8] = z[2];
    };
    auto of_one = [](const V& v, int l) { return ((const float*)&v)[l]; };
    auto logarithm = [](V a) {
        for (int l = 0; l < lanes; ++l) a[l] = ::logf(a[l]);
        return a;
    };
    auto exponential = [](V a) {
        for (int l = 0; l < lanes; ++l) a[l] = ::expf(a[l]);
        return a;
    };
    auto first_two = [](V a, V b) { return __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13); };
    auto last_two = [](V a, V b) { return __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15); };
    auto first_pairs = [](V a, V b) { return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13); };
    auto last_pairs = [](V a, V b) { return __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15); };
    auto gather = [&](const V4* a, Int at, int further, V* out) {
        auto two = [&](int l) {
            return __builtin_shufflevector(a[at[l] + further], a[at[l + 4] + further], 0, 1, 2, 3, 4, 5, 6, 7);
        };
        const V a0 = two(0), a1 = two(1), a2 = two(2), a3 = two(3);
        out[0] = first_pairs(first_two(a0, a1), first_two(a2, a3));
        out[1] = last_pairs(first_two(a0, a1), first_two(a2, a3));
        out[2] = first_pairs(last_two(a0, a1), last_two(a2, a3));
        out[3] = last_pairs(last_two(a0, a1), last_two(a2, a3));
    };
    auto deal = [&](V x, V y, V z, V* out) {
        out[0] = first_pairs(first_two(x, y), first_two(z, V{}));
        out[1] = last_pairs(first_two(x, y), first_two(z, V{}));
        out[2] = first_pairs(last_two(x, y), last_two(z, V{}));
        out[3] = last_pairs(last_two(x, y), last_two(z, V{}));
    };
    auto dealt = [](const V* all, int l) { return ((const V4*)all)[l % 4 * 2 + l / 4]; };
"""
# Where fewer than eight are left, the last stands for those that are not there.
GROUPS = """
    for (int p = 0; p < count; p += lanes) {
        const int some = count - p < lanes ? count - p : lanes;
        int at[lanes];
        for (int l = 0; l < lanes; ++l) at[l] = p + (l < some ? l : some - 1);
"""
