"""Episodes of Newton's models: initial velocities in, final positions out, differentiated by Warp's tape.

A gradient comes from the tape over the launches of Newton's own, unchanged steps. Parts without effect are left out: a
cloth's limp triangles, a free body's joint, the search for contacts with a plane.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import newton
import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..runtime import to_torch
from .compiling import finalize, split_solvers

TAPE = threading.Lock()  # Warp records on one tape at a time
SOLVERS: dict[str, tuple[str, dict[str, Any]]] = {  # of Newton, which imports those that are asked for
    "semi-implicit": ("SolverSemiImplicit", {"enable_tri_contact": False}),
    "featherstone": ("SolverFeatherstone", {}),
    "xpbd": ("SolverXPBD", {"enable_restitution": True}),
}


MATERIAL = ("ke", "kd", "kf", "mu", "restitution")  # of ground and particles


@dataclass(frozen=True)
class Sphere:
    """A solid ball that is a rigid body and touches nothing: where it starts [m], its radius [m] and mass [kg].

    It is `joined` to the world by a joint that leaves it free where a solver has the coordinates of joints; others need
    none, and their kernels for joints take longer to compile than all else.
    """

    place: tuple[float, float, float]
    radius: float
    mass: float
    joined: bool

    def add(self, builder: Any) -> None:
        """Add it to the model of one row."""
        inertia = 0.4 * self.mass * self.radius**2
        turned = wp.mat33(inertia, 0.0, 0.0, 0.0, inertia, 0.0, 0.0, 0.0, inertia)
        add = builder.add_body if self.joined else builder.add_link
        add(xform=wp.transform(self.place, wp.quat_identity()), mass=self.mass, inertia=turned)


@dataclass(frozen=True)
class Particle:
    """A ball that does not turn: its initial position [m], its radius [m] and mass [kg]."""

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
    """The contact of the plane y = 0, and of the plane x = `wall` [m] if there is one.

    Stiffness `ke` [N/m], damping `kd` and viscous friction `kf` [N s/m], Coulomb's `mu`; xpbd has `restitution` instead
    of the first three.
    """

    ke: float
    kd: float
    kf: float
    mu: float
    restitution: float
    wall: float | None = None

    def add(self, builder: Any) -> None:
        """Add it to a model."""
        cfg = newton.ModelBuilder.ShapeConfig(**{name: getattr(self, name) for name in MATERIAL})
        builder.add_ground_plane(cfg=cfg)
        if self.wall is not None:
            builder.add_shape_plane(plane=(-1.0, 0.0, 0.0, self.wall), width=0.0, length=0.0, cfg=cfg)

    def tell(self, model: Any) -> None:
        """Tell a model that its particles are as its ground is: Newton takes the mean of both."""
        for name in MATERIAL:
            setattr(model, f"soft_contact_{name}", getattr(self, name))


@dataclass(frozen=True)
class Settings:
    """The settings of an episode: time step [s], number of steps, gravity [m/s^2], Newton's solver, rows at once."""

    dt: float
    steps: int
    gravity: float
    solver: str
    rows: int


def touch(model: Any) -> Any:
    """Return contacts of all particles with the planes that are the only shapes, once for all.

    They hold points of a plane and its normal, which serve wherever the particles are: those under where they start.
    Of one plane it is what Newton's own pipeline finds, to the bit, whose kernels take as long to compile as all else.
    """
    count, shapes = model.particle_count, model.shape_count
    contacts = newton.Contacts(0, count * shapes, requires_grad=True, device="cpu")
    up: Any = wp.vec3(0.0, 0.0, 1.0)
    places = [wp.vec3(*place) for place in model.particle_q.numpy().tolist()]
    points, normals = list[Any](), list[Any]()
    for turned in model.shape_transform.numpy().tolist():
        plane: Any = wp.transform(*turned)
        local = [wp.transform_point(wp.transform_inverse(plane), place) for place in places]
        points += [wp.transform_point(plane, at - up * wp.dot(up, at)) for at in local]
        normals += [wp.transform_vector(plane, up)] * count
    contacts.soft_contact_count.fill_(count * shapes)
    contacts.soft_contact_particle.assign([*range(count)] * shapes)
    contacts.soft_contact_shape.assign([shape for shape in range(shapes) for _ in range(count)])
    contacts.soft_contact_body_pos.assign(points)
    contacts.soft_contact_normal.assign(normals)
    return contacts


class Rollout:
    """A model with a world for each row, the states of an episode, and the final positions of its points."""

    def __init__(self, thing: Sphere | Particle | Cloth, ground: Ground | None, settings: Settings) -> None:
        self.settings = settings
        down = wp.vec3(0.0, -settings.gravity, 0.0)
        one, whole = (newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=down) for _ in range(2))
        thing.add(one)
        if ground is not None:
            ground.add(whole)
        whole.replicate(one, settings.rows)
        name, how = SOLVERS[settings.solver]
        solver = getattr(newton.solvers, name)
        with TAPE:
            split_solvers()
            self.model: Any = finalize(whole)
        self.model.particle_grid, self.model.particle_max_radius = None, 0.0  # particles, of any row, do not touch
        self.model.particle_max_velocity = math.inf  # what flies apart is to be seen as such, not held back
        if ground is not None:
            ground.tell(self.model)
        self.model.tri_count = self.model.edge_count = 0  # of a cloth, limp: springs alone pull
        self.solver: Any = solver(self.model, **how)
        self.states: list[Any] = [self.model.state() for _ in range(settings.steps + 1)]
        self.control = self.model.control()
        self.contacts: Any = None if ground is None else touch(self.model)
        with TAPE:
            self._step(0)  # compiles the kernels, or fetches them from Warp's cache
        faces: Any = self.model.tri_indices
        self.faces = to_torch(faces)[: one.tri_count] if one.tri_count else None

    def ends(self, velocity: Float[Tensor, "row start"]) -> Float[Tensor, "row point 3"]:
        """Return where points are at the end [m] of episodes that begin with one velocity [m/s] each, or more."""
        with TAPE:
            self._play(velocity)
            return self._places(-1)

    def frames(self, velocity: Float[Tensor, "row start"]) -> Float[Tensor, "frame row point 3"]:
        """Return where points are [m] before each step and at the end."""
        with TAPE:
            self._play(velocity)
            return torch.stack([self._places(number) for number in range(len(self.states))])

    def pull_back(
        self, velocity: Float[Tensor, "row start"], adjoint: Callable[[Tensor], Tensor]
    ) -> tuple[Float[Tensor, "row point 3"], Float[Tensor, "row start"]]:
        """Return where points are at the end, and the gradient by starts of what `adjoint` is one of by places."""
        with TAPE:
            tape = wp.Tape()
            try:
                self._play(velocity, tape)
                end = self._places(-1)
                tape.backward(grads=self._seed(adjoint(end)))
                return end, self._slope(*velocity.shape)
            finally:
                tape.zero()

    def _play(self, velocity: Float[Tensor, "row start"], tape: Any = None) -> None:
        self._begin(velocity)
        with tape or nullcontext():
            for number in range(self.settings.steps):
                self._step(number)

    def _step(self, number: int) -> None:
        state, following = self.states[number : number + 2]
        state.clear_forces()
        self.solver.step(state, following, self.control, self.contacts, self.settings.dt)

    def _begin(self, velocity: Float[Tensor, "row start"]) -> None:
        """Set the first state: as the model has it, moving as a whole; rows that nobody asked for rest.

        Of particles a start may hold, after the velocity, by what they are moved [m].
        """
        first, rows = self.states[0], self.settings.rows
        start = torch.zeros(rows, 6)
        start[: len(velocity), : velocity.shape[1]] = velocity
        given = start[:, :3]
        if self.model.particle_count:
            wp.copy(first.particle_q, self.model.particle_q)
            to_torch(first.particle_q).view(rows, -1, 3).add_(start[:, None, 3:])
            to_torch(first.particle_qd).view(rows, -1, 3).copy_(given[:, None])
            return
        wp.copy(first.body_q, self.model.body_q)
        if self.model.joint_count:
            wp.copy(first.joint_q, self.model.joint_q)
        for speeds in self._speeds(first):
            to_torch(speeds).view(rows, 6)[:, :3].copy_(given)
            to_torch(speeds).view(rows, 6)[:, 3:].zero_()

    def _speeds(self, state: Any) -> list[Any]:
        """Return the speeds of bodies in maximal and, where there are joints, generalised coordinates."""
        return [state.body_qd, state.joint_qd] if self.model.joint_count else [state.body_qd]

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

    def _slope(self, rows: int, size: int) -> Float[Tensor, "row start"]:
        first, whole = self.states[0], self.settings.rows
        if self.model.particle_count:
            both = [
                to_torch(of.grad).view(whole, -1, 3).double().sum(dim=1) for of in (first.particle_qd, first.particle_q)
            ]
            return torch.cat(both, dim=1)[:rows, :size]
        slopes = [to_torch(one.grad).view(whole, 6)[:rows, :3].double() for one in self._speeds(first)]
        return torch.stack(slopes).sum(dim=0)
