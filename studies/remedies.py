"""Compare remedies for a search: descents from the same starts at the same cost, with each remedy and without."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..envs.base import Environment
from ..envs.remedies import remedied
from ..landscapes.convert import NOT_JSON
from ..landscapes.objective import evaluate
from ..landscapes.space import ParameterSpace
from ..landscapes.statistics import Estimate, middle_95, share
from ..optim.lockstep import Asking, Evaluate, Lockstep
from ..optim.methods.quasi_newton import LocalSearch
from ..optim.statistics import holm

if TYPE_CHECKING:
    from ..landscapes.draw.figures.page import Picture

WIDTHS = (0.005, 0.01, 0.02, 0.04, 0.08)  # of smoothing, as shares of the box
LENGTHS = (0.5, 0.75)  # of an episode that is shortened
STIFFNESSES = (0.03, 0.1, 0.3)  # shares of the contact stiffness
STEPS = (0.001, 0.01, 0.05)  # along a gradient, as shares of the box
SIGNIFICANT = 0.05
RESAMPLES = 999  # of the bootstrap
ROUNDING = 1e-12  # of the largest loss, below which a gradient is zero
GAIN = 1e-9  # relative, from which on a further descent from the best point has got anywhere
WITHOUT = "none"  # the name of the row without a remedy


@dataclass(frozen=True)
class RemedyRow:
    """The result of descents with a remedy, by the losses of the environment without it.

    `points` is the number of points of each descent, each of `episodes_per_point`. `reached` is the median over the
    starts [loss unit]. `better` is the share of starts from which it got farther than without, and `p` that of
    Wilcoxon's signed-rank test, corrected for the number of remedies (Holm 1979). `falls` are the shares of starts
    where a step of `STEPS` along the gradient lowers the loss. `moved` is how far a descent with the remedy leads away
    from the lowest point without it, as a share of the box in the parameter that moves most. `losses` has the end of
    every descent. `words` are those of the landscape on the plane.
    """

    remedy: str
    episodes_per_point: int
    points: int
    reached: Estimate
    better: Estimate
    p: float
    falls: tuple[Estimate, ...]
    moved: float
    words: tuple[str, ...]
    losses: tuple[float, ...]


@dataclass(frozen=True)
class RemedyStudy:
    """The effect of each remedy on descents from the same `starts`; the first row is without a remedy.

    `budget` is the number of episodes with gradient of a descent without a remedy, and `gradient_cost` the cost of such
    an episode in episodes without gradient: all rows have the same total. `dims` are the labels of the plane through
    the centre of the box. `maps` are the losses on it with each remedy, and the words describe them.
    """

    env: str
    fidelity: str
    device: str
    loss_unit: str
    starts: int
    budget: int
    gradient_cost: float
    dims: tuple[str, ...]
    rows: tuple[RemedyRow, ...]
    identity: dict[str, Any]
    provenance: dict[str, Any]
    command: str
    maps: Mapping[str, NDArray[np.float64]] = field(default_factory=dict, metadata=NOT_JSON, compare=False, repr=False)
    derived = ("sentence",)

    @property
    def plain(self) -> RemedyRow:
        """The row without a remedy."""
        return self.rows[0]

    @property
    def helpful(self) -> tuple[RemedyRow, ...]:
        """The remedies that improve descents beyond chance, the lowest median first."""
        found = [row for row in self.rows[1:] if row.p < SIGNIFICANT and row.reached.value < self.plain.reached.value]
        return tuple(sorted(found, key=lambda row: row.reached.value))

    @property
    def harmful(self) -> tuple[RemedyRow, ...]:
        """The remedies that worsen descents beyond chance."""
        return tuple(
            row for row in self.rows[1:] if row.p < SIGNIFICANT and row.reached.value > self.plain.reached.value
        )

    @property
    def sentence(self) -> str:
        """Name the helpful remedy and its gain, or say that there is none."""
        unit = f" {self.loss_unit}" if self.loss_unit else ""
        without = f"{_median(self.plain)}{unit} without"
        if not self.helpful:
            tried = len(self.rows) - 1
            return f"none of the {tried} remedies improves descents beyond chance: descents reach {without} one"
        best = self.helpful[0]
        said = f"{best.remedy} helps: descents reach {_median(best)}{unit}, against {without} (p = {best.p:.2g})"
        return f"{said}; the minimum moves by {best.moved:.1%} of the box"

    def plot(self, *, width: float | None = None) -> Picture:
        """Draw the loss reached with every remedy, and the landscape without one and with the best."""
        from ..landscapes.draw.figures.remedies import plot_remedies

        return plot_remedies(self, width=width)


def _median(row: RemedyRow) -> str:
    one = row.reached
    return f"{one.value:.4g} (95 %: {one.low:.4g} to {one.high:.4g})"


def candidates(env: Environment) -> list[str]:
    """Return the possible remedies of an environment, in the command line's spelling, in several strengths."""
    found = [f"smooth:{100 * width:g}%" for width in WIDTHS]
    found += ["smooth:2%:first", "smooth:2%:zeroth", f"clip:{_typical_gradient(env):.3g}"]
    found += ["average"] if env.replicas() else []
    found += [f"shorten:{100 * length:g}%" for length in LENGTHS] if env.horizon is not None else []
    found += [f"soften:{100 * stiffness:g}%" for stiffness in STIFFNESSES] if env.contact_stiffness else []
    if remedied(env, "rescale").space.scales != env.space.scales:
        found.append("rescale")
    return found


def _typical_gradient(env: Environment) -> float:
    """Return the median length of gradients above rounding [loss unit per side of the box]."""
    found = evaluate(env, env.space.sobol(32, seed=1), grad=True)
    assert found.grad is not None  # as it was asked for
    sizes = (found.grad * (env.space.upper - env.space.lower)).norm(dim=1)
    sizes = sizes[sizes.isfinite() & (sizes > ROUNDING * found.loss.nan_to_num(0.0).abs().max())]
    return float(sizes.median()) if len(sizes) else 1.0


@dataclass(frozen=True)
class Ends:
    """The ends of descents: points of the environment without a remedy and its losses there."""

    x: Float[Tensor, "start dim"]
    loss: Float[Tensor, " start"]
    points: int
    episodes_per_point: int
    falls: NDArray[np.float64]  # shape (step, start): 1 where a step along the gradient lowers the loss, NaN unknown
    moved: float  # how far a descent leads away from the lowest point without a remedy, as a share of the box

    def lowest(self, space: ParameterSpace) -> Float[Tensor, " dim"]:
        """Return the lowest point, in the unit cube."""
        return space.to_unit(self.x[int(self.loss.nan_to_num(torch.inf).argmin())])


def treat(env: Environment, text: str) -> Environment:
    """Return an environment with a remedy, or unchanged for the row without one."""
    return env if text == WITHOUT else remedied(env, text)


def descend(
    env: Environment,
    treated: Environment,
    starts: Float[Tensor, "start dim"],
    *,
    budget: int,
    gradient_cost: float,
    lowest: Float[Tensor, " dim"] | None = None,
    follow: Callable[[int], None] = lambda done: None,
) -> Ends:
    """Descend from starts in the unit cube of `env` with a remedy, by L-BFGS-B, at the cost of `budget` gradients each.

    A descent that ends continues from its best point, as long as it improves. Its result is evaluated without the
    remedy. One more descent starts at the `lowest` point without a remedy, to see how far that moves.
    """
    cost = treated.episodes_per_point / (gradient_cost if treated.gradients_from_losses else 1.0)
    points = max(1, int(budget / cost))
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        follow(done)

    begun = _rescaled(env, treated, starts if lowest is None else torch.cat([starts, lowest[None]]))
    best = torch.stack(Lockstep(treated).run([_descent(treated, start, points, advance) for start in begun]))
    x, moved = treated.plain_point(best), 0.0
    if lowest is not None:
        moved, x = float((env.space.to_unit(x[-1]) - lowest).abs().max()), x[:-1]
    losses, falls = evaluate(env, x, grad=False).loss, _falls(env, treated, begun[: len(starts)])
    return Ends(x, losses, points, treated.episodes_per_point, falls, moved)


def _rescaled(env: Environment, treated: Environment, unit: Float[Tensor, "some dim"]) -> Float[Tensor, "some dim"]:
    """Return points of the unit cube as those with the same values with a remedy, which can change scales."""
    if treated.space.scales == env.space.scales:
        return unit
    values = env.space.to_values(env.space.from_unit(unit))
    return treated.space.to_unit(treated.space.from_values(values)).clamp(0, 1)


def _descent(
    env: Environment, start: Float[Tensor, " dim"], points: int, advance: Callable[[], None]
) -> Asking[Float[Tensor, " dim"]]:
    """Return the best point of L-BFGS-B from a start with this many evaluations."""
    sides, left = env.space.upper - env.space.lower, points
    best, best_loss = 2 * start.numpy() - 1, np.inf
    while left:
        search, before = LocalSearch(best, left), best_loss
        while left and not search.done:
            x = env.space.from_unit(torch.from_numpy((search.at + 1) / 2))
            evaluation, _ = yield Evaluate(x[None], True)
            advance()
            left -= 1
            assert evaluation.grad is not None  # as it was asked for
            loss, grad = float(evaluation.loss[0]), (evaluation.grad[0] * sides / 2).numpy()
            if np.isfinite(loss) and loss < best_loss:
                best, best_loss = search.at, loss
            search.tell(loss if np.isfinite(loss) else np.inf, grad)
        if not before - best_loss > GAIN * abs(best_loss):
            break
    return env.space.from_unit(torch.from_numpy((best + 1) / 2))


def _falls(env: Environment, treated: Environment, starts: Float[Tensor, "start dim"]) -> NDArray[np.float64]:
    """Return whether steps along the gradients of an environment with a remedy lower the losses without it."""
    sides = treated.space.upper - treated.space.lower
    x = treated.space.from_unit(starts)
    found = evaluate(treated, x, grad=True)
    assert found.grad is not None  # as it was asked for
    slope = found.grad * sides
    along = slope / slope.norm(dim=1, keepdim=True)
    steps = torch.tensor(STEPS, dtype=torch.float64)[:, None, None]
    ends = treated.plain_point(treated.space.from_unit((starts - steps * along).nan_to_num(0.5).clamp(0, 1)))
    here = evaluate(env, treated.plain_point(x), grad=False).loss
    there = evaluate(env, ends.reshape(-1, starts.shape[1]), grad=False).loss.reshape(len(STEPS), -1)
    known = along.isfinite().all(dim=1) & here.isfinite() & there.isfinite()
    lower: NDArray[np.float64] = torch.where(known, (there < here).double(), torch.nan).numpy()
    return lower


def conclude(ends: Sequence[tuple[str, Ends, tuple[str, ...]]]) -> list[RemedyRow]:
    """Return the rows of remedies, the first being without one; `ends` has each one's name, ends and words."""
    losses = {name: np.nan_to_num(one.loss.numpy(), nan=np.inf, posinf=np.inf) for name, one, _ in ends}
    plain = losses[ends[0][0]]
    ps = [1.0, *holm([_signed_rank(losses[name], plain) for name, _, _ in ends[1:]])]
    return [
        RemedyRow(
            remedy=name,
            episodes_per_point=one.episodes_per_point,
            points=one.points,
            reached=_median_of(losses[name]),
            better=_share_better(losses[name], plain),
            p=p,
            falls=tuple(share(int(np.nansum(row)), int(np.isfinite(row).sum())) for row in one.falls),
            moved=one.moved,
            words=words,
            losses=tuple(losses[name].tolist()),
        )
        for (name, one, words), p in zip(ends, ps, strict=True)
    ]


def _median_of(losses: NDArray[np.float64]) -> Estimate:
    random = np.random.default_rng(0)
    drawn = np.median(losses[random.integers(len(losses), size=(RESAMPLES, len(losses)))], axis=1)
    return middle_95(float(np.median(losses)), drawn)


def _share_better(losses: NDArray[np.float64], plain: NDArray[np.float64]) -> Estimate:
    """Return the share of lower losses among the starts that differ."""
    differ = losses != plain
    return share(int((losses < plain)[differ].sum()), int(differ.sum()))


def _signed_rank(losses: NDArray[np.float64], plain: NDArray[np.float64]) -> float:
    """Return the two-sided p of Wilcoxon's signed-rank test of pairs; 1 where all are equal."""
    from scipy.stats import wilcoxon

    both = np.isfinite(losses) & np.isfinite(plain)
    apart = (losses - plain)[both]
    return float(wilcoxon(apart).pvalue) if np.count_nonzero(apart) else 1.0
