"""The transfers for a CPU in float32, in C++: four numbers at a time, an environment's particles one after another.

They have the arguments of the kernels in `transfers`, which say what each does, and give the same bits, since every sum
comes in the same order. Warp's own code for a CPU works on one number at a time.
"""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ..runtime import precision, take_rows
from .stencil import lattice
from .transfers import transfers

# Of particle p: the node where its stencil begins, where it is from there [cells], its weights and their slopes. `V4`
# are three numbers of a particle and one that is zero, or four of a node; nodes lie one after another, z fastest.
STENCIL = """
    typedef float V4 __attribute__((vector_size(16), aligned(4)));
    const float inv_dx = grid.inv_dx, dx = 1.0f / grid.inv_dx;
    const int ny = grid.ny, nz = grid.nz;
    auto find_base = [](float s, int first, int count) {
        const int i = (int)__builtin_floorf(s - 0.5f), last = first + count - 3;
        return i < first ? first : i > last ? last : i;
    };
    auto find_weights = [](float f, float* w) {
        w[0] = 0.5f * (1.5f - f) * (1.5f - f);
        w[1] = 0.75f - (f - 1.0f) * (f - 1.0f);
        w[2] = 0.5f * (f - 0.5f) * (f - 0.5f);
    };
    auto find_slopes = [](float f, float* w) {
        w[0] = f - 1.5f;
        w[1] = 2.0f - 2.0f * f;
        w[2] = f - 0.5f;
    };
    auto read3 = [](const float* a) { return V4{a[0], a[1], a[2], 0.0f}; };
    auto read_column = [](const float* a) { return V4{a[0], a[3], a[6], 0.0f}; };
    auto write3 = [](float* a, V4 v) { a[0] = v[0]; a[1] = v[1]; a[2] = v[2]; };
    auto write_columns = [](float* a, V4 x, V4 y, V4 z) {
        a[0] = x[0]; a[1] = y[0]; a[2] = z[0];
        a[3] = x[1]; a[4] = y[1]; a[5] = z[1];
        a[6] = x[2]; a[7] = y[2]; a[8] = z[2];
    };
"""
PRELUDE = (
    STENCIL
    + """
    const float* X = (const float*)&wp::index(x, e, 0);
    const int count = x.shape[1];
"""
)
EACH = """
    for (int p = 0; p < count; ++p) {
        const float s[3] = {
            (X[3 * p] - grid.origin[0]) * inv_dx,
            (X[3 * p + 1] - grid.origin[1]) * inv_dx,
            (X[3 * p + 2] - grid.origin[2]) * inv_dx};
        const int base[3] = {
            find_base(s[0], grid.first[0], grid.nx),
            find_base(s[1], grid.first[1], ny),
            find_base(s[2], grid.first[2], nz)};
        const float f[3] = {s[0] - (float)base[0], s[1] - (float)base[1], s[2] - (float)base[2]};
        const int corner = ((base[0] - grid.first[0]) * ny + base[1] - grid.first[1]) * nz + base[2] - grid.first[2];
        float wx[3], wy[3], wz[3];
        find_weights(f[0], wx);
        find_weights(f[1], wy);
        find_weights(f[2], wz);
"""
SLOPES = """
        float dwx[3], dwy[3], dwz[3];
        find_slopes(f[0], dwx);
        find_slopes(f[1], dwy);
        find_slopes(f[2], dwz);
"""
ROWS = """
        #pragma clang loop unroll(full)
        for (int i = 0; i < 3; ++i)
            #pragma clang loop unroll(full)
            for (int j = 0; j < 3; ++j) {
                const int row = corner + (i * ny + j) * nz;
                const float wij = wx[i] * wy[j];
"""
P2G = (
    PRELUDE
    + """
    const float *M = &wp::index(mass, e, 0), *V = (const float*)&wp::index(v, e, 0);
    const float* AA = (const float*)&wp::index(A, e, 0);
    V4* G = (V4*)&wp::index(grid_m, e, 0);
"""
    + EACH
    + """
        const float m = M[p];
        const V4 ax = read_column(AA + 9 * p) * dx, ay = read_column(AA + 9 * p + 1) * dx;
        const V4 az = read_column(AA + 9 * p + 2) * dx;
        V4 af = ax * f[0];
        af += ay * f[1];
        af += az * f[2];
        V4 q0 = m * read3(V + 3 * p) - af;
        q0[3] = m;
"""
    + ROWS
    + """
                const V4 q = q0 + (float)i * ax + (float)j * ay;
                G[row] += (wij * wz[0]) * q;
                G[row + 1] += (wij * wz[1]) * (q + az);
                G[row + 2] += (wij * wz[2]) * (q + 2.0f * az);
            }
    }
"""
)
G2P = (
    PRELUDE
    + """
    const V4* G = (const V4*)&wp::index(grid_v, e, 0);
    float *XN = (float*)&wp::index(x_new, e, 0), *VN = (float*)&wp::index(v_new, e, 0);
    float* CN = (float*)&wp::index(C_new, e, 0);
    bool left = false;
"""
    + EACH
    + """
        V4 s0 = {0.0f, 0.0f, 0.0f, 0.0f}, sx = s0, sy = s0, sz = s0;
"""
    + ROWS
    + """
                const V4 r1 = (wij * wz[1]) * G[row + 1], r2 = (wij * wz[2]) * G[row + 2];
                const V4 r = (wij * wz[0]) * G[row] + r1 + r2;
                s0 += r;
                if (i) sx += (float)i * r;
                if (j) sy += (float)j * r;
                sz += r1 + 2.0f * r2;
            }
        const float c = 4.0f * inv_dx;
        write3(VN + 3 * p, s0);
        write_columns(CN + 9 * p, c * (sx - f[0] * s0), c * (sy - f[1] * s0), c * (sz - f[2] * s0));
        for (int a = 0; a < 3; ++a) {
            XN[3 * p + a] = X[3 * p + a] + dt * s0[a];
            left |= f[a] < 0.49f || f[a] > 1.51f;
        }
    }
    if (left) wp::index(left_box, e) = 1;
"""
)
ADJOINT_P2G = (
    PRELUDE
    + """
    const float *M = &wp::index(mass, e, 0), *V = (const float*)&wp::index(v, e, 0);
    const float* AA = (const float*)&wp::index(A, e, 0);
    const V4* G = (const V4*)&wp::index(grid_m_adjoint, e, 0);
    float *XA = (float*)&wp::index(x_adjoint, e, 0), *VA = (float*)&wp::index(v_adjoint, e, 0);
    float* AAA = (float*)&wp::index(A_adjoint, e, 0);
"""
    + EACH
    + SLOPES
    + """
        const float m = M[p];
        const V4 ax = read_column(AA + 9 * p) * dx, ay = read_column(AA + 9 * p + 1) * dx;
        const V4 az = read_column(AA + 9 * p + 2) * dx;
        V4 af = ax * f[0];
        af += ay * f[1];
        af += az * f[2];
        V4 q0 = m * read3(V + 3 * p) - af;
        q0[3] = m;
        V4 h0 = {0.0f, 0.0f, 0.0f, 0.0f}, hx = h0, hy = h0, hz = h0, slope = h0;
"""
    + ROWS
    + """
                const V4 q = q0 + (float)i * ax + (float)j * ay;
                const V4 along = {dwx[i] * wy[j], wx[i] * dwy[j], wij, 0.0f};
                V4 r = {0.0f, 0.0f, 0.0f, 0.0f};
                #pragma clang loop unroll(full)
                for (int k = 0; k < 3; ++k) {
                    const V4 h = G[row + k], t = h * (k ? q + (float)k * az : q);
                    const float sigma = t[0] + t[1] + t[2] + t[3];
                    const V4 wh = (wij * wz[k]) * h;
                    r += wh;
                    if (k) hz += (float)k * wh;
                    slope += sigma * (along * V4{wz[k], wz[k], dwz[k], 0.0f});
                }
                h0 += r;
                if (i) hx += (float)i * r;
                if (j) hy += (float)j * r;
            }
        write3(VA + 3 * p, m * h0);
        write_columns(AAA + 9 * p, dx * (hx - f[0] * h0), dx * (hy - f[1] * h0), dx * (hz - f[2] * h0));
        V4 Ah = read3(AA + 9 * p) * h0[0];
        Ah += read3(AA + 9 * p + 3) * h0[1];
        Ah += read3(AA + 9 * p + 6) * h0[2];
        write3(XA + 3 * p, read3(XA + 3 * p) + inv_dx * slope - Ah);
    }
"""
)
ADJOINT_G2P = (
    PRELUDE
    + """
    const V4* G = (const V4*)&wp::index(grid_v, e, 0);
    V4* GA = (V4*)&wp::index(grid_v_adjoint, e, 0);
    const float* XN = (const float*)&wp::index(x_new_adjoint, e, 0);
    const float* VN = (const float*)&wp::index(v_new_adjoint, e, 0);
    const float* CN = (const float*)&wp::index(C_new_adjoint, e, 0);
    float* XA = (float*)&wp::index(x_adjoint, e, 0);
"""
    + EACH
    + SLOPES
    + """
        const float c = 4.0f * inv_dx;
        const V4 cx = c * read_column(CN + 9 * p), cy = c * read_column(CN + 9 * p + 1);
        const V4 cz = c * read_column(CN + 9 * p + 2);
        V4 cf = cx * f[0];
        cf += cy * f[1];
        cf += cz * f[2];
        const V4 q0 = read3(VN + 3 * p) + dt * read3(XN + 3 * p) - cf;
        V4 s0 = {0.0f, 0.0f, 0.0f, 0.0f}, slope = s0;
"""
    + ROWS
    + """
                const V4 qij = q0 + (float)i * cx + (float)j * cy;
                const V4 along = {dwx[i] * wy[j], wx[i] * dwy[j], wij, 0.0f};
                #pragma clang loop unroll(full)
                for (int k = 0; k < 3; ++k) {
                    const float w = wij * wz[k];
                    const V4 v = G[row + k], q = k ? qij + (float)k * cz : qij, t = q * v;
                    const float sigma = t[0] + t[1] + t[2];
                    s0 += w * v;
                    slope += sigma * (along * V4{wz[k], wz[k], dwz[k], 0.0f});
                    GA[row + k] += w * q;
                }
            }
        V4 Cs = c * read3(CN + 9 * p) * s0[0];
        Cs += c * read3(CN + 9 * p + 3) * s0[1];
        Cs += c * read3(CN + 9 * p + 6) * s0[2];
        write3(XA + 3 * p, read3(XN + 3 * p) + inv_dx * (slope - Cs));
    }
"""
)


def transfers_on_cpu(name: str) -> SimpleNamespace:
    """Return the transfer kernels of one precision that are quickest on a CPU."""
    kernels: SimpleNamespace = transfers_in_rows() if name == "float32" else transfers(name)
    return kernels


@cache
@no_type_check
def transfers_in_rows() -> SimpleNamespace:
    """Return the kernels `p2g, g2p, adjoint_p2g, adjoint_g2p`, each of whose threads has the row of an environment."""
    types, module = precision("float32"), "gradscape.transfers.rows"
    real, vec3, vec4, mat33 = types.real, types.vec3, types.vec4, types.mat33
    Lattice = lattice("float32")

    @wp.func_native(P2G)
    def scatter(
        e: int,
        grid: Lattice,
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        A: wp.array2d[mat33],
        grid_m: wp.array2d[vec4],
    ): ...

    @wp.func_native(G2P)
    def gather(
        e: int,
        grid: Lattice,
        dt: real,
        x: wp.array2d[vec3],
        grid_v: wp.array2d[vec4],
        x_new: wp.array2d[vec3],
        v_new: wp.array2d[vec3],
        C_new: wp.array2d[mat33],
        left_box: wp.array[wp.int32],
    ): ...

    @wp.func_native(ADJOINT_P2G)
    def gather_adjoints(
        e: int,
        grid: Lattice,
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        A: wp.array2d[mat33],
        grid_m_adjoint: wp.array2d[vec4],
        x_adjoint: wp.array2d[vec3],
        v_adjoint: wp.array2d[vec3],
        A_adjoint: wp.array2d[mat33],
    ): ...

    @wp.func_native(ADJOINT_G2P)
    def scatter_adjoints(
        e: int,
        grid: Lattice,
        dt: real,
        x: wp.array2d[vec3],
        grid_v: wp.array2d[vec4],
        x_new_adjoint: wp.array2d[vec3],
        v_new_adjoint: wp.array2d[vec3],
        C_new_adjoint: wp.array2d[mat33],
        grid_v_adjoint: wp.array2d[vec4],
        x_adjoint: wp.array2d[vec3],
    ): ...

    @wp.kernel(module=module, enable_backward=False)
    def p2g(
        lattice: Lattice,
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        A: wp.array2d[mat33],
        grid_m: wp.array2d[vec4],
    ):
        e, _ = wp.tid()
        scatter(e, lattice, mass, x, v, A, grid_m)

    @wp.kernel(module=module, enable_backward=False)
    def g2p(
        lattice: Lattice,
        dt: real,
        x: wp.array2d[vec3],
        grid_v: wp.array2d[vec4],
        x_new: wp.array2d[vec3],
        v_new: wp.array2d[vec3],
        C_new: wp.array2d[mat33],
        left_box: wp.array[wp.int32],
    ):
        e, _ = wp.tid()
        gather(e, lattice, dt, x, grid_v, x_new, v_new, C_new, left_box)

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_p2g(
        lattice: Lattice,
        mass: wp.array2d[real],
        x: wp.array2d[vec3],
        v: wp.array2d[vec3],
        A: wp.array2d[mat33],
        adj_grid_m: wp.array2d[vec4],
        adj_x: wp.array2d[vec3],
        adj_v: wp.array2d[vec3],
        adj_A: wp.array2d[mat33],
    ):
        e, _ = wp.tid()
        gather_adjoints(e, lattice, mass, x, v, A, adj_grid_m, adj_x, adj_v, adj_A)

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_g2p(
        lattice: Lattice,
        dt: real,
        x: wp.array2d[vec3],
        grid_v: wp.array2d[vec4],
        adj_x_new: wp.array2d[vec3],
        adj_v_new: wp.array2d[vec3],
        adj_C_new: wp.array2d[mat33],
        adj_grid_v: wp.array2d[vec4],
        adj_x: wp.array2d[vec3],
    ):
        e, _ = wp.tid()
        scatter_adjoints(e, lattice, dt, x, grid_v, adj_x_new, adj_v_new, adj_C_new, adj_grid_v, adj_x)

    kernels = {"p2g": p2g, "g2p": g2p, "adjoint_p2g": adjoint_p2g, "adjoint_g2p": adjoint_g2p}
    for key, kernel in kernels.items():
        take_rows(kernel, getattr(transfers("float32"), key), "x")
    return SimpleNamespace(**kernels)
