"""The 27 nodes around a particle in C++, those of eight particles at a time: texts of which kernels for a CPU are made.

What is calculated for each particle alone is calculated for eight. Where they add to nodes, which they may share, one
comes after another. Every number comes of the operations of `stencil`, in their order.
"""

from .eight_cpu import EIGHT, GROUPS

STENCIL = (
    EIGHT
    + """
    const float inv_dx = lattice.inv_dx, dx = 1.0f / lattice.inv_dx;
    const int nodes[3] = {lattice.nx, lattice.ny, lattice.nz}, ny = lattice.ny, nz = lattice.nz;
    auto find_base = [](V s, int first, int count) {
        const Int i = __builtin_convertvector(__builtin_elementwise_floor(s - 0.5f), Int);
        const Int least = Int{} + first, last = Int{} + (first + count - 3);
        return i < least ? least : i > last ? last : i;
    };
    auto find_weights = [](V f, V* w) {
        w[0] = 0.5f * (1.5f - f) * (1.5f - f);
        w[1] = 0.75f - (f - 1.0f) * (f - 1.0f);
        w[2] = 0.5f * (f - 0.5f) * (f - 0.5f);
    };
    auto find_slopes = [](V f, V* w) {
        w[0] = f - 1.5f;
        w[1] = 2.0f - 2.0f * f;
        w[2] = f - 0.5f;
    };
"""
)
# Of eight particles from p on: the nodes where their stencils begin, where they are from there [cells], their weights.
# Nodes lie one after another, z fastest.
EACH = (
    GROUPS
    + """
        V x3[3], f[3], wx[3], wy[3], wz[3];
        Int base[3];
        read_all(X, 3, at, x3);
        for (int a = 0; a < 3; ++a) {
            const V s = (x3[a] - lattice.origin[a]) * inv_dx;
            base[a] = find_base(s, lattice.first[a], nodes[a]);
            f[a] = s - __builtin_convertvector(base[a], V);
            base[a] -= lattice.first[a];
        }
        const Int corner = (base[0] * ny + base[1]) * nz + base[2];
        find_weights(f[0], wx);
        find_weights(f[1], wy);
        find_weights(f[2], wz);
"""
)
SLOPES = """
        V dwx[3], dwy[3], dwz[3];
        find_slopes(f[0], dwx);
        find_slopes(f[1], dwy);
        find_slopes(f[2], dwz);
"""
# The rows of nodes of all eight.
ROWS = """
        #pragma clang loop unroll(full)
        for (int i = 0; i < 3; ++i)
            #pragma clang loop unroll(full)
            for (int j = 0; j < 3; ++j) {
                const int row = (i * ny + j) * nz;
                const V wij = wx[i] * wy[j];
"""
# One after another, q: its rows of nodes.
ONE_BY_ONE = """
        for (int l = 0; l < some; ++l) {
            const int q = p + l, start = ((const int*)&corner)[l];
"""
ROWS_OF_ONE = """
            #pragma clang loop unroll(full)
            for (int i = 0; i < 3; ++i)
                #pragma clang loop unroll(full)
                for (int j = 0; j < 3; ++j) {
                    const int row = start + (i * ny + j) * nz;
"""
