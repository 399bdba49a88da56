"""The transfers for a CPU in float32, in C++: an environment's particles eight at a time, or four numbers of one.

They have the arguments of the kernels in `transfers`, which say what each does, and give the same bits, since every sum
comes in the same order. Warp's own code for a CPU works on one number at a time.
"""

from functools import cache
from types import SimpleNamespace

from ..rows import kernel_in_rows
from .stencil_cpu import EACH, ONE_BY_ONE, ROWS, ROWS_OF_ONE, SLOPES, STENCIL
from .transfers import transfers

PRELUDE = (
    STENCIL
    + """
    const float* X = (const float*)&wp::index(x, e, 0);
    const int count = x.shape[1];
"""
)
# Each particle's weights, one node after another; then those of a row.
WEIGHTS = """
        V w[27];
        #pragma clang loop unroll(full)
        for (int n = 0; n < 27; ++n) w[n] = wx[n / 9] * wy[n / 3 % 3] * wz[n % 3];
"""
ROWS_AND_WEIGHTS = (
    ROWS_OF_ONE
    + """
                    const V* wij = w + 9 * i + 3 * j;
                    const float w0 = of_one(wij[0], l), w1 = of_one(wij[1], l), w2 = of_one(wij[2], l);
"""
)
P2G = (
    PRELUDE
    + """
    const float *M = &wp::index(mass, e, 0), *VV = (const float*)&wp::index(v, e, 0);
    const float* AA = (const float*)&wp::index(A, e, 0);
    V4* G = (V4*)&wp::index(grid_m, e, 0);
"""
    + EACH
    + WEIGHTS
    + ONE_BY_ONE
    + """
            const float fq[3] = {of_one(f[0], l), of_one(f[1], l), of_one(f[2], l)};
            const float m = M[q];
            const V4 ax = read_column(AA + 9 * q) * dx, ay = read_column(AA + 9 * q + 1) * dx;
            const V4 az = read_column(AA + 9 * q + 2) * dx;
            V4 af = ax * fq[0];
            af += ay * fq[1];
            af += az * fq[2];
            V4 m0 = m * read3(VV + 3 * q) - af;
            m0[3] = m;
"""
    + ROWS_AND_WEIGHTS
    + """
                    const V4 mij = m0 + (float)i * ax + (float)j * ay;
                    G[row] += w0 * mij;
                    G[row + 1] += w1 * (mij + az);
                    G[row + 2] += w2 * (mij + 2.0f * az);
                }
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
    Int left = {};
    const float c = 4.0f * inv_dx;
"""
    + EACH
    + WEIGHTS
    + ONE_BY_ONE
    + """
            const float fq[3] = {of_one(f[0], l), of_one(f[1], l), of_one(f[2], l)};
            V4 s0 = {0.0f, 0.0f, 0.0f, 0.0f}, sx = s0, sy = s0, sz = s0;
"""
    + ROWS_AND_WEIGHTS
    + """
                    const V4 r1 = w1 * G[row + 1], r2 = w2 * G[row + 2];
                    const V4 r = w0 * G[row] + r1 + r2;
                    s0 += r;
                    if (i) sx += (float)i * r;
                    if (j) sy += (float)j * r;
                    sz += r1 + 2.0f * r2;
                }
            write3(VN + 3 * q, s0);
            write3(XN + 3 * q, read3(X + 3 * q) + dt * s0);
            write_columns(CN + 9 * q, c * (sx - fq[0] * s0), c * (sy - fq[1] * s0), c * (sz - fq[2] * s0));
        }
        for (int a = 0; a < 3; ++a) left |= (f[a] < 0.49f) | (f[a] > 1.51f);
    }
    if (__builtin_reduce_or(left)) wp::index(left_box, e) = 1;
"""
)
ADJOINT_P2G = (
    PRELUDE
    + """
    const float *M = &wp::index(mass, e, 0), *VV = (const float*)&wp::index(v, e, 0);
    const float* AA = (const float*)&wp::index(A, e, 0);
    const V4* G = (const V4*)&wp::index(grid_m_adjoint, e, 0);
    float *XA = (float*)&wp::index(x_adjoint, e, 0), *VA = (float*)&wp::index(v_adjoint, e, 0);
    float* AAA = (float*)&wp::index(A_adjoint, e, 0);
"""
    + EACH
    + SLOPES
    + """
        const V m = read(M, 1, at);
        V a9[9], v3[3], x_adjoints[3], ax[3], ay[3], az[3], m0[3];
        read_all(AA, 9, at, a9);
        read_all(VV, 3, at, v3);
        read_all(XA, 3, at, x_adjoints);
        for (int a = 0; a < 3; ++a) {
            ax[a] = a9[3 * a] * dx;
            ay[a] = a9[3 * a + 1] * dx;
            az[a] = a9[3 * a + 2] * dx;
            V af = ax[a] * f[0];
            af += ay[a] * f[1];
            af += az[a] * f[2];
            m0[a] = m * v3[a] - af;
        }
        V h0[3] = {}, hx[3] = {}, hy[3] = {}, hz[3] = {}, slope[3] = {};
"""
    + ROWS
    + """
                const V along[3] = {dwx[i] * wy[j], wx[i] * dwy[j], wij};
                V mij[3], r[3] = {};
                for (int a = 0; a < 3; ++a) mij[a] = m0[a] + (float)i * ax[a] + (float)j * ay[a];
                #pragma clang loop unroll(full)
                for (int k = 0; k < 3; ++k) {
                    V h[4], t[3];
                    gather(G, corner, row + k, h);
                    const V w = wij * wz[k];
                    for (int a = 0; a < 3; ++a) {
                        t[a] = h[a] * (k ? mij[a] + (float)k * az[a] : mij[a]);
                        const V wh = w * h[a];
                        r[a] += wh;
                        if (k) hz[a] += (float)k * wh;
                    }
                    const V sigma = t[0] + t[1] + t[2] + h[3] * m;
                    for (int a = 0; a < 3; ++a) slope[a] += sigma * (along[a] * (a == 2 ? dwz[k] : wz[k]));
                }
                for (int a = 0; a < 3; ++a) {
                    h0[a] += r[a];
                    if (i) hx[a] += (float)i * r[a];
                    if (j) hy[a] += (float)j * r[a];
                }
            }
        for (int a = 0; a < 3; ++a) {
            write(VA + a, 3, p, some, m * h0[a]);
            write(AAA + 3 * a, 9, p, some, dx * (hx[a] - f[0] * h0[a]));
            write(AAA + 3 * a + 1, 9, p, some, dx * (hy[a] - f[1] * h0[a]));
            write(AAA + 3 * a + 2, 9, p, some, dx * (hz[a] - f[2] * h0[a]));
            V Ah = a9[a] * h0[0];
            Ah += a9[3 + a] * h0[1];
            Ah += a9[6 + a] * h0[2];
            write(XA + a, 3, p, some, x_adjoints[a] + inv_dx * slope[a] - Ah);
        }
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
    const float c = 4.0f * inv_dx;
"""
    + EACH
    + SLOPES
    + """
        V c9[9], xn[3], vn[3], cx[3], cy[3], cz[3], q0[3];
        read_all(CN, 9, at, c9);
        read_all(XN, 3, at, xn);
        read_all(VN, 3, at, vn);
        for (int a = 0; a < 9; ++a) c9[a] = c * c9[a];
        for (int a = 0; a < 3; ++a) {
            cx[a] = c9[3 * a];
            cy[a] = c9[3 * a + 1];
            cz[a] = c9[3 * a + 2];
            V cf = cx[a] * f[0];
            cf += cy[a] * f[1];
            cf += cz[a] * f[2];
            q0[a] = vn[a] + dt * xn[a] - cf;
        }
        V s0[3] = {}, slope[3] = {};
        V given[27][4];
"""
    + ROWS
    + """
                const V along[3] = {dwx[i] * wy[j], wx[i] * dwy[j], wij};
                V qij[3];
                for (int a = 0; a < 3; ++a) qij[a] = q0[a] + (float)i * cx[a] + (float)j * cy[a];
                #pragma clang loop unroll(full)
                for (int k = 0; k < 3; ++k) {
                    V v[4], t[3], q[3];
                    const V w = wij * wz[k];
                    gather(G, corner, row + k, v);
                    for (int a = 0; a < 3; ++a) {
                        q[a] = k ? qij[a] + (float)k * cz[a] : qij[a];
                        t[a] = q[a] * v[a];
                        s0[a] += w * v[a];
                    }
                    deal(w * q[0], w * q[1], w * q[2], given[9 * i + 3 * j + k]);
                    const V sigma = t[0] + t[1] + t[2];
                    for (int a = 0; a < 3; ++a) slope[a] += sigma * (along[a] * (a == 2 ? dwz[k] : wz[k]));
                }
            }
        for (int a = 0; a < 3; ++a) {
            V Cs = c9[a] * s0[0];
            Cs += c9[3 + a] * s0[1];
            Cs += c9[6 + a] * s0[2];
            write(XA + a, 3, p, some, xn[a] + inv_dx * (slope[a] - Cs));
        }
"""
    + ONE_BY_ONE
    + ROWS_OF_ONE
    + """
                    for (int k = 0; k < 3; ++k) GA[row + k] += dealt(given[9 * i + 3 * j + k], l);
                }
        }
    }
"""
)


def transfers_on_cpu(name: str) -> SimpleNamespace:
    """Return the transfer kernels of one precision that are quickest on a CPU."""
    kernels: SimpleNamespace = transfers_in_rows() if name == "float32" else transfers(name)
    return kernels


@cache
def transfers_in_rows() -> SimpleNamespace:
    """Return the kernels `p2g, g2p, adjoint_p2g, adjoint_g2p`, each of whose threads has the row of an environment."""
    plain = transfers("float32")
    texts = {"p2g": P2G, "g2p": G2P, "adjoint_p2g": ADJOINT_P2G, "adjoint_g2p": ADJOINT_G2P}
    module = "gradscape.transfers.rows"
    return SimpleNamespace(
        **{key: kernel_in_rows(getattr(plain, key), text, "x", module) for key, text in texts.items()}
    )
