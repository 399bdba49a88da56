"""The Python API under values that make no sense, and under arrays of every kind."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

from gradscape import (
    Environment,
    Evaluation,
    Fidelity,
    ParameterSpace,
    Plane,
    Status,
    as_environment,
    from_numpy,
    from_torch,
    sample,
)
from gradscape.landscapes.objective import BoxedObjective, Objective
from gradscape.landscapes.sampling.fill import sample as fill
from gradscape.optim.search import search

INF, NAN = math.inf, math.nan
SPACE = ParameterSpace(["a", "b"], [0, -1], [1, 1])
X = SPACE.uniform(4, seed=0)
BOWL = from_torch(lambda x: x.square().sum(dim=1), SPACE, name="bowl")
PLANE = Plane.through(SPACE, SPACE.center, [0, 1], resolution=3)


@dataclass
class Own(Objective):
    """Somebody's own objective, which answers as a test says."""

    answer: Callable[[Any], Any]
    beyond_box: bool = False
    name: str = "own"
    space: ParameterSpace = SPACE

    def evaluate(self, x: Any, *, grad: bool = True) -> Any:
        return self.answer(x)


def sampled(answer: Callable[[Any], Any]) -> Callable[[], Any]:
    return lambda: sample(Own(answer), PLANE)


def answered(status: Any, factor: Any = 1) -> Callable[[], Any]:
    return sampled(lambda x: Evaluation(x[:, 0] * factor, torch.zeros_like(x), torch.full((len(x),), status)))


def differing(**how: Any) -> Callable[[], Any]:
    return lambda: from_numpy(lambda x: x.sum(axis=1), SPACE, **how).evaluate(X)


class Single(Environment):
    """A scene that computes in float32."""

    fidelities = {"draft": Fidelity("draft", dt=1.0)}  # noqa: RUF012 -- as a user writes it
    space, beyond_box = SPACE, True

    def _evaluate(self, x: Any, *, grad: bool) -> Evaluation:
        loss = 1 / x.float().abs().sum(dim=1).double()
        return Evaluation.from_results(loss, torch.zeros_like(x) if grad else None)


MASKED = np.ma.array(X.numpy(), mask=[[False, True]] * 4)
REFUSED: dict[str, tuple[Callable[[], Any], str]] = {
    "complex losses": (lambda: from_torch(lambda x: x[:, 0] + 1j, SPACE, name="f").evaluate(X), "the loss of f takes"),
    "complex losses, no gradient": (
        lambda: from_torch(lambda x: x[:, 0] + 1j, SPACE, name="f").evaluate(X, grad=False),
        "the loss of f takes numbers; got a tensor of torch.complex128",
    ),
    "complex losses of one's own": (answered(1, 1j), "a loss takes numbers; got a tensor of torch.complex128"),
    "true and false as losses": (
        lambda: from_torch(lambda x: x[:, 0] > 0, SPACE, name="f").evaluate(X, grad=False),
        "the loss of f takes numbers; got a tensor of torch.bool",
    ),
    "complex gradients": (lambda: Evaluation.from_results(X[:, 0], X + 1j), "a gradient takes numbers"),
    "masked losses": (lambda: from_numpy(lambda x: MASKED[:, 1], SPACE).evaluate(X, grad=False), "with masked ones"),
    "masked gradients": (lambda: from_numpy(lambda x: (x[:, 0], MASKED), SPACE).evaluate(X), "with masked ones"),
    "masked gradients of points": (
        lambda: from_numpy(lambda x: (x[0], MASKED[0]), SPACE, vectorized=False).evaluate(X),
        "the gradient of .* masked ones",
    ),
    "masked points": (lambda: BOWL.evaluate(MASKED), "bowl takes numbers; got an array with masked ones"),
    "masked bounds": (
        lambda: ParameterSpace(["a", "b"], MASKED[0], [9, 9]),
        "lower takes numbers; .* masked ones",
    ),
    **{f"status {n}": (answered(n), f"status takes 0 MISSING, 1 OK, .*; got {n}") for n in (257, -1, 1.5, 7)},
    "no status yet": (answered(0), "own must give the final status of every point"),
    "failures coded 257": (lambda: Evaluation.from_results(X[:, 0], None, torch.full((4,), 257)), "got 257"),
    "a tuple": (sampled(lambda x: (x[:, 0], x, 1)), r"own._evaluate must return an Evaluation; got tuple"),
    "nothing": (sampled(lambda x: None), r"own._evaluate must return an Evaluation; got NoneType"),
    "losses that use no x": (
        lambda: from_torch(lambda x: torch.ones(len(x), requires_grad=True) * 2, SPACE, name="f").evaluate(X),
        "f returned losses without a gradient; compute them from x",
    ),
    **{
        f"batch {n}": (lambda n=n: fill(as_environment(BOWL), PLANE, batch=n), "sample's batch is")
        for n in (-5, 0, 1.5, NAN, "3")
    },
    **{
        f"resolution {n}": (lambda n=n: Plane.through(SPACE, [0, 0], [0, 1], resolution=n), "a slice's resolution is")
        for n in (-5, 1, 2.5, NAN, None, "3", True, 10**30, [3, 0])
    },
    **{
        f"window {e}": (lambda e=e: Plane.through(SPACE, SPACE.center, [0, 1], resolution=3, window=e), said)
        for said, windows in {
            "positive and finite": (-1, 0, INF, NAN),
            "finite lower < upper": (1e-300, (0, INF), (-INF, INF), (0, NAN), (1, 0), (-1e308, 1e308)),
            "window takes numbers": ("1", True, 1j, ("0", "1")),
            "window takes a pair": ((0, 1, 2), [1], ()),
        }.items()
        for e in windows
    },
    **{
        f"bounds {low} to {high}": (lambda low=low, high=high: ParameterSpace({"a": (low, high)}), said)
        for said, bounds in {
            "finite lower < upper": ((-INF, INF), (0, INF), (-INF, 0), (-1e308, 1e308), (NAN, 1), (1, 1)),
            "takes numbers": ((0, 10**400), ("0", "1"), (0, True), (0, 1j), (None, 1)),
        }.items()
        for low, high in bounds
    },
    "a box of infinite bounds": (lambda: ParameterSpace.box(["a"], -INF, INF), "finite lower < upper"),
    "a box of text": (lambda: ParameterSpace.box(["a"], "0", "1"), "takes numbers"),  # type: ignore[arg-type]
    "a plane through infinity": (lambda: Plane.through(SPACE, [INF, INF], [0], resolution=3), "finite origin"),
    "a direction of zeros": (lambda: Plane.span([0, 0], [[0, 0]], resolution=3), "neither zero nor parallel"),
    "principal directions of NaN": (lambda: Plane.principal(X * NAN, resolution=3), "finite points"),
    **{
        f"differences {d}": (differing(differences=d), "from_numpy takes differences from 1e-12 to 1")
        for d in (1e-300, 1e-17, 0, -1, NAN, INF, 2.0)
    },
    **{f"differences {d!r}": (differing(differences=d), "from_numpy's differences takes") for d in ("x", True, 1j)},
    "differences that rounding swallows": (
        lambda: from_numpy(sum, ParameterSpace({"a": (0, 1), "b": (1e9, 1e9 + 1e-3)}), differences=1e-6),
        "differences of 1e-06 are lost in rounding relative to the bounds of b",
    ),
    "parameters no float32 holds": (
        lambda: Single().evaluate([[0, 0], [0, 1e39]]),
        r"single computes in float32, whose largest number is 3.4e38; row 1 of x is \[0.0, 1e\+39\]",
    ),
    **{f"{n} points": (lambda n=n: SPACE.uniform(n, seed=0), "a count of points is") for n in (-1, 1.5, "x", 10**30)},
    **{f"seed {n}": (lambda n=n: SPACE.uniform(1, seed=n), "a seed is a whole number") for n in (-1, 1.5, None)},
    **{f"parameter {n}": (lambda n=n: SPACE.index(n), "no parameter is called") for n in (1.5, None, INF, [0])},
    **{
        f"budget {n}": (lambda n=n: search(BOWL, "random", budget=n), "a budget is a whole number")
        for n in (-1, 0, 2.5, NAN, None, "9", 10**30)
    },
    **{
        f"gradient_cost {c}": (lambda c=c: search(BOWL, "descents", budget=2, gradient_cost=c), "gradient_cost above 0")
        for c in (-1, 0, NAN, INF)
    },
}


@pytest.mark.filterwarnings("error")
def test_what_makes_no_sense_is_refused_in_a_line() -> None:
    wrong = {}
    for name, (call, said) in REFUSED.items():
        try:
            wrong[name] = repr(call())
        except ValueError as refusal:
            if not re.search(said, str(refusal)) or "\n" in str(refusal):
                wrong[name] = str(refusal)
    assert wrong == {}


ARRAYS: dict[str, Callable[[Any], Any]] = {
    "negative strides": lambda x: x[::-1, ::-1].copy()[::-1, ::-1],
    "big-endian": lambda x: x.astype(">f8"),
    "long double": lambda x: x.astype(np.longdouble),
    "read-only": lambda x: np.broadcast_to(x, x.shape),
    "by columns": np.asfortranarray,
    "lists": lambda x: x.tolist(),
    "a tensor": torch.from_numpy,
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays_of_every_kind_are_numbers(kind: str) -> None:
    """Whatever takes points, bounds or losses takes them in any layout, order of bytes and precision."""
    x = X.numpy()
    as_kind = ARRAYS[kind](x)
    flat = [ARRAYS[kind](x[:, :1])[i][0] for i in range(len(x))]
    given = [
        BOWL.evaluate(as_kind).loss - BOWL.evaluate(X).loss,
        BoxedObjective(BOWL).evaluate(as_kind).loss - BOWL.evaluate(X).loss,
        Single().evaluate(as_kind).loss - Single().evaluate(X).loss,
        from_numpy(lambda _: (flat, as_kind), SPACE).evaluate(X).grad - X,
        Evaluation.from_results(flat, as_kind, [1] * 4).loss - X[:, 0],
        ParameterSpace(["a", "b"], as_kind[0], [9, 9]).lower - X[0],
        SPACE.from_unit(SPACE.to_unit(as_kind)) - X,
        PLANE.lift(PLANE.project(as_kind)) - X,
        PLANE.distance(as_kind),
        PLANE.slope(as_kind) - X,
        Plane.through(SPACE, as_kind[0], [0], resolution=3).origin[1:] - X[0, 1:],
        Plane.through(SPACE, [0, 0], [0, 1], resolution=3, window=(as_kind[0], [9, 9])).lower - X[0],
        Plane.span(as_kind[0], as_kind[:2], resolution=3).basis - X[:2],
        Plane.principal(as_kind, resolution=3).origin - X.mean(dim=0),
        Plane(as_kind[0], as_kind[:2], [0, 0], [1, 1], [3, 3], ["a", "b"]).basis - X[:2],
    ]
    for number, difference in enumerate(given):
        assert float(difference.abs().max()) < 1e-12, number


def test_bounds_stay_what_they_were_and_a_status_is_kept_as_it_is_said() -> None:
    """What becomes of an array afterwards is no concern of a space made of it: bounds were infinite that way."""
    lower = torch.tensor([0.0, 0.0], dtype=torch.float64)
    space = ParameterSpace(["a", "b"], lower, [1, 1])
    lower[0] = -INF
    assert space.lower.tolist() == [0, 0]
    codes = [Status.OK, Status.NONFINITE, Status.ESCAPED, Status.ERROR]
    for dtype in (torch.int8, torch.int64, torch.float64):
        found = Evaluation.from_results(X[:, 0], X, torch.tensor(codes, dtype=dtype))
        assert found.status.tolist() == codes
        assert found.status.dtype == torch.int8
