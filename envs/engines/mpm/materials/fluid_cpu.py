"""The kernels of `fluid` for a CPU in float32, in C++: eight particles at a time, and the same bits.

Logarithms and exponentials are those of the C library, one by one, since others would round otherwise.
"""

from functools import cache
from typing import Any

from ...rows import kernel_in_rows
from ..eight_cpu import EIGHT, GROUPS
from .fluid import TORN, kernels

# Expressions are those of `fluid` and of Warp's matrices, in their order.
EACH = (
    EIGHT
    + f"""
    const float torn = {TORN}f, third = 2.0f / 3.0f;
"""
    + """
    auto trace = [](const V* a) { return a[0] + a[4] + a[8]; };
    auto shear = [&](const V* C, V* out) {
        const V mean = third * trace(C), none = mean * 0.0f;
        for (int k = 0; k < 9; ++k) out[k] = C[k] + C[k % 3 * 3 + k / 3] - (k % 4 ? none : mean);
    };
    const float *M = &wp::index(mass, e, first), *VOLUME = &wp::index(volume, e, first), *JJ = &wp::index(J, e, 0);
    const float* CC = (const float*)&wp::index(C, e, first);
    const int count = J.shape[1];
"""
    + GROUPS
    + """
        V c[9], s[9];
        read_all(CC, 9, at, c);
        shear(c, s);
        const V m = read(M, 1, at), weight = scale * read(VOLUME, 1, at);
        const V growth = exponential(dt * trace(c)), grown = growth * read(JJ, 1, at);
        const V j = grown <= torn ? grown : V{} + torn;
"""
)
UPDATE = (
    EACH
    + """
        const V pressure = bulk * logarithm(j), none = pressure * 0.0f, stiff = j * viscosity;
        write(&wp::index(J_new, e, 0), 1, p, some, j);
        float* AA = (float*)&wp::index(A, e, first);
        for (int k = 0; k < 9; ++k) c[k] = ((k % 4 ? none : pressure) + s[k] * stiff) * weight + c[k] * m;
        write_all(AA, 9, p, some, c);
    }
"""
)
ADJOINT = (
    EACH
    + """
        const float *JN = &wp::index(J_new_adjoint, e, 0), *AA = (const float*)&wp::index(A_adjoint, e, first);
        V a[9], g[9], t[9], work = {};
        read_all(AA, 9, at, a);
        for (int k = 0; k < 9; ++k) {
            g[k] = a[k] * weight;
            work = __builtin_elementwise_fma(g[k], s[k], work);
        }
        V adj_j = read(JN, 1, at) + bulk * trace(g) / j + viscosity * work;
        adj_j = grown > torn ? V{} : adj_j;
        write(&wp::index(J_adjoint, e, 0), 1, p, some, growth * adj_j);
        shear(g, t);
        const V dilation = dt * j * adj_j, none = dilation * 0.0f, stiff = j * viscosity;
        float* CA = (float*)&wp::index(C_adjoint, e, first);
        for (int k = 0; k < 9; ++k) a[k] = a[k] * m + t[k] * stiff + (k % 4 ? none : dilation);
        write_all(CA, 9, p, some, a);
    }
"""
)


@cache
def kernels_in_rows() -> tuple[Any, Any]:
    """Return (update, adjoint), each of whose threads has the row of an environment."""
    (update, adjoint, *_), module = kernels("float32"), "gradscape.fluid.rows"
    return kernel_in_rows(update, UPDATE, "J", module), kernel_in_rows(adjoint, ADJOINT, "J", module)
