"""The kernels of a material, made of its functions of one particle (`Response`).

The adjoint alone reads that of A from memory. On a GPU it follows on what particles gather of the adjoints of g2p and
p2g, in one kernel, and needs no memory.
"""

from functools import cache, partial
from types import SimpleNamespace
from typing import Any, NamedTuple, no_type_check

import warp as wp

from ... import cpp
from ...launches import blocks
from ...runtime import Ints, precision
from ..stencil import adjoint_gatherers, lattice, layout, particles


@cache
@no_type_check
def law_struct(name: str, *constants: str) -> Any:
    """Return the struct of what a group's kernels share.

    It has the material's constants, the time step, stress's `scale` in A, the first of the particles, and the mass and
    volume of all bodies' particles.
    """
    real, Reals = precision(name).real, precision(name).rows[0]
    kinds = {"first": int, "mass": Reals, "volume": Reals} | dict.fromkeys(("dt", "scale", *constants), real)
    made = type("_".join(["Law", *constants]), (), {"__annotations__": kinds, "__module__": __name__})
    return wp.struct(made, module=f"gradscape.laws.{name}")


class Response(NamedTuple):
    """A material as Warp functions, in a `module`, of its Law and of a particle's state S, a `State`, and C.

    `respond(law, S, C)` returns S' and tau. On the way back `stress(law, S, C, strain)` returns tau again, and
    `turn_back(law, S, C, strain, adj_S_new, weight, adj_a, carried)` the adjoints of S and C: that of tau is `weight`
    times `adj_a`, and that of C is `carried` by the term m C of A and what S' and tau add. `strain(law, S, C)` is what
    these two would both compute, a `Strain`; where that takes no time a material has neither it nor `stress`.
    """

    module: str
    Law: Any
    State: Any
    respond: Any
    turn_back: Any
    strain: Any = None
    stress: Any = None
    Strain: Any = int


@cache
def kernels_in_rows(name: str, Law: Any, states: Any, material: str, *constants: float) -> tuple[Any, Any]:
    """Return (update, adjoint) of one precision for a CPU, in C++: eight particles at a time (`native/materials.h`)."""
    matrices = precision(name).rows[3]
    declare = partial(cpp.kernel_in_rows, f"gradscape.{material}.{name}.rows")
    given = {"law": Law, "S": states, "C": matrices}
    adjoints = {"adj_S_new": states, "adj_A": matrices, "adj_S": states, "adj_C": matrices}
    update = declare(f"{material}_update", *constants, **given, S_new=states, A=matrices)
    return update, declare(f"{material}_adjoint", *constants, **given, **adjoints)


@cache
@no_type_check
def update_kernel(name: str, material: Response) -> Any:
    """Return the kernel that advances states and fills A, a particle in each thread."""
    Law, States, Matrices = material.Law, wp.array2d[material.State], precision(name).rows[3]
    respond, (read, write), lies = material.respond, _access(name, material.State), layout(name)
    read_matrix, write_matrix = lies.read_matrix, lies.write_matrix

    @wp.kernel(module=material.module, enable_backward=False)
    def update(law: Law, S: States, C: Matrices, S_new: States, A: Matrices):
        e, p = wp.tid()
        i = law.first + p
        c = read_matrix(C, e, i)
        after, tau = respond(law, read(S, e, p), c)
        write(S_new, e, p, after)
        write_matrix(A, e, i, law.scale * law.volume[e, i] * tau + law.mass[e, i] * c)

    return update


@cache
@no_type_check
def alone(name: str, material: Response) -> Any:
    """Return the kernel of the adjoint that reads that of A."""
    Law, States, Matrices = material.Law, wp.array2d[material.State], precision(name).rows[3]
    back, read_matrix = _functions(name, material), layout(name).read_matrix
    find_strain, turn_back = back.strain, back.turn_back

    @wp.kernel(module=material.module, enable_backward=False)
    def adjoint(law: Law, S: States, C: Matrices, adj_S_new: States, adj_A: Matrices, adj_S: States, adj_C: Matrices):
        e, p = wp.tid()
        adj_a = read_matrix(adj_A, e, law.first + p)
        turn_back(law, S, C, find_strain(law, S, C, e, p), adj_S_new, adj_a, adj_S, adj_C, e, p)

    return adjoint


@cache
@no_type_check
def after_p2g(name: str, material: Response, count: int) -> Any:
    """Return the kernel of the adjoint that gathers a particle's adjoints of g2p and p2g first.

    So many blocks as `count` are to find registers at once.
    """
    Law, States, Nodes = material.Law, wp.array2d[material.State], precision(name).rows[2]
    Lattice, Particles, gather, back = (
        lattice(name),
        particles(name),
        adjoint_gatherers(name),
        _functions(name, material),
    )
    adjoint_g2p, adjoint_p2g = gather.g2p, gather.p2g
    find_strain, affine_momentum, turn_back = back.strain, back.affine_momentum, back.turn_back
    bounds = {"launch_bounds": found} if (found := blocks(name, count)) else {}

    @wp.kernel(module=cpp.module(f"{material.module}.columns"), enable_backward=False, grid_stride=False, **bounds)
    def adjoint(
        lattice: Lattice,
        starts: Ints,
        now: Particles,
        adj_new: Particles,
        adj_now: Particles,
        adj_grid_m: Nodes,
        grid_v: Nodes,
        law: Law,
        S: States,
        adj_S_new: States,
        adj_S: States,
    ):
        e, p = wp.tid()
        i = law.first + p
        strain = find_strain(law, S, now.C, e, p)
        a = affine_momentum(law, S, now.C, strain, e, p)
        adj_a, adj_x = adjoint_p2g(lattice, starts, law.mass, now.x, now.v, a, adj_grid_m, adj_now.v, e, i)
        turn_back(law, S, now.C, strain, adj_S_new, adj_a, adj_S, adj_now.C, e, p)
        adj_now.x[e, i] = adjoint_g2p(lattice, starts, law.dt, now.x, grid_v, adj_new, e, i) + adj_x

    return adjoint


@cache
@no_type_check
def _functions(name: str, material: Response) -> SimpleNamespace:
    """Return the material's functions of particles in memory; each reads what it takes, so that nothing is held."""
    module, Law, State, respond, turn_state_back, strain_of, stress_of, Strain = material
    States, mat33, Matrices = wp.array2d[State], precision(name).mat33, precision(name).rows[3]
    (read, write), lies = _access(name, State), layout(name)
    read_matrix, write_matrix = lies.read_matrix, lies.write_matrix

    if strain_of is None:

        @wp.func(module=module)
        def strain_of(law: Law, s: State, c: mat33):
            return 0

        @wp.func(module=module)
        def stress_of(law: Law, s: State, c: mat33, strain: int):
            _, tau = respond(law, s, c)
            return tau

    @wp.func(module=module)
    def strain(law: Law, S: States, C: Matrices, e: int, p: int):
        return strain_of(law, read(S, e, p), read_matrix(C, e, law.first + p))

    @wp.func(module=module)
    def affine_momentum(law: Law, S: States, C: Matrices, strain: Strain, e: int, p: int) -> mat33:
        i = law.first + p
        c = read_matrix(C, e, i)
        return law.scale * law.volume[e, i] * stress_of(law, read(S, e, p), c, strain) + law.mass[e, i] * c

    @wp.func(module=module)
    def turn_back(
        law: Law,
        S: States,
        C: Matrices,
        strain: Strain,
        adj_S_new: States,
        adj_a: mat33,
        adj_S: States,
        adj_C: Matrices,
        e: int,
        p: int,
    ):
        i = law.first + p
        weight, carried, adj_s_new = law.scale * law.volume[e, i], law.mass[e, i] * adj_a, read(adj_S_new, e, p)
        s, c = read(S, e, p), read_matrix(C, e, i)
        adj_s, adj_c = turn_state_back(law, s, c, strain, adj_s_new, weight, adj_a, carried)
        write(adj_S, e, p, adj_s)
        write_matrix(adj_C, e, i, adj_c)

    return SimpleNamespace(strain=strain, affine_momentum=affine_momentum, turn_back=turn_back)


def _access(name: str, State: Any) -> tuple[Any, Any]:
    """Return the functions that read and write a state."""
    lies = layout(name)
    if State is precision(name).mat33:
        return lies.read_matrix, lies.write_matrix
    return lies.read_number, lies.write_number
