"""The adjoint kernels of a material, made of what it does with the adjoint of A of a particle: `turn_back`.

Alone, a kernel reads that from memory; on a GPU it follows on what particles gather of the adjoints of g2p and p2g, in
one kernel, and needs no memory.
`turn_back` takes what both take, but the matrix `adj_a` instead of the array `adj_A`, the particle's `strain` if
the material knows one, and the environment and the particle last.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple, no_type_check

import warp as wp

from ... import cpp
from ...launches import blocks
from ...runtime import precision
from ..stencil import adjoint_gatherers, layout


@cache
@no_type_check
def law_struct(name: str, *constants: str) -> Any:
    """Return the struct of a material's constants, the time step, stress's `scale` in A, and the first particle."""
    kinds = {"first": int} | dict.fromkeys(("dt", "scale", *constants), precision(name).real)
    made = type("_".join(["Law", *constants]), (), {"__annotations__": kinds, "__module__": __name__})
    return wp.struct(made, module=f"gradscape.laws.{name}")


class MaterialKernels(NamedTuple):
    """What a material does: the kernel `update`, and the functions that make up its adjoint.

    `turn_back` makes of a particle's adjoint of A those of its state and C; `affine_momentum` computes A again;
    `strain` is what these two would both compute, if that is slow.
    """

    update: Any
    turn_back: Any
    affine_momentum: Any
    strain: Any | None = None


@cache
def alone(name: str, material: MaterialKernels) -> Any:
    """Return the kernel that reads `adj_A`."""
    turn_back, strain = material.turn_back, material.strain
    read_matrix, mat33 = layout(name).read_matrix, precision(name).mat33
    kinds = {"adj_A" if key == "adj_a" else key: kind for key, kind in _taken(turn_back).items()}
    kinds["adj_A"] = wp.array2d[mat33]

    def kernel() -> Any:
        return read_matrix, turn_back, strain  # which Warp finds here by their names

    lines = ["adj_a = read_matrix(adj_A, e, law.first + p)", *_known(strain), _call("turn_back", turn_back, "p")]
    return _kernel(kernel, kinds, lines, turn_back)


@cache
def after_p2g(name: str, material: MaterialKernels, count: int) -> Any:
    """Return the kernel that gathers a particle's adjoints of g2p and p2g first.

    It takes the lattice, x, v, adj_grid_m, adj_v, grid_v, the adjoints of the new x, v and C, adj_x, and then what the
    other does, but for adj_A. So many blocks as `count` are to find registers at once.
    """
    gather, found = adjoint_gatherers(name), blocks(name, count)
    adjoint_g2p, adjoint_p2g = gather.g2p, gather.p2g
    turn_back, affine_momentum, strain = material.turn_back, material.affine_momentum, material.strain
    vec3 = precision(name).vec3
    own = {key: kind for key, kind in _taken(turn_back).items() if key != "adj_a"}
    others = _taken(adjoint_p2g) | _taken(adjoint_g2p) | {"adj_x": wp.array2d[vec3]}
    kinds = {key: kind for key, kind in others.items() if key not in {*own, "momentum", "dt"}} | own

    def kernel() -> Any:
        return adjoint_g2p, adjoint_p2g, turn_back, affine_momentum, strain  # which Warp finds by their names

    bounds = {"grid_stride": False} | ({"launch_bounds": found} if found else {})
    lines = [
        *_known(strain),
        f"momentum = {_call('affine_momentum', affine_momentum, 'p')}",
        f"adj_a, adj_x_at_nodes = {_call('adjoint_p2g', adjoint_p2g, 'law.first + p')}",
        _call("turn_back", turn_back, "p"),
        f"adj_x[e, law.first + p] = {_call('adjoint_g2p', adjoint_g2p, 'law.first + p')} + adj_x_at_nodes",
    ]
    return _kernel(kernel, kinds, lines, turn_back, called="_after_p2g", module=".columns", **bounds)


def _call(name: str, function: Any, particle: str) -> str:
    """Return the call of a function for a particle, with what has its arguments' names."""
    given = ["law.dt" if key == "dt" else key for key in list(function.input_types)[:-2]]
    return f"{name}({', '.join(given)}, e, {particle})"


def _known(strain: Any | None) -> list[str]:
    """Return the line that finds out a particle's strain, if there is a function for it."""
    return [f"strain = {_call('strain', strain, 'p')}"] if strain else []


def _taken(function: Any) -> dict[str, Any]:
    """Return the arguments of a function that a kernel takes, and their kinds."""
    return {key: kind for key, kind in list(function.input_types.items())[:-2] if key != "strain"}


def _kernel(
    function: Any,
    kinds: Mapping[str, Any],
    lines: Sequence[str],
    turn_back: Any,
    *,
    called: str = "",
    module: str = "",
    **options: Any,
) -> Any:
    """Return the kernel of these lines in the module of `turn_back`; the function holds what Warp finds by its name."""
    return wp.Kernel(
        cpp.with_arguments(function, kinds),
        key=f"kernels__locals__adjoint{called}",
        module=wp.get_module(cpp.module(f"{turn_back.module.name}{module}")),
        options={"enable_backward": False} | options,
        source="\n    ".join([f"def kernel({', '.join(kinds)}):", "e, p = wp.tid()", *lines]) + "\n",
    )
