"""The loss over a policy's weights: closed forms of the loop, rows, and what is refused."""

import json
import math
from pathlib import Path

import pytest
import torch

import gradscape as gs
from gradscape.jobs.scene import environment_of
from gradscape.landscapes.capacity import TooLargeError
from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.policies import REACH, PolicyObjective
from gradscape.landscapes.sampling.memory import MemoryBound
from gradscape.landscapes.space import ParameterSpace

from ..command import Said

STEPS = 3


class Cart(Objective):
    """A place that each of three decisions moves by its own amount; the loss is the square of where it ends."""

    name, loss_unit, device, decisions, preferred_batch, threads = "cart", "m²", "cpu", STEPS, 8, 1
    space = ParameterSpace.box([f"push {k}" for k in range(STEPS)], -1.0, 3.0)

    def identity(self):
        return {"objective": self.name}

    def observe(self, x, decision):
        place = 2 + x[:, :decision].sum(dim=1)
        return torch.stack([place, torch.full_like(place, decision / STEPS)], dim=1)

    def evaluate(self, x, *, grad=True):
        assert not grad
        return Evaluation.from_results((2 + x.sum(dim=1)).square(), None)


def loop(weights: list[float]) -> float:
    """The loss of one hidden unit: two weights and a bias of what is seen, a weight and a bias of the answer."""
    first, second, bias, out, last = weights
    place = 2.0
    for decision in range(STEPS):
        hidden = math.tanh(first * place + second * decision / STEPS + bias)
        place += 1 + 2 * math.tanh(out * hidden + last)  # the middle of the box, and half its width
    return place**2


def test_the_policy_is_in_the_loop() -> None:
    policy = PolicyObjective(Cart(), "mlp:1")
    assert policy.space.names == (
        "layer 1 weight 0,0", "layer 1 weight 0,1", "layer 1 bias 0", "layer 2 weight 0,0", "layer 2 bias 0"
    )  # fmt: skip
    assert policy.space.upper.tolist() == pytest.approx([REACH / math.sqrt(2)] * 3 + [REACH] * 2)
    x = policy.space.uniform(16, seed=0)
    found = policy.evaluate(x, grad=False)
    assert found.loss.tolist() == pytest.approx([loop(row) for row in x.tolist()])
    alone = policy.evaluate(x[3:4], grad=False)
    assert torch.equal(alone.loss, found.loss[3:4])
    assert policy.evaluate(x[:0], grad=False).loss.shape == (0,)


def test_without_weights_every_decision_is_the_middle_of_its_box() -> None:
    env = gs.make("cartpole", device="cpu")
    policy = PolicyObjective(env, "mlp:4x3")
    wanted = env.evaluate(env.space.center[None], grad=False).loss
    assert torch.equal(policy.evaluate(policy.space.center[None], grad=False).loss, wanted)
    features = env.observe(env.space.center[None], 0).shape[1]
    assert policy.space.dim == (features + 1) * 4 + 5 * 3 + 4 * 4


@pytest.mark.parametrize("policy", ["mlp:", "mlp:0", "mlp:3x", "mlp:03", "cnn:3", "mlp", f"mlp:{'9' * 5000}"])
def test_what_is_no_policy_is_refused(policy: str) -> None:
    with pytest.raises(ValueError, match="--policy takes mlp and the sizes of its hidden layers, as mlp:32x32; got"):
        PolicyObjective(Cart(), policy)


def test_what_decides_once_and_what_is_too_large_is_refused() -> None:
    with pytest.raises(ValueError, match="bounce decides once in an episode"):
        gs.slice("bounce", along="random:0", policy="mlp:2", device="cpu")
    with pytest.raises(ValueError, match="sum decides once in an episode"):
        gs.slice(gs.from_torch(lambda x: x.sum(dim=1), Cart.space, name="sum"), along="random:0", policy="mlp:2")
    with pytest.raises(TooLargeError, match="policy"):
        PolicyObjective(Cart(), "mlp:100000x100000")
    with pytest.raises(ValueError, match="has no gradients, as what a policy sees is not differentiated"):
        PolicyObjective(Cart(), "mlp:2").evaluate(torch.zeros(1, 9, dtype=torch.float64))


def test_a_slice_over_weights_goes_on_and_is_none_of_the_scenes_own(run, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    line = ["slice", "cartpole", "--policy", "mlp:2", "--along", "random:0", "--resolution", "3", "--device", "cpu"]
    done: Said = run(*line, "--out", "cut", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert not json.loads(done.stdout)["gradients"]
    again = run(*line, "--out", "cut", cwd=tmp_path)
    assert "all 9 episodes are there already" in again.stderr
    other = run(*line[:3], "mlp:3", *line[4:], "--out", "cut", cwd=tmp_path)
    assert other.returncode == 2
    assert "policy" in other.stderr
    with pytest.raises(ValueError, match="the slice is over the weights of a policy, cartpole with policy mlp:2"):
        environment_of(gs.open_slice(tmp_path / "cut").data, "cpu")
    hessian = run(*line[:3], "mlp:8", "--along", "hessian", *line[6:], "--out", "other", cwd=tmp_path)
    assert hessian.returncode == 2
    assert "has no gradients" in hessian.stderr
    assert "30 parameters at most, and it has" in hessian.stderr
    assert not (tmp_path / "other").exists()


def test_a_policy_that_sees_what_is_not_finite_fails_alone() -> None:
    class Blinding(Cart):
        """It cannot be seen beyond a place, and refuses points that are not finite."""

        def observe(self, x, decision):
            assert bool(x.isfinite().all())
            seen = super().observe(x, decision)
            return torch.where(seen[:, :1] > 4.5, torch.nan, seen)

        def evaluate(self, x, *, grad=True):
            assert bool(x.isfinite().all())
            return super().evaluate(x, grad=grad)

    seeing, blinding = PolicyObjective(Cart(), "mlp:2"), PolicyObjective(Blinding(), "mlp:2")
    x = seeing.space.uniform(64, seed=1)
    place = 2 + seeing.decide(x).cumsum(dim=1)[:, : STEPS - 1]
    far = (place > 4.5).any(dim=1)
    assert 0 < int(far.sum()) < 64
    found, wanted = blinding.evaluate(x, grad=False), seeing.evaluate(x, grad=False)
    assert torch.equal(found.status == Status.NONFINITE, far)
    assert bool(found.loss[far].isnan().all())
    assert torch.equal(found.loss[~far], wanted.loss[~far])
    assert bool((found.status[~far] == Status.OK).all())


def test_where_memory_runs_out_the_environment_takes_fewer_rows() -> None:
    class Crowded(Cart):
        def shrink(self, rows):
            self.preferred_batch = rows

        def evaluate(self, x, *, grad=True):
            if len(x) > 3:
                raise MemoryError("out of memory")
            return super().evaluate(x, grad=grad)

    policy = PolicyObjective(Crowded(), "mlp:1")
    x = policy.space.uniform(8, seed=2)
    bound = MemoryBound(policy)
    assert torch.equal(
        bound.evaluate(x, grad=False).loss, PolicyObjective(Cart(), "mlp:1").evaluate(x, grad=False).loss
    )
    assert policy.preferred_batch == 2
    assert len(bound.take_notes()) == 2
