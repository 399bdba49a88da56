"""MuJoCo's simulator in JAX (MJX): chains of three links as its own model, many at once, differentiated in reverse."""

from __future__ import annotations

import argparse
import os
from importlib.metadata import version
from typing import Any

import numpy as np

from .protocol import Simulation, run
from .scenes import CHAIN, Array, Chain

DIFFERS = (
    "Its equations are of any tree of bodies, in joint angles; ours are of this chain alone.",
    "The gradient is JAX's automatic one in reverse; the states of all steps are kept.",
    "Contacts and constraints are switched off, which it would compute otherwise.",
)


def build(scene: Chain, asked: argparse.Namespace) -> Simulation:
    """Return MJX's simulation of a scene."""
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # or the device's memory says nothing
    os.environ["JAX_PLATFORMS"] = asked.device
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_default_matmul_precision", "highest")  # a GPU's products would have the digits of TF32

    each = make_loss(jax, jnp, scene)
    forward, both = jax.jit(each), jax.jit(jax.value_and_grad(lambda torques: jnp.mean(each(torques))))

    def torques(parameters: Array) -> Any:
        return jnp.asarray(scene.torques(parameters), dtype=jnp.float32)

    def gradient(parameters: Array) -> Array:
        return scene.pull_back(np.asarray(both(torques(parameters))[1], dtype=np.float64))

    return Simulation(
        version=f"mujoco-mjx {version('mujoco-mjx')}, JAX {jax.__version__}",
        material="rods",
        grid="none",
        loss=lambda parameters: float(np.asarray(forward(torques(parameters)), dtype=np.float64).mean()),
        gradient=gradient,
        differs=DIFFERS,
    )


def make_loss(jax: Any, jnp: Any, scene: Chain) -> Any:
    """Return what gives the distance [m] of tips to the target after torques [N m], shape (chain, control, 3)."""
    import mujoco
    from mujoco import mjx

    model = mjx.put_model(mujoco.MjModel.from_xml_string(describe(scene)))
    rest = mjx.make_data(model)

    def distance(torques: Any) -> Any:
        def hold(state: Any, torque: Any) -> Any:
            state = state.replace(ctrl=torque)
            return jax.lax.scan(lambda now, _: (mjx.step(model, now), None), state, length=scene.hold)

        state, _ = jax.lax.scan(hold, rest, torques)
        angles = jnp.cumsum(state.qpos)
        across, up = jnp.sum(jnp.sin(angles)), -jnp.sum(jnp.cos(angles))
        return jnp.sqrt(across**2 + (up - scene.target) ** 2)

    return jax.vmap(distance)


def describe(scene: Chain) -> str:
    """Return the chain in MuJoCo's own language: uniform rods of 1 m that hang along -z and turn in one plane."""
    inner = ""
    for k in reversed(range(3)):
        mass, top = scene.masses[k], 0 if k == 0 else -1
        inner = (
            f'<body pos="0 0 {top}"><joint name="j{k}" type="hinge" axis="0 -1 0"/>'
            f'<inertial pos="0 0 -0.5" mass="{mass}" diaginertia="{mass / 12} {mass / 12} 1e-6"/>{inner}</body>'
        )
    motors = "".join(f'<motor joint="j{k}"/>' for k in range(3))
    return (
        f'<mujoco><option timestep="{scene.dt}" gravity="0 0 {-scene.gravity}" integrator="RK4">'
        '<flag contact="disable" constraint="disable"/></option>'
        f"<worldbody>{inner}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


if __name__ == "__main__":
    run(CHAIN, build)
