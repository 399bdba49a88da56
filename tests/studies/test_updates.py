"""The study of updates: the distribution after one update of a quadratic, in closed form, and what is refused."""

import math

import numpy as np
import pytest
from scipy.stats import norm

import gradscape as gs
from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.storage.records import read_json
from gradscape.studies.updates import QUANTILES, Outcomes, UpdatesRecord

H, START, NOISE, RATE, COUNT = 3.0, 2.0, 0.05, 0.45, 4000
SPACE = gs.ParameterSpace({"x": (-10.0, 6.0)})
PARABOLA = gs.from_torch(lambda x: H / 2 * x[:, 0] ** 2, SPACE, name="parabola")


class Blind(gs.Environment):
    """Two decisions of which nothing is seen that could be differentiated."""

    space, decisions = gs.ParameterSpace.box(["a", "b"], -1, 1), 2

    def _evaluate(self, x, *, grad):
        return gs.Evaluation.from_results((x**2).sum(dim=1), 2 * x if grad else None)


def after(level: float) -> float:
    """Return the probability that the loss is above a level after x - rate H (x + s w), which is normal."""
    mean, sd, ends = (1 - RATE * H) * START, RATE * H * NOISE * 16, math.sqrt(2 * level / H)
    return float(norm.cdf((-ends - mean) / sd) + norm.sf((ends - mean) / sd))


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    out = tmp_path_factory.mktemp("updates") / "study"
    return gs.study("updates", PARABOLA, through=[START], points=COUNT, noise="5%", rate=RATE, out=out), out


def test_losses_after_an_update_of_a_quadratic_are_distributed_as_in_closed_form(found):
    record, _ = found
    assert record.before == pytest.approx(H / 2 * START**2)
    far = math.sqrt(math.log(2e6) / 2 / COUNT)  # what the empirical distribution is off at most, but once in a million
    for share, loss in zip(QUANTILES, record.along.quantiles, strict=True):
        assert 1 - after(loss) == pytest.approx(share, abs=far)
    mean, sd = (1 - RATE * H) * START, RATE * H * NOISE * 16
    assert record.along.mean.low < H / 2 * (mean**2 + sd**2) < record.along.mean.high
    assert record.zero == pytest.approx(H / 2 * 2.0**2)  # at the centre of the box
    lengths = RATE * H * np.abs(START + NOISE * 16 * norm.ppf([0.5])) / 16
    assert record.length == pytest.approx(float(lengths[0]), rel=0.05)


def test_shares_hold_the_exact_probabilities(found):
    record, _ = found
    assert record.along.worse.low < after(record.before) < record.along.worse.high
    twice, sd = 2 * START / (RATE * H), NOISE * 16
    far = float(norm.sf((twice - START) / sd) + norm.cdf((-twice - START) / sd)) / 2
    assert record.random.worse.low < 0.5 + far < record.random.worse.high  # up is worse, and down by twice the way


def test_the_left_tail_is_below_half_the_mode_of_returns():
    losses = np.array([10.0 - 8.0] * 50 + [10.0 - 7.9] * 10 + [10.0 - 3.9] * 5 + [np.nan] * 3 + [10.0 - 4.1] * 32)
    one = Outcomes.of("", losses, before=3.0, zero=10.0)
    assert one.tail_from == pytest.approx(10.0 - 0.5 * 8.0, abs=0.05)
    assert one.tail.value == 0.08
    assert one.worse.value == 0.40
    assert one.failed == 3
    assert one.quantiles[-1] == pytest.approx(6.1)
    none = Outcomes.of("", losses, before=3.0, zero=1.0)
    assert math.isnan(none.tail.value)
    same = Outcomes.of("", np.full(9, 4.0), before=4.0, zero=10.0)
    assert (same.tail_from, same.tail.value, same.worse.value) == (7.0, 0.0, 0.0)


def test_a_gradient_beats_random_steps_on_a_bowl_and_a_wrong_one_does_not(tmp_path):
    names = [f"w{k}" for k in range(12)]
    bowl = gs.from_numpy(lambda x: ((x**2).sum(1), 2 * x), gs.ParameterSpace.box(names, -1, 1), name="bowl")
    wrong = gs.from_numpy(lambda x: ((x**2).sum(1), -2 * x), gs.ParameterSpace.box(names, -1, 1), name="wrong")
    right, other = (gs.study("updates", one, through="random:1", points=64, out=tmp_path / one.name)
                    for one in (bowl, wrong))  # fmt: skip
    assert right.length == pytest.approx(0.01, rel=1e-6)
    assert right.lower.low > 0.9
    assert right.along.worse.high < 0.1
    assert other.lower.high < 0.1
    assert other.along.worse.low > 0.9


def test_a_record_is_kept_and_a_study_goes_on(found):
    record, out = found
    assert to_json(from_json(UpdatesRecord, read_json(out / "updates.json"))) == to_json(record)
    again = gs.study("updates", PARABOLA, through=[START], points=COUNT, noise="5%", rate=RATE, out=out)
    assert again.along == record.along
    with pytest.raises(ValueError, match="rate"):
        gs.study("updates", PARABOLA, through=[START], points=COUNT, noise="5%", rate=0.1, out=out)
    assert list(record.table().index) == ["along the gradient", "random steps as long"]


def test_what_cannot_be_studied_is_refused(tmp_path):
    with pytest.raises(ValueError, match="cartpole with policy mlp:2") as told:
        gs.study("updates", "cartpole", policy="mlp:2", through=[0.0], out=tmp_path / "a", device="cpu")
    assert "takes 38 parameters" in str(told.value)
    with pytest.raises(ValueError, match="blind with policy mlp:2 has no gradients to follow"):
        gs.study("updates", Blind, policy="mlp:2", out=tmp_path / "b")
    with pytest.raises(ValueError, match="noise takes a positive number"):
        gs.study("updates", PARABOLA, noise=0.0, out=tmp_path / "c")
    with pytest.raises(ValueError, match="study symmetry takes points, seed; got through"):
        gs.study("symmetry", gs.from_torch(lambda x: x[:, 0], SPACE, replicas={"b": lambda x: x[:, 0]}),
                 through="center", out=tmp_path / "d")  # fmt: skip
    broken = gs.from_numpy(lambda x: (np.where(x[:, 0] > 0, np.nan, x[:, 0]), np.ones_like(x)), SPACE, name="broken")
    with pytest.raises(ValueError, match="broken has no loss or no gradient at a point"):
        gs.study("updates", broken, through=[1.0], points=8, out=tmp_path / "e")
