"""The transfers for a CPU in float32, in C++: an environment's particles eight at a time, or four numbers of one.

They have the arguments of the kernels in `transfers`, which say what each does, and give the same bits, since every sum
comes in the same order. Warp's own code for a CPU works on one number at a time.
"""

from functools import cache
from types import SimpleNamespace

from ..rows import kernel_in_rows
from .transfers import transfers


def transfers_on_cpu(name: str) -> SimpleNamespace:
    """Return the transfer kernels of one precision that are quickest on a CPU."""
    kernels: SimpleNamespace = transfers_in_rows() if name == "float32" else transfers(name)
    return kernels


@cache
def transfers_in_rows(name: str = "float32") -> SimpleNamespace:
    """Return the kernels `p2g, g2p, adjoint_p2g, adjoint_g2p`, each of whose threads has the row of an environment."""
    plain, module = vars(transfers(name)), f"gradscape.transfers.{name}.rows"
    return SimpleNamespace(**{key: kernel_in_rows(kernel, key, "x", module) for key, kernel in plain.items()})
