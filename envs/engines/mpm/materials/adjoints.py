"""The adjoint kernels of a material, made of what it does with the adjoint of A of a particle: `turn_back`.

Alone, a kernel reads that from memory; on a GPU it follows on the adjoint of p2g in one kernel, and needs no memory.
`turn_back` takes what both take, but the matrix `adj_a` in the place of the array `adj_A`, and the environment and the
particle last.
"""

from collections.abc import Mapping
from functools import cache
from typing import Any

import warp as wp

from ...launches import blocks
from ...rows import with_arguments
from ...runtime import precision
from ..gathers import adjoint_gatherer
from ..layout import layout

GATHERED = "lattice, mass, x, v, a, adj_grid_m, adj_x, adj_v"


@cache
def alone(name: str, turn_back: Any) -> Any:
    """Return the kernel that reads `adj_A`."""
    read_matrix, mat33 = layout(name).read_matrix, precision(name).mat33
    kinds = {"adj_A" if key == "adj_a" else key: kind for key, kind in _taken(turn_back).items()}
    kinds["adj_A"] = wp.array2d[mat33]

    def kernel() -> Any:
        return read_matrix, turn_back  # which Warp finds here by their names

    return _kernel(kernel, kinds, "read_matrix(adj_A, e, first + p)", turn_back)


@cache
def after_p2g(name: str, turn_back: Any, affine_momentum: Any | None, count: int) -> Any:
    """Return the kernel that gathers a particle's adjoints of p2g first.

    It takes A, unless `affine_momentum` computes it again, the lattice, x, v, adj_grid_m, adj_x and adj_v, and then
    what the other does, but for adj_A. So many blocks as `count` are to find registers at once.
    """
    gather_back, read_matrix, found = adjoint_gatherer(name), layout(name).read_matrix, blocks(name, count)
    mat33 = precision(name).mat33
    gathered = dict(zip(GATHERED.split(", "), gather_back.input_types.values(), strict=False))
    del gathered["a"]
    own = {key: kind for key, kind in _taken(turn_back).items() if key != "adj_a"}
    a, kept = "read_matrix(A, e, first + p)", {"A": wp.array2d[mat33]}
    if affine_momentum:
        a, kept = f"affine_momentum({', '.join(_taken(affine_momentum))}, e, p)", {}
    kinds = {key: kind for key, kind in (kept | gathered).items() if key not in own} | own

    def kernel() -> Any:
        return gather_back, turn_back, affine_momentum, read_matrix  # which Warp finds here by their names

    bounds = {"grid_stride": False} | ({"launch_bounds": found} if found else {})
    adj_a = f"gather_back({GATHERED.replace(' a,', f' {a},')}, e, first + p)"
    return _kernel(kernel, kinds, adj_a, turn_back, called="_after_p2g", module=".columns", **bounds)


def _taken(function: Any) -> dict[str, Any]:
    """Return the arguments of a function and their kinds, but for the environment and the particle."""
    return dict(list(function.input_types.items())[:-2])


def _kernel(
    function: Any,
    kinds: Mapping[str, Any],
    adj_a: str,
    turn_back: Any,
    *,
    called: str = "",
    module: str = "",
    **options: Any,
) -> Any:
    """Return the kernel that goes on from `adj_a`; the function holds what Warp finds by its name."""
    return wp.Kernel(
        with_arguments(function, kinds),
        key=f"kernels__locals__adjoint{called}",
        module=wp.get_module(f"{turn_back.module.name}{module}"),
        options={"enable_backward": False} | options,
        source=f"def kernel({', '.join(kinds)}):\n    e, p = wp.tid()\n    adj_a = {adj_a}\n"
        f"    turn_back({', '.join(_taken(turn_back))}, e, p)\n",
    )
