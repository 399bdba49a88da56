"""Replicas of scenes: the same physics computed otherwise, so their losses are near the scene's and not the same."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.envs.engines.mpm.model import walls_that_reflect
from gradscape.envs.mpm.plasticine import Plasticine
from gradscape.landscapes.measures.floor import evaluate_replicas, floor_between

# With the range of 24 losses at draft, and the largest share of it that a replica may be apart by.
SOON = [("bounce", 700.0, 1e-3), ("pinball-2", 8.0, 1e-4), ("cartpole", 2.0, 1e-5)]
LATER = [("flip", 0.8, 0.05), ("swing-velocity", 0.1, 0.05), ("pinch", 160.0, 0.02), ("fluid", 0.13, 0.2)]


@pytest.mark.parametrize(
    ("name", "wide", "most"), [*SOON, *(pytest.param(*one, marks=pytest.mark.slow) for one in LATER)]
)
def test_replicas_differ_by_little_and_not_by_nothing(name: str, wide: float, most: float) -> None:
    env = gs.make(name, device="cpu")
    x = env.space.sobol(2, seed=0)
    own = env.evaluate(x)
    found = evaluate_replicas(env, x, env.replicas(), grad=True)
    assert len(found) > 1
    for changed, other in found.items():
        floor = floor_between(own, {changed: other}, sides=env.space.upper - env.space.lower, range=wide)
        assert floor.failed == 0, changed
        assert 0 < floor.share.value < most, changed
        assert floor.cosine is not None
        assert floor.cosine.value > 0, changed


def test_every_scene_of_the_paper_has_replicas_that_can_be_made() -> None:
    """A tank's walls reflect on every grid, and the grids of plasticine cover the room though they are moved."""
    for name in ("fluid", "rope", "triple-move", "writer", "swing-stiffness", "pinball-16"):
        for env in (gs.make(name, device="cpu"), gs.make(name, fidelity="standard", device="cpu")):
            assert len(env.replicas()) > 1, name
    for replica in gs.make("fluid", device="cpu").replicas().values():
        below, above = walls_that_reflect(replica.model)  # type: ignore[attr-defined]
        assert all(below)
        assert [a - b for a, b in zip(above[::2], below[::2], strict=True)] == [24, 24]  # halves of a cell
    assert gs.make("fluid", device="cpu", walls="stick").replicas().keys() == {"other particles"}
    for replica in gs.make("torus", device="cpu").replicas().values():
        assert isinstance(replica, Plasticine)
        lower, upper = replica.scene.room()
        model = replica.model
        high = np.add(model.origin, np.multiply(np.subtract(model.nodes, 1), model.dx))
        assert (lower - model.origin >= 2 * model.dx - 1e-9).all()
        assert (high - upper >= 2 * model.dx - 1e-9).all()
        assert model.origin[1] / model.dx == pytest.approx(round(model.origin[1] / model.dx))


def test_a_mirrored_throw_agrees_to_the_last_bit() -> None:
    """So a mirrored scene is no replica that tells anything, as test_swing.py and test_cartpole.py say of theirs."""
    throw = gs.make("bounce", device="cpu")
    x = throw.space.sobol(16, seed=0)
    assert torch.equal(throw.evaluate(x).loss, throw.evaluate(x * torch.tensor([1.0, 1.0, -1.0])).loss)
