"""benchmarks/diagnosis: planted defects are defects and healthy functions are right, whatever a check says of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache

import pytest
import torch
from benchmarks.diagnosis.__main__ import main, missed
from benchmarks.diagnosis.cases import Case
from benchmarks.diagnosis.catalogue import defects, healthy_functions
from benchmarks.diagnosis.examine import Result, Slabs, is_placed, slabs_of
from benchmarks.diagnosis.peers import PEERS, Peer, ask
from benchmarks.diagnosis.systems import CART
from torch import Tensor

import gradscape as gs
from gradscape.landscapes.checks.diagnosis import Diagnosis, Region
from gradscape.landscapes.objective import Status

DEFECTS, HEALTHY = defects(), healthy_functions()
SHORT = [10.0**-k for k in range(2, 9)]  # of differences, in shares of the box
STEPS = [*SHORT, 0.03, 0.1]  # those over which a loss with a large offset is smooth, too
RIGHT = 1e-3  # of the longest slope at a point, by which a right gradient may be off
WRONG = 3e-3  # the same, by which a wrong one is off at least
TINY = 1e-300


@pytest.fixture(autouse=True)
def _seeded() -> Iterator[None]:
    """Let what draws without a seed draw the same at each run of the tests."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def of_kind(*evidence: str) -> pytest.MarkDecorator:
    chosen = [case for case in DEFECTS if case.evidence in evidence]
    return pytest.mark.parametrize("case", chosen, ids=lambda case: case.name)


@cache
def made(case: Case) -> gs.Environment:
    """Return the objective of a case that keeps nothing between calls, compiled once."""
    return case.build()


def points(case: Case, env: gs.Environment, count: int = 5) -> Tensor:
    """Return random points of a case, or its place several times."""
    if case.place is None:
        x = env.space.uniform(count, seed=3)
    else:
        share = torch.tensor(case.place, dtype=torch.float64)
        x = (env.space.lower + share * (env.space.upper - env.space.lower)).expand(count, -1)
    return x.clone()


def inside(case: Case, env: gs.Environment, *, wanted: bool = True, count: int = 5) -> Tensor:
    """Return points in the region of a case, or outside it."""
    assert case.region is not None
    x = env.space.uniform(4000, seed=4)
    return x[case.region(x) == wanted][:count]


def losses_of(case: Case, env: gs.Environment) -> Callable[[Tensor], Tensor]:
    if (reference := case.reference) is None:
        return lambda x: env.evaluate(x, grad=False).loss
    return lambda x: torch.from_numpy(reference(env.space.to_values(x).numpy()))


def apart(case: Case, env: gs.Environment, x: Tensor, grad: Tensor, steps: list[float] = STEPS) -> Tensor:
    """Return by how much slopes are off differences at the step where they are nearest, shape (batch, dim).

    It is relative to the longest slope of the point; both are per width of the box.
    """
    width, losses = env.space.upper - env.space.lower, losses_of(case, env)
    sign, count = -1.0 if getattr(env, "function").maximize and case.reference else 1.0, len(x)  # noqa: B009
    found = []
    for h in steps:
        move = h * torch.diag(width)
        ahead = torch.minimum(x[:, None] + move, env.space.upper)
        behind = torch.maximum(x[:, None] - move, env.space.lower)
        both = losses(torch.cat([ahead, behind]).reshape(-1, env.space.dim))
        rise = sign * (both[: count * env.space.dim] - both[count * env.space.dim :]).reshape(count, -1)
        found.append(rise / ((ahead - behind).diagonal(dim1=1, dim2=2) / width))
    slopes = torch.stack(found)
    given = grad * width
    off = (slopes - given).abs().nan_to_num(torch.inf).amin(0)
    longest = torch.maximum(given.abs().amax(1), slopes.abs().nanmedian(0).values.amax(1))
    return off / longest.clamp(min=TINY)[:, None]


def test_there_are_as_many_cases_as_were_promised() -> None:
    cases = DEFECTS + HEALTHY
    assert len({case.name for case in cases}) == len(cases)
    assert len(DEFECTS) >= 66
    assert len(HEALTHY) >= 44
    assert len({case.kind for case in DEFECTS}) >= 20
    assert {case.framework for case in DEFECTS} == {"torch", "jax", "numpy", "warp"}
    assert {2, 10, 100} <= Counter(case.dim for case in DEFECTS).keys()


@pytest.mark.parametrize("case", DEFECTS + HEALTHY, ids=lambda case: case.name)
def test_a_case_is_what_it_says_and_has_losses(case: Case) -> None:
    env = made(case)
    assert (env.name, env.space.dim) == (case.name, case.dim)
    assert {*case.parameters, *case.edges} <= {*env.space.names}
    assert env.evaluate(env.space.uniform(16, seed=0)).has_loss.any()


@pytest.mark.parametrize("case", HEALTHY, ids=lambda case: case.name)
def test_a_healthy_function_has_the_slopes_of_its_loss(case: Case) -> None:
    env = made(case)
    x = points(case, env)
    found = env.evaluate(x)
    assert found.has_gradient.all()
    assert found.grad is not None
    assert apart(case, env, x, found.grad).median(0).values.max() < RIGHT


@of_kind("gradient")
def test_a_wrong_gradient_is_no_slope_of_the_loss(case: Case) -> None:
    env = made(case)
    x = points(case, env) if case.region is None else inside(case, env)
    found = env.evaluate(x)
    assert found.grad is not None
    off = apart(case, env, x, found.grad, SHORT)
    assert off.amax(1).median() > WRONG
    if case.parameters:
        named = torch.tensor([name in case.parameters for name in env.space.names])
        assert (off[:, ~named].median(0).values < RIGHT).all()
        assert (off[:, named].amax(0) > WRONG / 100).all()
    if case.region is not None:
        x = inside(case, env, wanted=False)
        assert apart(case, env, x, env.evaluate(x).grad).median(0).values.max() < RIGHT  # type: ignore[arg-type]


@of_kind("nan")
def test_a_gradient_that_is_nan_stands_beside_a_finite_loss(case: Case) -> None:
    env = made(case)
    x = points(case, env) if case.region is None else inside(case, env)
    assert (env.evaluate(x).status == Status.NO_GRADIENT).all()
    if case.region is not None:
        assert env.evaluate(inside(case, env, wanted=False)).has_gradient.all()


@of_kind("wide")
def test_a_gradient_at_steps_is_right_between_them_and_wrong_across(case: Case) -> None:
    env = made(case)
    x = points(case, env, 40)
    grad = env.evaluate(x).grad
    assert grad is not None
    near, far = (apart(case, env, x, grad, steps) for steps in (SHORT, [0.1]))
    named = [env.space.names.index(name) for name in case.parameters] or range(case.dim)
    assert near.amax(1).median() < 10 * RIGHT or grad.abs().max() == 0
    assert far[:, list(named)].amax(1).median() > 0.2


def shows_itself(case: Case, env: gs.Environment, x: Tensor) -> bool:
    """Say whether a defect shows itself as its case says."""
    found = env.evaluate(x)
    assert found.grad is not None
    match case.evidence:
        case "repeat":  # the same call gives another result
            again = env.evaluate(x)
            assert again.grad is not None
            return not torch.equal(found.loss, again.loss) or not torch.equal(found.grad, again.grad)
        case "rows":  # a row depends on others
            alone = torch.cat([env.evaluate(row[None]).loss for row in x[:5]])
            return bool((env.evaluate(x[:5]).loss - alone).abs().max() > 1e-3)
        case "losses":  # a loss is another one where a gradient is asked for
            return bool((found.loss - env.evaluate(x, grad=False).loss).abs().max() > 1e-3)
        case "growth":
            return bool(found.grad.norm(dim=1).median() > 1e6)
        case _:  # each call keeps memory
            kept = getattr(env, "function").fn.history  # noqa: B009
            return all(env.evaluate(x) and sum(map(Tensor.numel, kept)) * 8 >= count * 2**19 for count in (2, 3))


@of_kind("repeat", "rows", "losses", "growth", "memory")
def test_a_defect_of_calls_shows_itself(case: Case) -> None:
    env = case.build()
    assert shows_itself(case, env, points(case, env, 40 if case.evidence == "growth" else 5))


@of_kind("finer")
def test_a_gradient_at_the_coarse_step_is_the_program_s_and_not_the_finer_step_s(case: Case) -> None:
    env = case.build()
    x = points(case, env, 40)
    coarse, fine = env.evaluate(x).grad, env.remake(fidelity="reference").evaluate(x).grad
    assert coarse is not None
    assert fine is not None
    assert apart(case, env, x, coarse).amax(1).median() < RIGHT
    assert ((coarse - fine).norm(dim=1) / fine.norm(dim=1)).median() > 0.3


@pytest.mark.parametrize("case", [case for case in DEFECTS if case.step], ids=lambda case: case.name)
def test_a_gradient_that_is_wrong_after_a_step_is_right_up_to_it(case: Case) -> None:
    assert case.step is not None
    right, wrong = (case.build().with_horizon(case.step + more) for more in (0, 10))
    x = points(case, right)
    for env, ok in ((right, True), (wrong, False)):
        grad = env.evaluate(x).grad
        assert grad is not None
        assert (apart(case, env, x, grad).max() < RIGHT) == ok


# ---- How answers are counted.


def named(name: str) -> Case:
    return next(case for case in DEFECTS if case.name == name)


def told(*parameters: str, rule: str = "", what: str = "") -> list[Diagnosis]:
    region = Region(rule, parameters, 0.0, 59) if rule else None
    return [Diagnosis("sign", "fail", "certain", what, "", () if rule else parameters, region)]


@pytest.mark.parametrize(
    ("case", "diagnoses", "right"),
    [
        ("region-jax-springs-10-5%", told("stiffness 3", rule="stiffness 3 between 119 and 126 N/m"), True),
        ("region-jax-springs-10-5%", told("stiffness 3", rule="stiffness 3 above 119 N/m"), False),
        ("region-jax-springs-10-5%", told("stiffness 4", rule="stiffness 4 between 119 and 126 N/m"), False),
        ("region-numpy-gas-2-two", told("temperature", "pressure", rule="pressure > 1.6e+05, temperature < 301"), True),
        ("region-numpy-gas-2-two", told("pressure", rule="pressure above 1.59e+05 Pa"), False),
        ("sign-of-one-torch-springs-10", told("stiffness 3"), True),
        ("sign-of-one-torch-springs-10", told("stiffness 3", "stiffness 4"), False),
        ("truncated-numpy-short-adjoint-100", told(*(f"force {k}" for k in range(57))), True),
        ("truncated-numpy-short-adjoint-100", told(*(f"force {k}" for k in range(30))), False),
        ("late-jax-late-2", told(what="the gradient is right up to 20 steps, and wrong after 21"), True),
        ("late-jax-late-2", told(what="the gradient is wrong after 35 steps"), False),
    ],
)
def test_a_place_is_named_where_parameters_and_edges_are(case: str, diagnoses: list[Diagnosis], right: bool) -> None:
    chosen = named(case)
    assert is_placed(chosen, chosen.build().space, diagnoses) == right


def result(*, healthy: bool = False, passed: bool = False, found: bool = True, place: bool | None = True) -> Result:
    return Result("case", "kind", "torch", healthy, passed, found, None if healthy else found, place, "", 0.0)


def test_a_goal_is_missed_by_one_healthy_function_or_a_slab_too_few() -> None:
    fine, well = [result()] * 97, result(healthy=True, passed=True, found=False, place=None)
    enough = [Slabs(0.02, False, 0, 36, 1.0), Slabs(0.05, False, 34, 36, 1.0), Slabs(0.05, True, 31, 36, 1.0)]
    assert missed([*fine, *[result(found=False)] * 3, well], enough) == []
    assert len(missed([*fine, *[result(found=False)] * 4], enough)) == 1
    assert missed([*fine, result(healthy=True, found=False, place=None)], []) == ["healthy and failed: case"]
    assert len(missed([result(place=False)] * 16 + fine[:84], [])) == 1
    assert len(missed(fine, [Slabs(0.05, False, 33, 36, 1.0)])) == 1


def test_slabs_lie_in_the_box_and_at_its_edges_and_fill_their_share_of_it() -> None:
    for width in (0.02, 0.4):
        cuts = slabs_of(width)
        assert len(cuts) == 36
        assert {cut.direction for cut in cuts} == {(1, 0), (0, 1)}
        assert (min(cut.lower for cut in cuts), max(cut.upper for cut in cuts)) == pytest.approx((-2, 3))
        assert all(cut.upper - cut.lower == pytest.approx(5 * width) for cut in cuts)
    x = CART.space(10).uniform(20000, seed=5)
    for cut in slabs_of(0.1, tilted=True):
        sums = x @ torch.tensor(cut.direction, dtype=torch.float64)
        assert float(((sums > cut.lower) & (sums < cut.upper)).double().mean()) == pytest.approx(0.1, abs=0.012)


@pytest.mark.parametrize(
    "peer", [peer for peer in PEERS if peer.name != "chex.assert_numerical_grads"], ids=lambda peer: peer.name
)
def test_a_peer_tells_a_wrong_sign_from_a_right_gradient(peer: Peer) -> None:
    wrong = {"torch": "sign-torch-throw-2", "jax": "sign-jax-chain-100", "warp": "sign-warp-cosine-2"}
    right = next(case for case in HEALTHY if case.framework == peer.framework and case.place is None)
    assert ask(peer, named(wrong.get(peer.framework, "sign-numpy-cart-10"))).passed is False
    assert ask(peer, right).passed is True


@pytest.mark.nightly
def test_the_check_reaches_its_goals() -> None:
    assert main([]) == 0
