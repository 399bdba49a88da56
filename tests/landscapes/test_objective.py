"""Nothing is asked of an objective beyond its bounds unless it invites that."""

import numpy as np
import pytest
import torch

from gradscape import Evaluation, ParameterSpace, Plane, Status, from_numpy, sample
from gradscape.landscapes.checks.suite import check
from gradscape.landscapes.measures.gradient_quality import compare_differences, subgrid
from gradscape.landscapes.measures.profile import OutsideBounds, measure_profile
from gradscape.landscapes.measures.sensitivity import Design, explore
from gradscape.landscapes.objective import BoxedObjective, Objective, evaluate, failed, has_loss
from gradscape.landscapes.storage.checkpoint import Checkpoint
from gradscape.studies.samples import measure

BOUNDS = torch.tensor([[-1.0, 0.1, -3.0], [2.0, 0.7, 3.0]], dtype=torch.float64)
SPACE = ParameterSpace(("a", "b", "c"), *BOUNDS, ("", "m", "s"))


class Strict(Objective):
    """A bowl that refuses whatever lies beyond its bounds, by as little as one part in 10^12, as many functions do."""

    space, name = SPACE, "strict"

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        if x.shape[1:] != (3,):
            raise ValueError(f"strict takes 3 parameters; got x of shape {tuple(x.shape)}")
        unit = self.space.to_unit(x)
        if bool(((unit < 0) | (unit > 1)).any()):
            raise ValueError("Expected `x` to be within the bounds")
        return Evaluation.from_results((x**2).sum(dim=1), 2 * x if grad else None)


class Inviting(Strict):
    """The same bowl, which is one beyond its bounds too."""

    beyond_box = True

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        return Evaluation.from_results((x**2).sum(dim=1), 2 * x if grad else None)


def plane(*dims: str | int, **how) -> Plane:
    return Plane.through(SPACE, SPACE.center, dims or ("a", "b"), **{"resolution": 9, **how})


def test_points_beyond_have_left_the_domain_and_the_others_their_losses():
    x = torch.stack([SPACE.lower, SPACE.center, SPACE.upper, SPACE.upper + 1e-3, SPACE.lower - 1])
    found = evaluate(Strict(), x, grad=True)
    assert found.status.tolist() == [Status.OK] * 3 + [Status.ESCAPED] * 2
    torch.testing.assert_close(found.loss[:3], (x[:3] ** 2).sum(dim=1))
    assert bool(found.loss[3:].isnan().all() & found.grad[3:].isnan().all())
    assert evaluate(Strict(), x[3:], grad=False).status.tolist() == [Status.ESCAPED] * 2
    assert evaluate(Inviting(), x, grad=True).status.tolist() == [Status.OK] * 5
    assert evaluate(BoxedObjective(Inviting()), x, grad=True).status.tolist() == found.status.tolist()


def test_a_window_beyond_the_box_shows_what_lies_in_it():
    cut = sample(Strict(), plane(window=((-1.0, 0.1), (2.0, 1.3))))
    assert (cut["status"].sel(v=slice(0.75, None)) == Status.ESCAPED).all()
    assert (cut["status"].sel(v=slice(None, 0.7)) == Status.OK).all()


@pytest.mark.parametrize("dims", [("a", "b"), ("c",)])
def test_a_report_leaves_out_what_it_may_not_ask_for_and_says_how_much(dims):
    strict, free = (
        measure_profile(one, sample(one, plane(*dims)), rounding=1e-16, points=8) for one in (Strict(), Inviting())
    )
    probes = strict.beyond_the_box
    assert 0 < probes.cut < probes.asked / 10
    assert free.beyond_the_box == OutsideBounds(probes.asked, 0)
    said = f"{probes.cut} of {probes.asked}"
    assert strict.measures["Probes outside the bounds, left out"] == said
    assert "Probes outside the bounds, left out" not in free.measures
    assert strict.verdict.words == free.verdict.words
    known = np.isfinite(strict.quality.smooth["first"])
    assert float(known.mean()) > 0.9
    np.testing.assert_allclose(
        strict.quality.smooth["first"].where(known), free.quality.smooth["first"].where(known), atol=1.0
    )


def test_differences_over_long_steps_are_there_where_both_ends_are():
    u = subgrid(plane(), 12)  # closer to the border than half of the longest step
    found = compare_differences(Strict(), plane(), u).sel(scale=[1e-3, 1e-1])
    share = np.isfinite(found["cosine"]).mean("point").to_numpy()
    assert share[0] == 1
    assert 0.5 < share[1] < 1
    np.testing.assert_allclose(found["cosine"].where(np.isfinite(found["cosine"]), 1.0), 1.0, rtol=1e-6)


@pytest.mark.slow
def test_pairs_checks_and_trade_offs_ask_nothing_beyond(tmp_path):
    design = Design.sobol(SPACE, 4, seed=0)
    found = explore(Strict(), design, Checkpoint.open(tmp_path / "p", {}, what="pairs"))
    assert found.failed == 0
    assert (measure(Strict(), SPACE.sobol(4, seed=0)).status == Status.OK).all()
    outcomes = {finding.check: finding for finding in check(Strict())}
    assert {finding.outcome for finding in outcomes.values()} <= {"pass", "skip"}
    assert "it is undefined outside its bounds" in outcomes["10% outside the box"].why
    invited = {finding.check: finding for finding in check(Inviting())}
    assert invited["10% outside the box"].outcome == "pass"


def test_differences_of_a_function_stay_within_its_bounds():
    def strict(x: np.ndarray) -> np.ndarray:
        unit = SPACE.to_unit(torch.from_numpy(x))
        assert bool(((unit >= 0) & (unit <= 1)).all())
        return (x**2).sum(axis=1)

    objective = from_numpy(strict, SPACE, differences=1e-4)
    x = torch.stack([SPACE.lower, SPACE.center, SPACE.upper])
    torch.testing.assert_close(objective.evaluate(x).grad, 2 * x, rtol=1e-3, atol=1e-3)


def test_evaluations_of_several_batches_are_joined_in_order():
    x = torch.tensor([[0.25, 0.5, 0.0], [9.0, 0.5, 0.0], [0.75, 0.5, 0.0]], dtype=torch.float64)
    whole = evaluate(Strict(), x, grad=True)
    parts = [evaluate(Strict(), rows, grad=True) for rows in x.split(2)]
    joined = Evaluation.join(parts, dim=3, grad=True)
    for name in ("loss", "grad", "status"):
        assert torch.equal(getattr(joined, name).nan_to_num(-1.0), getattr(whole, name).nan_to_num(-1.0))
    assert joined.rows(slice(1, 3)).status.tolist() == whole.status.tolist()[1:]
    assert Evaluation.join(parts, dim=3, grad=False).grad is None
    assert Evaluation.join([], dim=3, grad=True).grad.shape == (0, 3)
    with pytest.raises(ValueError, match="cannot join gradients: 1 of 3 evaluations have none"):
        Evaluation.join([*parts, evaluate(Strict(), x, grad=False)], dim=3, grad=True)


def test_a_loss_without_a_gradient_is_kept():
    nan, inf = float("nan"), float("inf")
    loss = torch.tensor([1.0, 2.0, nan, 4.0, 5.0, inf], dtype=torch.float64)
    grad = torch.tensor([[1.0, 1], [nan, 1], [1, 1], [1, 1], [1, -inf], [nan, 1]], dtype=torch.float64)
    given = torch.tensor([Status.OK, Status.OK, Status.OK, Status.ERROR, Status.OK, Status.NO_GRADIENT])
    found = Evaluation.from_results(loss, grad, given, "RuntimeError: too much work")
    ended = [Status.OK, Status.NO_GRADIENT, Status.NONFINITE, Status.ERROR, Status.NO_GRADIENT, Status.NONFINITE]
    assert found.status.tolist() == ended
    assert found.loss.nan_to_num(-1).tolist() == [1, 2, -1, -1, 5, -1]
    assert found.grad.isnan().all(dim=1).tolist() == [False, *[True] * 5]
    assert found.has_loss.tolist() == [True, True, False, False, True, False]
    assert found.has_gradient.tolist() == [True, *[False] * 5]
    assert found.failed.tolist() == (~found.has_loss).tolist()
    alone = Evaluation.judged(loss, None, found.status)  # by its first name
    assert alone.status.tolist()[:2] == [Status.OK] * 2
    assert not alone.has_gradient.any()


def test_statuses_are_told_apart_in_tensors_and_arrays_alike():
    codes = np.array(list(Status), dtype=np.int8)
    told = [Status.OK, Status.NO_GRADIENT], [Status.NONFINITE, Status.ESCAPED, Status.ERROR]
    for ask, kinds in zip((has_loss, failed), told, strict=True):
        assert ask(torch.from_numpy(codes)).tolist() == ask(codes).tolist() == [one in kinds for one in Status]
        assert all(ask(kind) for kind in kinds)


def test_the_message_of_the_first_point_that_raised_stays_with_its_points():
    def part(status: Status, error: str) -> Evaluation:
        loss = torch.zeros(2, dtype=torch.float64)
        return Evaluation.from_results(loss, None, torch.tensor([Status.OK, status]), error)

    parts = [part(Status.OK, ""), part(Status.ERROR, "first"), part(Status.ERROR, "second")]
    whole = Evaluation.join(parts, dim=1, grad=False)
    assert whole.error == "first"
    assert whole.rows(slice(2, 4)).error == "first"
    assert whole.rows(slice(0, 3)).error == ""

    class Raises(Strict):
        def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
            return part(Status.ERROR, "RuntimeError: no").rows(slice(1, 1 + len(x)))

    inside = torch.stack([SPACE.center, SPACE.upper + 1.0])
    assert evaluate(Raises(), inside, grad=False).error == "RuntimeError: no"
