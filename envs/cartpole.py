"""The Cartpole scene: a cart swings up the tip of a chain of three links."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.episode import Part, View
from ..landscapes.objective import Evaluation, Status
from ..landscapes.sampling.memory import Pool
from ..landscapes.space import ParameterSpace
from .base import Environment, Episode, Fidelity, ModelPart, Work, copied
from .controls import extend, hold
from .engines.chain import Chain, Solver
from .records import EpisodeOptions

CHAIN = Chain(masses=(1.0, 0.5, 0.25), lengths=(1.0, 1.0, 1.0), gravity=9.81)
CONTROLS, SPAN = 100, 0.02  # how many controls, and how long each is held [s]
TEMPO = 0.2  # what a policy measures time by [s]
VIEW = View((-3.2, -3.2, -0.3), (3.2, 3.2, 0.3), eye=(0.12, 0.12, 1.0), ground=None)
CONTROL = ("cart velocity", "torque 1", "torque 2", "torque 3")
BOUND, UNITS = (2.0, 10.0, 4.0, 1.0), ("m/s", "N m", "N m", "N m")

KNOTS = range(0, CONTROLS, 11)  # the controls that `upright` gives; it is linear in between
UPRIGHT = (
    (-0.09, 0.01, 0.21, 1.23, 1.09, 1.23, -0.22, -1.88, -1.63, -0.71),
    (-3.51, -2.99, -0.16, -0.7, -1.32, 2.47, 9.85, 10.0, 10.0, 9.97),
    (0.72, -0.56, -0.94, -0.24, 0.55, 0.97, -3.48, -4.0, -2.64, -0.44),
    (-0.31, 0.07, 0.19, 0.05, -0.21, -0.19, -0.24, -0.15, 0.13, 0.49),
)


@dataclass(frozen=True)
class CartpoleOptions(EpisodeOptions):
    """The target of the tip is (`target_x`, `target_y`) [m]. The cart starts at (0, 0), with the tip at (0, -3).

    `gravity` [m/s^2]. `taper`: each link has half the mass of the previous one; without it, every link has 1 kg.
    `joint_damping` [N m s/rad] applies to each of the three joints.
    """

    target_x: float = 0.0
    target_y: float = 3.0
    gravity: float = 9.81
    taper: bool = True
    joint_damping: float = 0.0


class Cartpole(Environment):
    """Swing up a chain of three links, so that its tip is at the target after 2 s.

    Model: a cart moves along a rail at a prescribed velocity. From it hang three uniform rods of 1 m with masses 1, 0.5
    and 0.25 kg, initially at rest. Gravity (9.81 m/s^2) and three motors act on them, between cart and first link,
    first and second, second and third. The state is angles and their momenta. Classical Runge-Kutta, dt 0.01 s at
    standard.
    Parameters: cart velocity [m/s] and torques 1, 2, 3 [N m], control by control. Each of 100 controls lasts 0.02 s. We
    chose the box of ±2 m/s and ±10, ±4, ±1 N m. Holding the links out level takes more torque (12.3, 4.9, 1.2 N m), so
    the tip has to be swung up. Random controls leave it hanging, 3.3 to 6.1 m from the target.
    Loss: distance of the tip to the target (0, 3) m at 2 s [m]. Exactly at the target the gradient is 0. Example
    `upright` comes within 2 mm. Gradient descent found it from the most promising of 32 random starts: Adam at standard
    on ten knots of each control, with a small penalty on their second differences.
    Simplifications: links do not collide, as in the paper. There is no friction. Joints and rail have no limits,
    because limits would add contacts to a scene without any. The cart changes its velocity instantly, which kicks the
    links, because the paper prescribes the velocity.
    Source: task 3-link Cartpole of "Rethinking Optimization with Differentiable Simulation from a Global Perspective"
    (CoRL 2022), appendix A.1.1. The paper has 200 timesteps, four controls and 400 parameters; holding each control for
    two timesteps satisfies all three. Masses, torques, times and target are ours.
    """

    model_version = 1
    name = "cartpole"
    devices: ClassVar[tuple[str, ...]] = ("cpu", "cuda")
    beyond_box = True
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=SPAN),
        "standard": Fidelity("standard", dt=SPAN / 2),
        "reference": Fidelity("reference", dt=SPAN / 8, precision="float64"),
    }
    loss_unit = "m"
    decisions = CONTROLS
    differentiates_observations: ClassVar[bool] = True
    control_step: ClassVar[float] = SPAN
    designed_order: ClassVar[dict[str, float]] = {"dt": 4.0}  # classical Runge-Kutta; controls change between steps
    model_parts: ClassVar[tuple[ModelPart, ...]] = (
        ModelPart("gravity", {"gravity": 0.0}, "weightless links"),
        ModelPart("lighter outer links", {"taper": False}, "three links of 1 kg"),
        ModelPart("joint damping", {"joint_damping": 0.02}, "joints brake by 0.02 N m s/rad", missing=True),
    )
    Options: ClassVar[type[Any]] = CartpoleOptions
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"paper": {}}  # the scene as it is
    examples: ClassVar[dict[str, tuple[float, ...]]] = {
        "upright": tuple(float(np.interp(k, KNOTS, values)) for k in range(CONTROLS) for values in UPRIGHT)
    }
    _solvers: Pool[Solver]
    space = ParameterSpace(
        tuple(f"t{k} {name}" for k in range(CONTROLS) for name in CONTROL),
        torch.tensor(BOUND * CONTROLS, dtype=torch.float64).neg(),
        torch.tensor(BOUND * CONTROLS, dtype=torch.float64),
        UNITS * CONTROLS,
    )

    @property
    def control_steps(self) -> int:
        """Number of control steps of an episode."""
        count: int = self.options.count_steps(CONTROLS)
        return count

    @property
    def steps(self) -> int:
        """Number of time steps of an episode."""
        return round(self.control_steps * SPAN / self.fidelity.dt)

    def memory(self) -> int:
        """Estimate the bytes one episode takes while it runs."""
        numbers = (self.steps + 1) * 4 * 3 + self.control_steps * 2 * 4
        return numbers * (8 if self.fidelity.precision == "float64" else 4)

    def work(self) -> Work:
        """Count steps of links."""
        return Work(len(CHAIN.masses) * self.steps, "body-step")

    def replicas(self) -> Mapping[str, Environment]:
        """Return the chain with its angles counted from a full turn on, so that they are rounded differently.

        Without contacts, no event can happen at another moment within a step, and controls change at the ends of steps.
        The mirrored chain does not help, because it rounds in the same way.
        """
        return self._replicas_of({f"angles {turns} turns on": {"settings": {"turns": turns}} for turns in (1, 2)})

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return the cart, the joints of the chain and its tip."""
        controls = self._controls(self._row(x))
        with self._solvers.lend() as solver:
            phi = copied(self._swing(solver, controls)[:, 0])
        joints = _joints(self._cart(controls)[0], phi)
        joints = torch.cat([joints, torch.zeros_like(joints[..., :1])], dim=2)
        time = self.fidelity.dt * torch.arange(self.steps + 1, dtype=torch.float64)
        target = torch.cat([self.target, self.target.new_zeros(1)]).expand(len(time), 3)
        points = {"cart": joints[:, :1], "links": joints}
        return Episode(time, points, {"target": target}, _parts(joints, target), VIEW)

    @property
    def target(self) -> Float[Tensor, " 2"]:
        """Target of the tip [m]."""
        return torch.tensor([self.options.target_x, self.options.target_y], dtype=torch.float64)

    def _setup(self) -> None:
        dt = self.fidelity.dt
        self._capacity = 256 if self.device == "cpu" else 1 << 14
        settings: dict[str, Any] = {"capacity": self._capacity, "device": self.device, "name": self.fidelity.precision}
        o = self.options
        masses = CHAIN.masses if o.taper else 3 * CHAIN.masses[:1]
        self.chain = replace(CHAIN, masses=masses, gravity=o.gravity, damping=o.joint_damping)
        self._solvers = Pool(
            partial(Solver, self.chain, dt=dt, hold=round(SPAN / dt), controls=self.control_steps, **settings)
        )

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        x = x.clone().requires_grad_(grad)
        controls = self._controls(x)
        with self._solvers.lend() as solver:
            phi = copied(self._swing(solver, controls.detach())).requires_grad_(grad)
            tip = _joints(self._cart(controls)[:, -1], phi[-1])[:, -1]
            loss = (tip - self.target).norm(dim=1)
            slope = _pull_back(solver, loss, torch.ones_like(loss), phi, controls, x) if grad else None
        return Evaluation(loss.detach(), slope, torch.full((len(x),), Status.OK, dtype=torch.int8))

    def _energy(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch step"]:
        """Return the energy of a chain that swings from a cart at rest, released at angles set by the first torques.

        The bounds of a torque map to half a turn either way.
        """
        torque = x.view(len(x), CONTROLS, 4)[:, 0, 1:]
        with self._solvers.lend() as solver:
            still = x.new_zeros(len(x), self.control_steps, 4)
            phi = solver.run(torch.pi * torque / x.new_tensor(BOUND[1:]), x.new_zeros(3), still).cpu().double()
            energy: Tensor = solver.energy(len(x), phi)
        return energy.T

    def _observe(self, x: Float[Tensor, "batch dim"], decision: int) -> Float[Tensor, "batch feature"]:
        controls = self._controls(x)
        with self._solvers.lend() as solver:
            phi = copied(self._swing(solver, controls))
        return self._watch(controls, phi, decision)

    def _pull_back_observation(
        self, x: Float[Tensor, "batch dim"], decision: int, weight: Float[Tensor, "batch feature"]
    ) -> Float[Tensor, "batch dim"]:
        x = x.clone().requires_grad_()
        controls = self._controls(x)
        with self._solvers.lend() as solver:
            phi = copied(self._swing(solver, controls.detach())).requires_grad_()
            return _pull_back(solver, self._watch(controls, phi, decision), weight, phi, controls, x)

    def _watch(
        self, controls: Float[Tensor, "batch control 4"], phi: Float[Tensor, "step_plus_1 batch 3"], decision: int
    ) -> Float[Tensor, "batch feature"]:
        """Observe the cart, the sines and cosines of the angles, and the rates of change in the last step."""
        step = decision * self.steps // CONTROLS
        joints = torch.cat([self._cart(controls)[:, :, None], phi.transpose(0, 1)], dim=2)
        rate = (joints[:, step] - joints[:, max(0, step - 1)]) * (TEMPO / self.fidelity.dt)
        return torch.cat([joints[:, step, :1], phi[step].sin(), phi[step].cos(), rate], dim=1)

    def _swing(
        self, solver: Solver, controls: Float[Tensor, "batch control 4"]
    ) -> Float[Tensor, "step_plus_1 batch 3"]:
        """Return the angles at the ends of steps [rad], starting at rest and offset by this many full turns."""
        rest = torch.zeros(3, dtype=torch.float64)
        return solver.run(rest + 2 * torch.pi * self.fidelity.settings.get("turns", 0), rest, controls)

    def _controls(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch control 4"]:
        """Return cart velocity and torques in each control step; zero after the last one that parameters set."""
        return extend(x.view(len(x), CONTROLS, 4), self.control_steps, then=x.new_zeros(len(x), 1, 4))

    def _cart(self, controls: Float[Tensor, "batch control 4"]) -> Float[Tensor, "batch step_plus_1"]:
        """Return where the cart is at the ends of steps [m]."""
        path = (self.fidelity.dt * hold(controls[:, :, :1], self.steps)).cumsum(dim=1)[:, :, 0]
        return torch.cat([torch.zeros_like(path[:, :1]), path], dim=1)


def _parts(joints: Float[Tensor, "frame 4 3"], target: Float[Tensor, "frame 3"]) -> tuple[Part, ...]:
    """Return cart, rail, links and tip; links move in one plane in front of the rail."""
    rail = joints.new_tensor([[-4.2, 0.0, -0.2], [4.2, 0.0, -0.2]]).expand(len(joints), 2, 3)
    links = [Part("path", "steel", joints[:, k : k + 2], (0.07 - 0.012 * k,), tint=k) for k in range(3)]
    return (
        Part("path", "iron", rail, (0.03,)),
        Part("box", "wood", joints[:, :1] + joints.new_tensor([0.0, 0.0, -0.2]), (0.7, 0.3, 0.2)),
        *links,
        Part("sphere", "iron", joints[:, :3], (0.1,)),
        Part("sphere", "rubber", joints[:, 3:], (0.11,)),
        Part("trail", "rubber", joints[:, 3:], (0.015,)),
        Part("sphere", "target", target[:, None], (0.14,)),
    )


def _joints(cart: Float[Tensor, "*batch"], phi: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 2"]:
    """Return where the joints are, from the cart to the tip [m]."""
    links = torch.stack([phi.sin(), -phi.cos()], dim=-1) * phi.new_tensor(CHAIN.lengths)[:, None]
    hinge = torch.stack([cart, torch.zeros_like(cart)], dim=-1)[..., None, :]
    return torch.cat([hinge, hinge + links.cumsum(dim=-2)], dim=-2)


def _pull_back(
    solver: Solver, found: Tensor, weight: Tensor, phi: Tensor, controls: Tensor, x: Tensor
) -> Float[Tensor, "batch dim"]:
    """Return the gradient with respect to x of the weighted sum of angles and positions of the cart."""
    adj_phi, adj_controls = torch.autograd.grad(found, (phi, controls), weight, retain_graph=True)
    (slope,) = torch.autograd.grad(controls, x, adj_controls + solver.gradient(adj_phi).cpu().double())
    return slope
