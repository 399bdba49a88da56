"""What other gradient checkers find of the same cases, at one random point each and with their own tolerances."""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import torch
import warp as wp
from jax.test_util import check_grads
from scipy import optimize
from warp import autograd

from .cases import Case
from .catalogue import defects, healthy_functions
from .examine import Result
from .tables import Share, table

RELATIVE = 1e-4  # error that is called wrong with SciPy, which returns an error and no verdict
SEED = 1


@dataclass(frozen=True)
class Answer:
    """What a checker says of a case: `passed` is None where it cannot be asked."""

    peer: str
    case: str
    healthy: bool
    passed: bool | None
    said: str = ""


@dataclass(frozen=True)
class Peer:
    """A checker of a framework's gradients: `passes` raises, or returns False, where a gradient is wrong."""

    name: str
    framework: str
    module: str
    passes: Callable[[Callable[..., Any], Any, str], bool]


def _torch(fn: Callable[..., Any], x: Any, precision: str) -> bool:
    """Check a batch of two points in float64."""
    return torch.autograd.gradcheck(fn, (torch.from_numpy(x).requires_grad_(),))


def _jax(fn: Callable[..., Any], x: Any, precision: str) -> bool:
    """Check a point in the precision of the function."""
    with jax.enable_x64(precision == "float64"):
        keys = {"key": jax.random.key(0)} if "key" in inspect.signature(fn).parameters else {}
        point = jax.numpy.asarray(x[0], dtype=precision)
        check_grads(lambda p: fn(jax.numpy.asarray(p), **keys), (point,), order=1, modes=["rev"])
    return True


def _chex(fn: Callable[..., Any], x: Any, precision: str) -> bool:
    """Check a point by differences of chex."""
    chex = importlib.import_module("chex")
    with jax.enable_x64(precision == "float64"):
        chex.assert_numerical_grads(fn, (jax.numpy.asarray(x[0], dtype=precision),), order=1)
    return True


def _warp(fn: Callable[..., Any], x: Any, precision: str) -> bool:
    """Check a batch of two points."""
    real: Any = {"float32": wp.float32, "float64": wp.float64}[precision]
    points: Any = wp.array(x, dtype=real, requires_grad=True, device="cpu")
    with wp.ScopedDevice("cpu"):
        return autograd.gradcheck(lambda at: fn(at), inputs=[points], raise_exception=False, show_summary=False)


def _scipy(fn: Callable[..., Any], x: Any, precision: str) -> bool:
    """Check a point by SciPy's forward differences, relative to the gradient."""
    one = x[:1].astype(precision)
    loss = lambda at: float(fn(at[None].astype(precision))[0][0])  # noqa: E731
    slope = fn(one)[1][0]
    error = optimize.check_grad(loss, lambda _: slope, one[0])
    return bool(error <= RELATIVE * max(1.0, float((slope**2).sum() ** 0.5)))


PEERS = (
    Peer("torch.autograd.gradcheck", "torch", "torch", _torch),
    Peer("jax.test_util.check_grads", "jax", "jax", _jax),
    Peer("chex.assert_numerical_grads", "jax", "chex", _chex),
    Peer("warp.autograd.gradcheck", "warp", "warp", _warp),
    Peer("scipy.optimize.check_grad", "numpy", "scipy", _scipy),
)


def ask(peer: Peer, case: Case) -> Answer:
    """Ask a checker about a case, at random points that have a loss; where it raises, it calls the gradient wrong."""
    env: Any = case.build()
    x = env.space.uniform(16, seed=SEED)
    x = env.space.to_values(x[case.build().evaluate(x, grad=False).has_loss][:2]).numpy()
    function = env.function
    if peer.framework == "numpy" and function.backend.bind.args != (True, None):
        return Answer(peer.name, case.name, case.healthy, None, "it takes a function with a gradient")
    try:
        with torch.enable_grad():
            passed = peer.passes(function.fn, x, env.fidelity.precision)
    except Exception as error:  # each has its own
        return Answer(peer.name, case.name, case.healthy, False, " ".join(str(error).split())[:160])
    return Answer(peer.name, case.name, case.healthy, bool(passed))


def installed(peer: Peer) -> bool:
    """Whether a checker can be imported."""
    return importlib.util.find_spec(peer.module) is not None


def ask_peers(only: Sequence[str], tell: Callable[[str], None]) -> list[Answer]:
    """Ask each checker about the cases of its framework, of some kinds or all."""
    answers = []
    for peer in filter(installed, PEERS):
        for case in [*defects(), *healthy_functions()]:
            if case.framework == peer.framework and (not only or case.kind in only):
                tell(f"{peer.name}: {case.name}")
                answers.append(ask(peer, case))
    tell("")
    return answers


def show_peers(results: Sequence[Result], answers: Sequence[Answer]) -> str:
    """Return the table of what each checker finds, and what `gs.check` finds of the same cases."""
    rows = []
    for peer in PEERS:
        if not installed(peer):
            rows.append((peer.name, peer.framework, *("not installed",) * 4))
            continue
        own = [one for one in answers if one.peer == peer.name and one.passed is not None]
        cases = {one.case for one in own}
        ours = [one for one in results if one.case in cases]
        rows.append((
            peer.name, peer.framework,
            str(Share.among(not one.passed for one in own if not one.healthy)),
            str(Share.among(one.found for one in ours if not one.healthy)),
            str(Share.among(not one.passed for one in own if one.healthy)),
            str(Share.among(not one.passed for one in ours if one.healthy)),
        ))  # fmt: skip
    head = ("checker", "framework", "defects found", "by gs.check", "healthy failed", "by gs.check")
    return table(head, rows)
