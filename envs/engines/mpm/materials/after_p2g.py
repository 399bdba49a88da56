"""The adjoint of a material that follows on that of p2g in one kernel, for a GPU, where A's adjoint needs no memory."""

from functools import cache
from typing import Any

import warp as wp

from ...launches import blocks
from ...rows import with_arguments
from ..gathers import adjoint_gatherer

GATHERED = "lattice, mass, x, v, A, adj_grid_m, adj_x, adj_v"


@cache
def after_p2g(name: str, adjoint: Any, turn_back: Any, count: int) -> Any:
    """Return the kernel that gathers a particle's adjoints of p2g, and goes on as a material's `adjoint` does.

    It takes the lattice, x, v, A, adj_grid_m, adj_x and adj_v, and then what `adjoint` takes, but for adj_A. So many
    blocks as `count` are to find registers at once.
    """
    gather_back = adjoint_gatherer(name)
    gathered = dict(zip(GATHERED.split(", "), gather_back.input_types.values(), strict=False))
    own = {key: kind for key, kind in adjoint.adj.arg_types.items() if key != "adj_A"}
    kinds = {key: kind for key, kind in gathered.items() if key not in own} | own
    passed = ", ".join("adj_a" if key == "adj_A" else key for key in adjoint.adj.arg_types)

    found = blocks(name, count)

    def kernel() -> Any:
        return gather_back, turn_back  # which Warp finds here by their names

    return wp.Kernel(
        with_arguments(kernel, kinds),
        key=f"{adjoint.key}_after_p2g",
        module=wp.get_module(f"{adjoint.module.name}.columns"),
        options={"enable_backward": False, "grid_stride": False} | ({"launch_bounds": found} if found else {}),
        source=f"def kernel({', '.join(kinds)}):\n    e, p = wp.tid()\n"
        f"    adj_a = gather_back({GATHERED}, e, first + p)\n    turn_back({passed}, e, p)\n",
    )
