"""The kernels of `smoothing` for a CPU in float32, in C++: eight particles or three nodes at a time, the same bits."""

from functools import cache
from types import SimpleNamespace

from ..rows import kernel_in_rows
from .smoothing_kernels import smoothing_kernels
from .stencil_cpu import EACH, ONE_BY_ONE, ROWS_OF_ONE, SLOPES, STENCIL

# Three nodes of a row at a time: what lies behind the third is read and written as it was.
PRELUDE = (
    STENCIL
    + """
    const float* X = (const float*)&wp::index(x, e, first);
    auto inverse = [](V4 w) { return w > 0.0f ? 1.0f / w : V4{0.0f, 0.0f, 0.0f, 0.0f}; };
    auto at_row = [](const float* a, int row) { return *(const V4*)(a + row); };
    auto add_row = [](float* a, int row, V4 v) {
        V4 sum = *(V4*)(a + row) + v;
        sum[3] = a[row + 3];
        *(V4*)(a + row) = sum;
    };
    float *AMOUNT = &wp::index(amount, e, 0), *WEIGHT = &wp::index(weight, e, 0);
"""
)
RATIOS = """
    const float* JJ = &wp::index(J, e, 0);
    const int count = J.shape[1];
"""
DEAL = """
        V wz4[4];
        deal(wz[0], wz[1], wz[2], wz4);
        V wij[9];
        #pragma clang loop unroll(full)
        for (int n = 0; n < 9; ++n) wij[n] = wx[n / 3] * wy[n % 3];
"""
DEAL_SLOPES = """
        V along_x[3][4], along_y[3][4], along_z[3][4];
        #pragma clang loop unroll(full)
        for (int i = 0; i < 3; ++i) {
            deal(dwx[i], wx[i], wx[i], along_x[i]);
            deal(wy[i], dwy[i], wy[i], along_y[i]);
            deal(wz[i], wz[i], dwz[i], along_z[i]);
        }
"""
ROWS = (
    ROWS_OF_ONE
    + """
                    const V4 w = of_one(wij[3 * i + j], l) * dealt(wz4, l);
"""
)
SPREAD = (
    PRELUDE
    + RATIOS
    + """
    const float* VOLUME = &wp::index(volume, e, first);
"""
    + EACH
    + DEAL
    + """
        const V beyond = logarithm(read(JJ, 1, at)) - slope * x3[1];
"""
    + ONE_BY_ONE
    + """
            const float volume = VOLUME[q], excess = of_one(beyond, l);
"""
    + ROWS
    + """
                    add_row(AMOUNT, row, w * volume * excess);
                    add_row(WEIGHT, row, w * volume);
                }
        }
    }
"""
)
COLLECT = (
    PRELUDE
    + RATIOS
    + """
    float* JN = &wp::index(J_new, e, 0);
"""
    + EACH
    + DEAL
    + """
        V mean;
"""
    + ONE_BY_ONE
    + """
            float sum = 0.0f;
"""
    + ROWS
    + """
                    const V4 part = w * at_row(AMOUNT, row) * inverse(at_row(WEIGHT, row));
                    for (int k = 0; k < 3; ++k) sum += part[k];
                }
            ((float*)&mean)[l] = sum;
        }
        const V here = logarithm(read(JJ, 1, at));
        write(JN, 1, p, some, exponential(here + share * (mean - (here - slope * x3[1]))));
    }
"""
)
ADJOINT_COLLECT = (
    PRELUDE
    + """
    const float* JN = &wp::index(J_new, e, 0);
    const int count = J_new.shape[1];
    float *MEAN = &wp::index(mean_adjoint, e, 0), *JA = &wp::index(J_adjoint, e, 0);
    float* XA = (float*)&wp::index(x_adjoint, e, first);
"""
    + EACH
    + SLOPES
    + DEAL
    + DEAL_SLOPES
    + ONE_BY_ONE
    + """
            const float g = JA[q] * JN[q];
            V4 steep = {0.0f, 0.0f, 0.0f, 0.0f};
"""
    + ROWS
    + """
                    const V4 along = dealt(along_x[i], l) * dealt(along_y[j], l);
                    const V4 mean = at_row(AMOUNT, row) * inverse(at_row(WEIGHT, row));
                    for (int k = 0; k < 3; ++k) steep += mean[k] * (along * dealt(along_z[k], l));
                    add_row(MEAN, row, w * share * g);
                }
            write3(XA + 3 * q, read3(XA + 3 * q) + (share * g * inv_dx) * steep);
            JA[q] = g;
        }
    }
"""
)
ADJOINT_SPREAD = (
    PRELUDE
    + RATIOS
    + """
    float *MEAN = &wp::index(mean_adjoint, e, 0), *VOLUME = &wp::index(volume, e, first);
    float *JA = &wp::index(J_adjoint, e, 0), *XA = (float*)&wp::index(x_adjoint, e, first);
"""
    + EACH
    + SLOPES
    + DEAL
    + DEAL_SLOPES
    + """
        const V beyond = logarithm(read(JJ, 1, at)) - slope * x3[1];
"""
    + ONE_BY_ONE
    + """
            const float excess = of_one(beyond, l), volume = VOLUME[q];
            float here = 0.0f;
            V4 steep = {0.0f, 0.0f, 0.0f, 0.0f};
"""
    + ROWS
    + """
                    const V4 along = dealt(along_x[i], l) * dealt(along_y[j], l), part = inverse(at_row(WEIGHT, row));
                    const V4 a = at_row(MEAN, row) * part, off = a * (excess - at_row(AMOUNT, row) * part), wa = w * a;
                    for (int k = 0; k < 3; ++k) {
                        here += wa[k];
                        steep += off[k] * (along * dealt(along_z[k], l));
                    }
                }
            const float g = JA[q];
            here = volume * here - share * g;
            const V4 lift = {0.0f, slope * here, 0.0f, 0.0f};
            write3(XA + 3 * q, read3(XA + 3 * q) + (volume * inv_dx) * steep - lift);
            JA[q] = (g + here) / JJ[q];
        }
    }
"""
)


@cache
def smoothing_in_rows() -> SimpleNamespace:
    """Return the kernels `clear, spread, collect, adjoint_collect, adjoint_spread`, all but the first in rows."""
    plain, module = smoothing_kernels("float32"), "gradscape.smoothing.rows"
    return SimpleNamespace(
        clear=plain.clear,
        spread=kernel_in_rows(plain.spread, SPREAD, "J", module),
        collect=kernel_in_rows(plain.collect, COLLECT, "J", module),
        adjoint_collect=kernel_in_rows(plain.adjoint_collect, ADJOINT_COLLECT, "J_new", module),
        adjoint_spread=kernel_in_rows(plain.adjoint_spread, ADJOINT_SPREAD, "J", module),
    )


def smoothing_on_cpu(name: str) -> SimpleNamespace:
    """Return the smoothing kernels of one precision that are quickest on a CPU."""
    kernels: SimpleNamespace = smoothing_in_rows() if name == "float32" else smoothing_kernels(name)
    return kernels
