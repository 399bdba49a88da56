"""Environments over a policy's weights: closed forms of the loop and its gradients, rows, and what is refused."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.envs.policies import REACH, with_policy
from gradscape.jobs.scene import environment_of
from gradscape.landscapes.capacity import TooLargeError
from gradscape.landscapes.objective import Evaluation, Status
from gradscape.landscapes.sampling.memory import MemoryBound
from gradscape.landscapes.space import ParameterSpace

from ..command import Said

STEPS = 3


class Cart(gs.Environment):
    """A place that each of three decisions moves by its own amount; the loss is the square of where it ends."""

    name, loss_unit, decisions, model_version, differentiates_observations = "cart", "m²", STEPS, 0, True
    space = ParameterSpace.box([f"push {k}" for k in range(STEPS)], -1.0, 3.0)

    def _observe(self, x, decision):
        return 2 + x[:, :decision].sum(dim=1, keepdim=True)

    def _pull_back_observation(self, x, decision, weight):
        return weight.expand(-1, STEPS).clone()

    def _evaluate(self, x, *, grad):
        end = 2 + x.sum(dim=1)
        return Evaluation.from_results(end.square(), (2 * end)[:, None].expand_as(x).clone() if grad else None)


class Hidden(Cart):
    """The same, which does not differentiate what it shows."""

    differentiates_observations = False


def loop(weights: torch.Tensor) -> torch.Tensor:
    """The loss of one hidden unit: two weights and a bias of what is seen, a weight and a bias of the answer."""
    first, second, bias, out, last = weights
    place = torch.tensor(2.0).double()
    for decision in range(STEPS):
        hidden = torch.tanh(first * place + second * decision / STEPS + bias)
        place = place + 1 + 2 * torch.tanh(out * hidden + last)  # the middle of the box, and half its width
    return place**2


def test_the_policy_is_in_the_loop_and_so_are_its_gradients() -> None:
    policy = with_policy(Cart(), "mlp:1")
    assert policy.space.names == (
        "layer 1 weight 0,0", "layer 1 weight 0,1", "layer 1 bias 0", "layer 2 weight 0,0", "layer 2 bias 0"
    )  # fmt: skip
    assert policy.space.upper.tolist() == pytest.approx([REACH / math.sqrt(2)] * 3 + [REACH] * 2)
    x = policy.space.uniform(16, seed=0)
    found = policy.evaluate(x)
    losses = torch.stack([loop(row) for row in x])
    slopes = torch.stack([torch.autograd.functional.jacobian(loop, row) for row in x])
    torch.testing.assert_close(found.loss, losses, rtol=1e-12, atol=0)
    torch.testing.assert_close(found.grad, slopes, rtol=1e-9, atol=1e-12)
    alone = policy.evaluate(x[3:4])
    assert torch.equal(alone.loss, found.loss[3:4])
    assert torch.equal(alone.grad, found.grad[3:4])
    assert policy.evaluate(x[:0], grad=False).loss.shape == (0,)


def test_cartpoles_gradients_by_weights_are_the_slopes_of_its_losses() -> None:
    """Differences of losses fall by a hundred with the square of their step, down to rounding."""
    exact = gs.Fidelity("exact", dt=0.02, precision="float64")
    policy = gs.SceneSpec("cartpole", fidelity=exact, device="cpu", policy="mlp:3").make()
    x = 0.3 * policy.space.uniform(3, seed=1)
    along = torch.randn(policy.space.dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    slope = policy.evaluate(x).grad @ along
    off = []
    for step in (1e-3, 1e-4):
        ends = policy.evaluate(torch.cat([x + step * along, x - step * along]), grad=False).loss.view(2, -1)
        off.append(float(((ends[0] - ends[1]) / (2 * step) / slope - 1).abs().max()))
    assert off[1] < 1e-4
    assert off[1] == pytest.approx(off[0] / 100, rel=0.1)


def test_without_weights_every_decision_is_the_middle_of_its_box() -> None:
    env = gs.make("cartpole", device="cpu")
    policy = with_policy(env, "mlp:4x3")
    wanted = env.evaluate(env.space.center[None], grad=False).loss
    assert torch.equal(policy.evaluate(policy.space.center[None], grad=False).loss, wanted)
    features = env.observe(env.space.center[None], 0).shape[1]
    assert policy.space.arrays == {
        "layer 1 weight": (4, features), "layer 1 bias": (4,), "layer 2 weight": (3, 4), "layer 2 bias": (3,),
        "layer 3 weight": (4, 3), "layer 3 bias": (4,),
    }  # fmt: skip
    assert policy.episode(policy.space.center).time.shape == env.episode(env.space.center).time.shape
    assert policy.horizon is None
    with pytest.raises(ValueError, match="decides whole episodes"):
        policy.with_horizon(0.5)


@pytest.mark.parametrize("policy", ["mlp:", "mlp:0", "mlp:3x", "mlp:03", "cnn:3", "mlp", f"mlp:{'9' * 5000}"])
def test_what_is_no_policy_is_refused(policy: str) -> None:
    with pytest.raises(ValueError, match="takes mlp and the sizes of its hidden layers, such as mlp:32x32; got"):
        with_policy(Cart(), policy)


def test_what_decides_once_and_what_is_too_large_is_refused() -> None:
    with pytest.raises(ValueError, match="bounce decides once in an episode"):
        gs.slice("bounce", along="random:0", policy="mlp:2", device="cpu")
    with pytest.raises(ValueError, match="sum decides once in an episode"):
        gs.slice(gs.from_torch(lambda x: x.sum(dim=1), Cart.space, name="sum"), along="random:0", policy="mlp:2")
    with pytest.raises(TooLargeError, match="policy"):
        with_policy(Cart(), "mlp:100000x100000")


def test_where_what_is_seen_is_not_differentiated_losses_are_all_there_is() -> None:
    hidden = with_policy(Hidden(), "mlp:2")
    x = hidden.space.uniform(2, seed=0)
    with pytest.raises(ValueError, match="has no gradients, because its observations are not differentiated"):
        hidden.evaluate(x)
    assert torch.equal(hidden.evaluate(x, grad=False).loss, with_policy(Cart(), "mlp:2").evaluate(x, grad=False).loss)
    assert "grad" not in gs.slice(Hidden(), policy="mlp:2", along="random:0", resolution=3).data
    estimated = gs.slice(Hidden(), policy="mlp:2", remedy="smooth:1%:zeroth:4", along="random:0", resolution=3)
    assert "grad" in estimated.data


def test_a_slice_over_weights_goes_on_and_is_none_of_the_scenes_own(run, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    line = ["slice", "cartpole", "--policy", "mlp:2", "--along", "random:0", "--resolution", "3", "--device", "cpu"]
    done: Said = run(*line, "--out", "cut", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["gradients"]
    again = run(*line, "--out", "cut", cwd=tmp_path)
    assert "all 9 episodes with gradients are done already" in again.stderr
    other = run(*line[:3], "mlp:3", *line[4:], "--out", "cut", cwd=tmp_path)
    assert other.returncode == 2
    assert "policy" in other.stderr
    cut = gs.open_slice(tmp_path / "cut")
    made = environment_of(cut.data, "cpu")
    assert made.identity() == gs.SceneSpec("cartpole", device="cpu", policy="mlp:2").make().identity()
    center = cut.plane.lift(torch.zeros(1, 2, dtype=torch.float64))
    assert float(made.evaluate(center, grad=False).loss[0]) == float(cut.data.loss[1, 1])


def test_remedies_are_of_the_policys_landscape() -> None:
    made = gs.SceneSpec(Cart, policy="mlp:1", remedy="clip:0.5").make()
    x = made.space.uniform(8, seed=0)
    found, plain = made.evaluate(x), with_policy(Cart(), "mlp:1").evaluate(x)
    sides = made.space.upper - made.space.lower
    assert float((found.grad * sides).norm(dim=1).max()) == pytest.approx(0.5)
    assert torch.equal(found.loss, plain.loss)
    assert torch.equal(made.plain_point(x), x)
    assert gs.SceneSpec.of(made).make().identity() == made.identity()


def test_a_policy_that_sees_what_is_not_finite_fails_alone() -> None:
    class Blinding(Cart):
        """It cannot be seen beyond a place, and refuses points that are not finite."""

        def _observe(self, x, decision):
            assert bool(x.isfinite().all())
            seen = super()._observe(x, decision)
            return torch.where(seen > 4.5, torch.nan, seen)

    seeing, blinding = with_policy(Cart(), "mlp:2"), with_policy(Blinding(), "mlp:2")
    x = seeing.space.uniform(64, seed=1)
    place = 2 + seeing.remedy.to_inner(Cart(), x).cumsum(dim=1)[:, : STEPS - 1]
    far = (place > 4.5).any(dim=1)
    assert 0 < int(far.sum()) < 64
    found, wanted = blinding.evaluate(x), seeing.evaluate(x)
    assert torch.equal(found.status == Status.NONFINITE, far)
    assert bool(found.loss[far].isnan().all())
    assert torch.equal(found.loss[~far], wanted.loss[~far])
    assert torch.equal(found.grad[~far], wanted.grad[~far])
    assert bool((found.status[~far] == Status.OK).all())


def test_where_memory_runs_out_the_environment_takes_fewer_rows() -> None:
    class Crowded(Cart):
        def _evaluate(self, x, *, grad):
            if len(x) > 3:
                raise MemoryError("out of memory")
            return super()._evaluate(x, grad=grad)

    policy = with_policy(Crowded(), "mlp:1")
    x = policy.space.uniform(8, seed=2)
    bound = MemoryBound(policy)
    assert torch.equal(bound.evaluate(x, grad=False).loss, with_policy(Cart(), "mlp:1").evaluate(x, grad=False).loss)
    assert bound.take_notes()


def test_a_policy_is_searched_like_any_environment() -> None:
    run = gs.optimize(Cart, "adam", policy="mlp:2", budget=40, seed=0)
    assert np.fmin.accumulate(run.data.loss.to_numpy())[-1] < 0.1 * float(run.data.loss[0])
