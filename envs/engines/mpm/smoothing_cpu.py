"""The kernels of `smoothing` for a CPU in float32, in C++: a body's particles one after another, and the same bits."""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import warp as wp

from ..runtime import precision, take_rows
from .smoothing_kernels import smoothing_kernels
from .stencil import lattice
from .transfers_cpu import EACH, ROWS, SLOPES, STENCIL

PRELUDE = (
    STENCIL
    + """
    const float *X = (const float*)&wp::index(x, e, first), *JJ = &wp::index(J, e, 0);
    const int count = J.shape[1];
    auto inverse = [](float w) { return w > 0.0f ? 1.0f / w : 0.0f; };
"""
)
SPREAD = (
    PRELUDE
    + """
    const float* VOLUME = &wp::index(volume, e, first);
    float *AMOUNT = &wp::index(amount, e, 0), *WEIGHT = &wp::index(weight, e, 0);
"""
    + EACH
    + """
        const float beyond = ::logf(JJ[p]) - slope * X[3 * p + 1];
"""
    + ROWS
    + """
                for (int k = 0; k < 3; ++k) {
                    const float w = wij * wz[k] * VOLUME[p];
                    AMOUNT[row + k] += w * beyond;
                    WEIGHT[row + k] += w;
                }
            }
    }
"""
)
COLLECT = (
    PRELUDE
    + """
    const float *AMOUNT = &wp::index(amount, e, 0), *WEIGHT = &wp::index(weight, e, 0);
    float* JN = &wp::index(J_new, e, 0);
"""
    + EACH
    + """
        float mean = 0.0f;
"""
    + ROWS
    + """
                for (int k = 0; k < 3; ++k) mean += wij * wz[k] * AMOUNT[row + k] * inverse(WEIGHT[row + k]);
            }
        const float here = ::logf(JJ[p]);
        JN[p] = ::expf(here + share * (mean - (here - slope * X[3 * p + 1])));
    }
"""
)
ADJOINT_COLLECT = (
    PRELUDE
    + """
    const float *AMOUNT = &wp::index(amount, e, 0), *WEIGHT = &wp::index(weight, e, 0);
    float *MEAN = &wp::index(mean_adjoint, e, 0), *JA = &wp::index(J_adjoint, e, 0);
    float* XA = (float*)&wp::index(x_adjoint, e, first);
"""
    + EACH
    + SLOPES
    + """
        const float g = JA[p] * JJ[p];
        V4 steep = {0.0f, 0.0f, 0.0f, 0.0f};
"""
    + ROWS
    + """
                const V4 along = {dwx[i] * wy[j], wx[i] * dwy[j], wij, 0.0f};
                for (int k = 0; k < 3; ++k) {
                    const float mean = AMOUNT[row + k] * inverse(WEIGHT[row + k]);
                    steep += mean * (along * V4{wz[k], wz[k], dwz[k], 0.0f});
                    MEAN[row + k] += wij * wz[k] * share * g;
                }
            }
        write3(XA + 3 * p, read3(XA + 3 * p) + (share * g * inv_dx) * steep);
        JA[p] = g;
    }
"""
)
ADJOINT_SPREAD = (
    PRELUDE
    + """
    const float *AMOUNT = &wp::index(amount, e, 0), *WEIGHT = &wp::index(weight, e, 0);
    const float *MEAN = &wp::index(mean_adjoint, e, 0), *VOLUME = &wp::index(volume, e, first);
    float *JA = &wp::index(J_adjoint, e, 0), *XA = (float*)&wp::index(x_adjoint, e, first);
"""
    + EACH
    + SLOPES
    + """
        const float beyond = ::logf(JJ[p]) - slope * X[3 * p + 1];
        float here = 0.0f;
        V4 steep = {0.0f, 0.0f, 0.0f, 0.0f};
"""
    + ROWS
    + """
                const V4 along = {dwx[i] * wy[j], wx[i] * dwy[j], wij, 0.0f};
                for (int k = 0; k < 3; ++k) {
                    const float part = inverse(WEIGHT[row + k]), a = MEAN[row + k] * part;
                    const float off = a * (beyond - AMOUNT[row + k] * part);
                    here += wij * wz[k] * a;
                    steep += off * (along * V4{wz[k], wz[k], dwz[k], 0.0f});
                }
            }
        const float g = JA[p];
        here = VOLUME[p] * here - share * g;
        const V4 lift = {0.0f, slope * here, 0.0f, 0.0f};
        write3(XA + 3 * p, read3(XA + 3 * p) + (VOLUME[p] * inv_dx) * steep - lift);
        JA[p] = (g + here) / JJ[p];
    }
"""
)


@cache
@no_type_check
def smoothing_in_rows() -> SimpleNamespace:
    """Return the kernels `clear, spread, collect, adjoint_collect, adjoint_spread`, all but the first in rows."""
    types, module = precision("float32"), "gradscape.smoothing.rows"
    real, vec3 = types.real, types.vec3
    Lattice = lattice("float32")

    @wp.func_native(SPREAD)
    def spread_row(
        e: int,
        grid: Lattice,
        first: int,
        slope: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
    ): ...

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        lattice: Lattice,
        first: int,
        slope: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
    ):
        e, _ = wp.tid()
        spread_row(e, lattice, first, slope, volume, x, J, amount, weight)

    @wp.func_native(COLLECT)
    def collect_row(
        e: int,
        grid: Lattice,
        first: int,
        slope: real,
        share: real,
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        J_new: wp.array2d[real],
    ): ...

    @wp.kernel(module=module, enable_backward=False)
    def collect(
        lattice: Lattice,
        first: int,
        slope: real,
        share: real,
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        J_new: wp.array2d[real],
    ):
        e, _ = wp.tid()
        collect_row(e, lattice, first, slope, share, x, J, amount, weight, J_new)

    @wp.func_native(ADJOINT_COLLECT)
    def adjoint_collect_row(
        e: int,
        grid: Lattice,
        first: int,
        share: real,
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        J_adjoint: wp.array2d[real],
        x_adjoint: wp.array2d[vec3],
        mean_adjoint: wp.array2d[real],
    ): ...

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_collect(
        lattice: Lattice,
        first: int,
        share: real,
        x: wp.array2d[vec3],
        J_new: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        adj_J: wp.array2d[real],
        adj_x: wp.array2d[vec3],
        adj_mean: wp.array2d[real],
    ):
        e, _ = wp.tid()
        adjoint_collect_row(e, lattice, first, share, x, J_new, amount, weight, adj_J, adj_x, adj_mean)

    @wp.func_native(ADJOINT_SPREAD)
    def adjoint_spread_row(
        e: int,
        grid: Lattice,
        first: int,
        slope: real,
        share: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        mean_adjoint: wp.array2d[real],
        J_adjoint: wp.array2d[real],
        x_adjoint: wp.array2d[vec3],
    ): ...

    @wp.kernel(module=module, enable_backward=False)
    def adjoint_spread(
        lattice: Lattice,
        first: int,
        slope: real,
        share: real,
        volume: wp.array2d[real],
        x: wp.array2d[vec3],
        J: wp.array2d[real],
        amount: wp.array2d[real],
        weight: wp.array2d[real],
        adj_mean: wp.array2d[real],
        adj_J: wp.array2d[real],
        adj_x: wp.array2d[vec3],
    ):
        e, _ = wp.tid()
        adjoint_spread_row(e, lattice, first, slope, share, volume, x, J, amount, weight, adj_mean, adj_J, adj_x)

    kernels = {
        "spread": spread,
        "collect": collect,
        "adjoint_collect": adjoint_collect,
        "adjoint_spread": adjoint_spread,
    }
    plain = smoothing_kernels("float32")
    for key, kernel in kernels.items():
        take_rows(kernel, getattr(plain, key), "J_new" if key == "adjoint_collect" else "J")
    return SimpleNamespace(**kernels, clear=plain.clear)


def smoothing_on_cpu(name: str) -> SimpleNamespace:
    """Return the smoothing kernels of one precision that are quickest on a CPU."""
    kernels: SimpleNamespace = smoothing_in_rows() if name == "float32" else smoothing_kernels(name)
    return kernels
