"""Episodes of Newton's models: speeds at first in, places at the end out, differentiated by Warp's tape.

Nothing of the engine is changed or left out: a gradient is what the tape makes of the launches of Newton's own steps.
"""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import newton
import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..runtime import to_torch

TAPE = threading.Lock()  # Warp records on one tape at a time
ROOM = 1e3  # how far from the ground contact is looked for, once [m]: wherever a thing starts
FINDS_CONTACTS = "newton._src.geometry", "newton._src.sim.collide", "newton._src.utils.mesh"  # begin these modules
SOLVERS: dict[str, Callable[[Any], Any]] = {
    "semi-implicit": lambda model: newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False),
    "featherstone": newton.solvers.SolverFeatherstone,
    "xpbd": lambda model: newton.solvers.SolverXPBD(model, enable_restitution=True),
}


@dataclass(frozen=True)
class Sphere:
    """A solid ball that is a rigid body and touches nothing: where it starts [m], its radius [m] and mass [kg]."""

    place: tuple[float, float, float]
    radius: float
    mass: float

    def add(self, builder: Any) -> None:
        """Add it to the model of one row."""
        inertia = 0.4 * self.mass * self.radius**2
        turned = wp.mat33(inertia, 0.0, 0.0, 0.0, inertia, 0.0, 0.0, 0.0, inertia)
        builder.add_body(xform=wp.transform(self.place, wp.quat_identity()), mass=self.mass, inertia=turned)


@dataclass(frozen=True)
class Particle:
    """A ball that does not turn: where it starts [m], its radius [m] and mass [kg]."""

    place: tuple[float, float, float]
    radius: float
    mass: float

    def add(self, builder: Any) -> None:
        """Add it to the model of one row."""
        builder.add_particle(wp.vec3(self.place), wp.vec3(), self.mass, radius=self.radius)


@dataclass(frozen=True)
class Cloth:
    """A square of particles and springs.

    It has `cells` along each `side` [m] and is `tilted` [rad] about its first edge, which starts at `place` [m]. `mass`
    [kg] is that of all, `ke` [N/m] and `kd` [N s/m] are of each spring, and `radius` [m] is half its thickness.
    """

    place: tuple[float, float, float]
    side: float
    cells: int
    tilted: float
    mass: float
    radius: float
    ke: float
    kd: float

    def add(self, builder: Any) -> None:
        """Add it to the model of one row."""
        limp: dict[str, Any] = dict.fromkeys(("tri_ke", "tri_ka", "tri_kd", "tri_lift", "tri_drag"), 0.0)
        limp |= {"edge_ke": 0.0, "edge_kd": 0.0}
        builder.add_cloth_grid(
            pos=wp.vec3(self.place),
            rot=wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), self.tilted),
            vel=wp.vec3(),
            dim_x=self.cells,
            dim_y=self.cells,
            cell_x=self.side / self.cells,
            cell_y=self.side / self.cells,
            mass=self.mass / (self.cells + 1) ** 2,
            add_springs=True,
            spring_ke=self.ke,
            spring_kd=self.kd,
            particle_radius=self.radius,
            **limp,
        )


@dataclass(frozen=True)
class Ground:
    """How the plane y = 0 pushes back and rubs.

    Stiffness `ke` [N/m], damping `kd` and viscous friction `kf` [N s/m], Coulomb's `mu`; xpbd has `restitution` in the
    place of the first three.
    """

    ke: float
    kd: float
    kf: float
    mu: float
    restitution: float

    def add(self, builder: Any) -> None:
        """Add it to a model."""
        how = {name: getattr(self, name) for name in self.__dataclass_fields__}
        builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(**how))

    def tell(self, model: Any) -> None:
        """Tell a model that its particles are as its ground is: Newton takes the mean of both."""
        for name in self.__dataclass_fields__:
            setattr(model, f"soft_contact_{name}", getattr(self, name))


@dataclass(frozen=True)
class Settings:
    """Say how an episode is simulated: time step [s], how many, gravity [m/s^2], Newton's solver, rows at once."""

    dt: float
    steps: int
    gravity: float
    solver: str
    rows: int


@contextmanager
def without_adjoints() -> Iterator[None]:
    """Compile what finds contacts without adjoints: they are found before any tape, and those take most of the time."""
    names = [name for name in sys.modules if name.startswith(FINDS_CONTACTS)]
    try:
        for name in names:
            wp.set_module_options({"enable_backward": False}, module=name)
        yield
    finally:
        for name in names:
            wp.set_module_options({"enable_backward": True}, module=name)


class Rollout:
    """Hold a model with a world for each row, the states of an episode, and where its points are at the end."""

    def __init__(self, thing: Sphere | Particle | Cloth, ground: Ground | None, settings: Settings) -> None:
        self.settings = settings
        down = wp.vec3(0.0, -settings.gravity, 0.0)
        one, whole = (newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=down) for _ in range(2))
        thing.add(one)
        if ground is not None:
            ground.add(whole)
        whole.replicate(one, settings.rows)
        with without_adjoints():
            self.model: Any = whole.finalize(device="cpu", requires_grad=True)
        self.model.particle_grid, self.model.particle_max_radius = None, 0.0  # particles, of any row, do not touch
        self.model.particle_max_velocity = math.inf  # what flies apart is to be seen as such, not held back
        if ground is not None:
            ground.tell(self.model)
        self.solver: Any = SOLVERS[settings.solver](self.model)
        self.states: list[Any] = [self.model.state() for _ in range(settings.steps + 1)]
        self.control = self.model.control()
        self.contacts: Any = None
        if ground is None:
            self._step(0)  # compiles the kernels, or fetches them from Warp's cache
        else:
            self._find_contacts()
        faces: Any = self.model.tri_indices
        self.faces = to_torch(faces)[: one.tri_count] if one.tri_count else None

    def ends(self, velocity: Float[Tensor, "row 3"]) -> Float[Tensor, "row point 3"]:
        """Return where points are at the end [m] of episodes that begin with one velocity [m/s] each."""
        with TAPE:
            self._play(velocity)
            return self._places(-1)

    def frames(self, velocity: Float[Tensor, "row 3"]) -> Float[Tensor, "frame row point 3"]:
        """Return where points are [m] before each step and at the end."""
        with TAPE:
            self._play(velocity)
            return torch.stack([self._places(number) for number in range(len(self.states))])

    def pull_back(
        self, velocity: Float[Tensor, "row 3"], adjoint: Callable[[Tensor], Tensor]
    ) -> tuple[Float[Tensor, "row point 3"], Float[Tensor, "row 3"]]:
        """Return where points are at the end, and the gradient by velocities of what `adjoint` is one of by places."""
        with TAPE:
            tape = wp.Tape()
            try:
                self._play(velocity, tape)
                end = self._places(-1)
                tape.backward(grads=self._seed(adjoint(end)))
                return end, self._slope(len(velocity))
            finally:
                tape.zero()

    def _find_contacts(self) -> None:
        """Find once what touches the ground: a plane's points and normals are the same wherever a thing is.

        A step with no contacts yet compiles the solver's kernels meanwhile.
        """
        pipeline = newton.CollisionPipeline(
            self.model, broad_phase="explicit", soft_contact_gap=ROOM, requires_grad=True
        )
        self.contacts, found = pipeline.contacts(), pipeline.contacts()
        with without_adjoints(), ThreadPoolExecutor(1) as beside:
            finding = beside.submit(pipeline.collide, self.states[0], found)
            self._step(0)
            finding.result()
        self.contacts = found

    def _play(self, velocity: Float[Tensor, "row 3"], tape: Any = None) -> None:
        self._begin(velocity)
        with tape or nullcontext():
            for number in range(self.settings.steps):
                self._step(number)

    def _step(self, number: int) -> None:
        state, following = self.states[number : number + 2]
        state.clear_forces()
        self.solver.step(state, following, self.control, self.contacts, self.settings.dt)

    def _begin(self, velocity: Float[Tensor, "row 3"]) -> None:
        """Set the first state: as the model has it, moving as a whole; rows that nobody asked for rest."""
        first, rows = self.states[0], self.settings.rows
        given = torch.zeros(rows, 3)
        given[: len(velocity)] = velocity
        if self.model.particle_count:
            wp.copy(first.particle_q, self.model.particle_q)
            to_torch(first.particle_qd).view(rows, -1, 3).copy_(given[:, None])
            return
        wp.copy(first.body_q, self.model.body_q)
        wp.copy(first.joint_q, self.model.joint_q)
        for speeds in (first.body_qd, first.joint_qd):  # maximal and generalised coordinates: a solver reads its own
            to_torch(speeds).view(rows, 6)[:, :3].copy_(given)
            to_torch(speeds).view(rows, 6)[:, 3:].zero_()

    def _moving(self, state: Any) -> Any:
        """Return the array of places in a state: of particles, or of bodies with how they are turned."""
        return state.particle_q if self.model.particle_count else state.body_q

    def _places(self, number: int) -> Float[Tensor, "row point 3"]:
        places = to_torch(self._moving(self.states[number])).view(self.settings.rows, -1, self._width)
        return places[:, :, :3].double()

    @property
    def _width(self) -> int:
        return 3 if self.model.particle_count else 7

    def _seed(self, adjoint: Float[Tensor, "row point 3"]) -> dict[Any, Any]:
        last = self._moving(self.states[-1])
        seed = wp.zeros_like(last, requires_grad=False)
        to_torch(seed).view(self.settings.rows, -1, self._width)[:, :, :3].copy_(adjoint)
        return {last: seed}

    def _slope(self, rows: int) -> Float[Tensor, "row 3"]:
        first, whole = self.states[0], self.settings.rows
        if self.model.particle_count:
            return to_torch(first.particle_qd.grad).view(whole, -1, 3).double().sum(dim=1)[:rows]
        body, joint = (to_torch(one.grad).view(whole, 6)[:rows, :3].double() for one in (first.body_qd, first.joint_qd))
        return body + joint
