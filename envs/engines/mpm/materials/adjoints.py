"""The adjoint kernels of a material, made of what it does with the adjoint of A of a particle: `turn_back`.

Alone, a kernel reads that from memory; on a GPU it follows on what particles gather of the adjoints of g2p and p2g, in
one kernel, and needs no memory.
`turn_back` takes what both take, but the matrix `adj_a` in the place of the array `adj_A`, and the environment and the
particle last.
"""

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType
from typing import Any

import warp as wp

from ...launches import blocks
from ...rows import with_arguments
from ...runtime import precision
from ..gathers import adjoint_gatherers
from ..layout import layout


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
    """Return the kernel that gathers a particle's adjoints of g2p and p2g first.

    It takes A, unless `affine_momentum` computes it again, the lattice, x, v, adj_grid_m, adj_x, adj_v, grid_v, and the
    adjoints of the new x, v and C, and then what the other does, but for adj_A. So many blocks as `count` are to find
    registers at once.
    """
    gather, read_matrix, found = adjoint_gatherers(name), layout(name).read_matrix, blocks(name, count)
    adjoint_g2p, adjoint_p2g = gather.g2p, gather.p2g
    given = {"momentum": "read_matrix(A, e, first + p)", "adj_x_moved": _call("adjoint_g2p", adjoint_g2p, "first + p")}
    mat33 = precision(name).mat33
    kept = {"A": wp.array2d[mat33]}
    if affine_momentum:
        given["momentum"], kept = _call("affine_momentum", affine_momentum, "p"), {}
    own = {key: kind for key, kind in _taken(turn_back).items() if key != "adj_a"}
    others = kept | _taken(adjoint_p2g) | _taken(adjoint_g2p)
    kinds = {key: kind for key, kind in others.items() if key not in own | given} | own

    def kernel() -> Any:
        return adjoint_g2p, adjoint_p2g, turn_back, affine_momentum, read_matrix  # which Warp finds by their names

    bounds = {"grid_stride": False} | ({"launch_bounds": found} if found else {})
    adj_a = _call("adjoint_p2g", adjoint_p2g, "first + p", given)
    return _kernel(kernel, kinds, adj_a, turn_back, called="_after_p2g", module=".columns", **bounds)


def _call(name: str, function: Any, particle: str, given: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return the call of a function for a particle, with its arguments' names where nothing else is `given` for one."""
    return f"{name}({', '.join(given.get(key, key) for key in _taken(function))}, e, {particle})"


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
