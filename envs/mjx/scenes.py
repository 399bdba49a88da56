"""Scenes of MuJoCo: a drop, bounces, a chain on a cart, a push across friction, and three with a closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from .. import closed_forms
from ..base import Fidelity
from ..closed_forms import GRAVITY, RADIUS, REACH, WALL
from ..collisions import PRICE, missed
from .scene import MjxOptions, MjxScene, Mode, Parameter

BALL = """
<mujoco>
  <option timestep="0.004" gravity="0 0 -9.8"/>
  <worldbody>
    <geom type="plane" size="20 20 0.1" {contact}/>
    <body name="ball" pos="{place}">
      <freejoint name="ball"/>
      <geom name="ball" type="sphere" size="0.1" mass="1" {contact}/>
    </body>
  </worldbody>
</mujoco>
"""
TARGET = (2.0, 0.0, 1.0)  # of mjx-bounce [m]
AHEAD = 0.5  # where mjx-drop's ball is wanted [m]
GOAL = (0.6, 0.15)  # of mjx-push [m]
SPEED = ("velocity x", "velocity y", "velocity z")


def _speeds(bound: float) -> tuple[Parameter, ...]:
    return tuple(Parameter(name, "qvel", axis, -bound, bound, "m/s") for axis, name in enumerate(SPEED))


class Drop(MjxScene):
    """Drop a ball onto the ground, so that it is 0.5 m ahead after 0.6 s.

    Model: MuJoCo's, in JAX. A ball of radius 0.1 m and mass 1 kg falls from 1 m onto a plane, with MuJoCo's own soft
    contact and friction (coefficient 1). Semi-implicit Euler, dt 1/500 s at standard.
    Parameters: initial velocity x, y, z [m/s], z upwards.
    Loss: squared distance on the ground to (0.5, 0) m at the end [m^2]. A ball dropped straight down (example
    `straight`) does not slide when it touches. Such contacts are an interesting case for gradients.
    """

    name = "mjx-drop"
    mjcf: ClassVar[str] = BALL.format(place="0 0 1", contact="")
    parameters: ClassVar[tuple[Parameter, ...]] = _speeds(2.0)
    duration: ClassVar[float] = 0.6
    loss_unit = "m²"
    examples: ClassVar[dict[str, tuple[float, ...]]] = {"straight": (0.0, 0.0, 0.0)}

    def loss_of(self, state: Any) -> Any:
        """Return the squared distance to the target on the ground [m^2]."""
        return (state.qpos[0] - AHEAD) ** 2 + state.qpos[1] ** 2


class MjxBounce(MjxScene):
    """Throw a ball so that it is at the target after 2 s, as in `bounce`, by MuJoCo.

    Model: MuJoCo's, in JAX. A ball of radius 0.1 m and mass 1 kg flies from (-0.5, 0, 1) m under gravity. The plane
    pushes back by MuJoCo's contact with the stiffness 1e4 and the damping 10 of `bounce` per kg. It has friction
    (coefficient 0.25), which spins the ball. Semi-implicit Euler, dt 1/500 s at standard.
    Parameters: initial velocity x, y, z [m/s], z upwards; `bounce` has y upwards.
    Loss: squared distance of the ball's centre to the target (2, 0, 1) m after 2 s [m^2].
    """

    name = "mjx-bounce"
    mjcf: ClassVar[str] = BALL.format(
        place="-0.5 0 1", contact='solref="-10000 -10" solimp="0.999 0.999 0.001" friction="0.25 0 0"'
    )
    parameters: ClassVar[tuple[Parameter, ...]] = _speeds(10.0)
    duration: ClassVar[float] = 2.0
    loss_unit = "m²"

    def loss_of(self, state: Any) -> Any:
        """Return the squared distance to the target [m^2]."""
        return sum((state.qpos[axis] - at) ** 2 for axis, at in enumerate(TARGET))


LINK = """
<body name="link {k}" pos="0 0 {z}">
  <joint name="joint {k}" type="hinge" axis="0 -1 0"/>
  <geom name="link {k}" type="capsule" fromto="0 0 0 0 0 -1" size="0.03" contype="0" conaffinity="0"/>
  <inertial pos="0 0 -0.5" mass="{mass}" diaginertia="{inertia} {inertia} 1e-6"/>
  {inner}
</body>
"""


def _chain() -> str:
    """Return a cart too heavy for any torque to move, and three uniform rods of 1 m that hang from it."""
    inner = ""
    for k, mass in ((3, 0.25), (2, 0.5), (1, 1.0)):
        inner = LINK.format(k=k, z=0 if k == 1 else -1, mass=mass, inertia=mass / 12, inner=inner)
    motors = "".join(f'<motor name="torque {k}" joint="joint {k}"/>' for k in (1, 2, 3))
    return f"""
<mujoco>
  <option timestep="0.01" gravity="0 0 -9.81" integrator="RK4"/>
  <worldbody>
    <body name="cart">
      <joint name="cart" type="slide" axis="1 0 0"/>
      <geom name="cart" type="box" size="0.35 0.1 0.15" mass="1e8" contype="0" conaffinity="0"/>
      {inner}
    </body>
  </worldbody>
  <actuator><motor name="cart velocity" joint="cart" gear="0"/>{motors}</actuator>
</mujoco>
"""


@dataclass(frozen=True)
class ChainOptions(MjxOptions):
    """The chain has no contacts, so it is differentiated in reverse by default."""

    mode: Mode = "reverse"


class MjxCartpole(MjxScene):
    """Swing up a chain of three links, as in `cartpole`, by MuJoCo.

    Model: MuJoCo's, in JAX. Three uniform rods of 1 m with masses 1, 0.5 and 0.25 kg hang from a cart, initially at
    rest, under gravity and the torques of three motors. The cart takes each velocity instantly, as by an impulse, and
    is too heavy for anything else to move it. Classical Runge-Kutta, dt 0.01 s at standard.
    Parameters: those of `cartpole`.
    Loss: that of `cartpole`, so that the two scenes can be compared.
    """

    name = "mjx-cartpole"
    mjcf: ClassVar[str] = _chain()
    duration: ClassVar[float] = 2.0
    segments: ClassVar[int] = 100
    control_step: ClassVar[float] = 0.02
    loss_unit = "m"
    Options: ClassVar[type[Any]] = ChainOptions
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "draft": Fidelity("draft", dt=0.02, precision="float64"),
        "standard": Fidelity("standard", dt=0.01, precision="float64"),
        "reference": Fidelity("reference", dt=0.0025, precision="float64"),
    }
    parameters: ClassVar[tuple[Parameter, ...]] = tuple(
        Parameter(name, "ctrl", name, -bound, bound, unit)
        for name, bound, unit in (
            ("cart velocity", 2.0, "m/s"),
            ("torque 1", 10.0, "N m"),
            ("torque 2", 4.0, "N m"),
            ("torque 3", 1.0, "N m"),
        )
    )

    def act(self, model: Any, state: Any, control: Any) -> Any:
        """Return the state whose cart has its velocity and whose motors their torques."""
        return self._engine("rollout").kick(model, state, 0, control[0]).replace(ctrl=control)

    def loss_of(self, state: Any) -> Any:
        """Return the distance of the tip to the target (0, 3) m [m]; the links hang along their own -z."""
        tip = state.xpos[-1] - state.xmat[-1][:, 2]
        return (tip[0] ** 2 + (tip[2] - 3.0) ** 2) ** 0.5


class Push(MjxScene):
    """Push a box across a rough floor with a ball, so that it is at (0.6, 0.15) m after 1 s.

    Model: MuJoCo's, in JAX. A box of 0.2 m and 1 kg lies at the origin on a plane (friction 0.5). A ball of radius 0.05
    m on two rails pushes it; its velocity follows its control. Semi-implicit Euler, dt 1/500 s at standard.
    Parameters: five target velocities x and y of the ball [m/s], each lasting 0.2 s.
    Loss: squared distance of the box's centre on the floor to (0.6, 0.15) m [m^2].
    """

    name = "mjx-push"
    mjcf: ClassVar[str] = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom type="plane" size="5 5 0.1" friction="0.5 0.005 0.0001"/>
    <body name="box" pos="0 0 0.1">
      <freejoint name="box"/>
      <geom name="box" type="box" size="0.1 0.1 0.1" mass="1" friction="0.5 0.005 0.0001"/>
    </body>
    <body name="ball" pos="-0.2 0 0.1">
      <joint name="rail x" type="slide" axis="1 0 0"/>
      <joint name="rail y" type="slide" axis="0 1 0"/>
      <geom name="ball" type="sphere" size="0.05" mass="1" friction="0.5 0.005 0.0001"/>
    </body>
  </worldbody>
  <actuator>
    <velocity name="velocity x" joint="rail x" kv="100"/>
    <velocity name="velocity y" joint="rail y" kv="100"/>
  </actuator>
</mujoco>
"""
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("velocity x", "ctrl", "velocity x", -2.0, 2.0, "m/s"),
        Parameter("velocity y", "ctrl", "velocity y", -2.0, 2.0, "m/s"),
    )
    duration: ClassVar[float] = 1.0
    segments: ClassVar[int] = 5
    control_step: ClassVar[float] = 0.2
    loss_unit = "m²"
    examples: ClassVar[dict[str, tuple[float, ...]]] = {"straight": (0.8, 0.0) * 5}

    def loss_of(self, state: Any) -> Any:
        """Return the squared distance to the goal on the floor [m^2]."""
        return (state.qpos[0] - GOAL[0]) ** 2 + (state.qpos[1] - GOAL[1]) ** 2


BOUNCY = 'condim="1" solref="-10000 {damping}" solimp="0.999 0.999 0.001"'  # stiffness, and damping for each kg
SLIDER = """
<body name="{name}">
  <joint name="{name} x" type="slide" axis="1 0 0"/><joint name="{name} {up}" type="slide" axis="{axis}"/>
  <geom name="{name}" type="sphere" size="{radius}" mass="1" {contact}/>
</body>
"""
LIVELY_DAMPING = -5.3  # with which a rebound is 0.92 times as fast, times minus one, as MuJoCo writes it


def _slider(name: str, up: str, radius: float, damping: float = 0.0) -> str:
    """Return a ball that slides along x and the axis `up`."""
    axis = {"y": "0 1 0", "z": "0 0 1"}[up]
    return SLIDER.format(name=name, up=up, axis=axis, radius=radius, contact=BOUNCY.format(damping=damping))


def _ball(gravity: float, damping: float, walls: str = "") -> str:
    """Return a ball that slides in an upright plane, above the ground and between walls."""
    contact = BOUNCY.format(damping=damping)
    ball = _slider("ball", "z", RADIUS, damping)
    return f"""
<mujoco>
  <option timestep="0.004" gravity="0 0 {-gravity}"/>
  <worldbody><geom type="plane" size="20 20 0.1" {contact}/>{walls.format(contact=contact)}{ball}</worldbody>
</mujoco>
"""


def _start(x: tuple[float, float], z: tuple[float, float], vx: tuple[float, float], vz: tuple[float, float]) -> Any:
    """Return the parameters of a ball's initial state, each given by its centre and half width."""
    named = (("position x", "qpos", "ball x", x, "m"), ("position z", "qpos", "ball z", z, "m"))
    named += (("velocity x", "qvel", "ball x", vx, "m/s"), ("velocity z", "qvel", "ball z", vz, "m/s"))  # type: ignore[assignment]
    return tuple(
        Parameter(name, field, at, mid - half, mid + half, unit) for name, field, at, (mid, half), unit in named
    )


class MjxBounceOnce(MjxScene):
    """Let a ball bounce off the ground once, as in `bounce-once`, by MuJoCo; the loss is its height afterwards.

    Model: MuJoCo's, in JAX. A ball of radius 0.1 m and mass 1 kg slides in an upright plane, without gravity and
    friction. The ground pushes back by MuJoCo's contact with stiffness 1e4 per kg, without damping. Semi-implicit
    Euler, dt 1/500 s at standard. The contact lasts pi/100 s, which makes its derivatives differ from those of an
    impact.
    Parameters: initial position x, z [m] and velocity x, z [m/s], z upwards.
    Loss: height of the ball's centre after 1 s [m].
    """

    name = "mjx-bounce-once"
    mjcf: ClassVar[str] = _ball(0.0, 0.0)
    parameters: ClassVar[tuple[Parameter, ...]] = _start((-1.0, 0.5), (1.0, 0.4), (2.0, 1.0), (-2.0, 1.5))
    duration: ClassVar[float] = 1.0
    loss_unit = "m"

    def loss_of(self, state: Any) -> Any:
        """Return the height [m]."""
        return state.qpos[1]

    def _closed_form(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        return closed_forms.bounce_once(x[:, 1], x[:, 3], torch.zeros_like(x[:, 1]), self.time)


class MjxGroundWall(MjxScene):
    """Throw a ball at the ground and a wall, as in `ground-wall`, by MuJoCo, so that it comes back to the target.

    Model: MuJoCo's, in JAX. A ball of radius 0.1 m and mass 1 kg slides in an upright plane without friction. Ground
    and wall push back by MuJoCo's contact with stiffness 1e4 and damping 5.3 per kg, so that the rebound has 0.92 times
    the speed. Semi-implicit Euler, dt 1/500 s at standard.
    Parameters: initial position x, z [m] and velocity x, z [m/s], z upwards.
    Loss: squared distance of the ball's centre to (-2, 1.5) m after 0.6 s [m^2].
    """

    name = "mjx-ground-wall"
    mjcf: ClassVar[str] = _ball(
        GRAVITY, LIVELY_DAMPING, f'<geom type="plane" size="20 20 0.1" pos="{WALL} 0 0" zaxis="-1 0 0" {{contact}}/>'
    )
    parameters: ClassVar[tuple[Parameter, ...]] = _start((-0.5, 0.4), (1.0, 0.4), (5.0, 4.0), (-5.0, 3.0))
    duration: ClassVar[float] = 0.6
    loss_unit = "m²"

    def loss_of(self, state: Any) -> Any:
        """Return the squared distance to the target [m^2]."""
        return (state.qpos[0] + 2.0) ** 2 + (state.qpos[1] - 1.5) ** 2

    def _closed_form(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        return missed(closed_forms.ground_wall(x[:, :2], x[:, 2:], torch.zeros_like(x[:, :2]), self.time))


class MjxTwoBalls(MjxScene):
    """Push a ball against a second one, as in `two-balls`, by MuJoCo, so that the second one ends at the origin.

    Model: MuJoCo's, in JAX. Two balls of radius 0.2 m and mass 1 kg slide on a plane without friction and gravity. They
    push each other by MuJoCo's contact with stiffness 1e4 per kg, without damping. Semi-implicit Euler, dt 1/500 s at
    standard.
    Parameters: initial positions x, y [m] and velocities x, y [m/s] of both, and the push x, y on the first [m/s²].
    Loss: squared distance of the second ball to the origin after 1 s, plus 0.1 times the squared push times its
    duration [m²].
    """

    name = "mjx-two-balls"
    mjcf: ClassVar[str] = f"""
<mujoco>
  <option timestep="0.004" gravity="0 0 0"/>
  <worldbody>{_slider("1", "y", REACH)}{_slider("2", "y", REACH)}</worldbody>
  <actuator><motor name="push x" joint="1 x"/><motor name="push y" joint="1 y"/></actuator>
</mujoco>
"""
    parameters: ClassVar[tuple[Parameter, ...]] = (
        *(Parameter(f"position {k} {axis}", "qpos", f"{k} {axis}", at - 0.1, at + 0.1, "m")
          for k, at in ((1, -2.0), (2, -1.0)) for axis in "xy"),
        *(Parameter(f"velocity {k} {axis}", "qvel", f"{k} {axis}", -0.2, 0.2, "m/s") for k in (1, 2) for axis in "xy"),
        *(Parameter(f"push {axis}", "ctrl", f"push {axis}", 2.5, 3.5, "m/s²") for axis in "xy"),
    )  # fmt: skip
    duration: ClassVar[float] = 1.0
    loss_unit = "m²"

    def loss_of(self, state: Any) -> Any:
        """Return the squared distance to the origin plus the cost of the push."""
        cost = PRICE * self.time * (state.ctrl[0] ** 2 + state.ctrl[1] ** 2)
        return state.qpos[2] ** 2 + state.qpos[3] ** 2 + cost

    def _closed_form(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"]:
        end = closed_forms.two_balls(x[:, :4].view(-1, 2, 2), x[:, 4:8].view(-1, 2, 2), x[:, 8:], self.time)
        return end.square().sum(dim=1) + PRICE * self.time * x[:, 8:].square().sum(dim=1)
