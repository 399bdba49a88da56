"""Remedies: an environment around another one, whose losses or gradients are easier to search.

A remedy is smoothing, clipping, a shorter episode, softer contact, a mean over numerical replicas, or another scale of
parameters. Every command takes the result. On the command line, `--remedy smooth:2%,clip:1` applies one after another.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..landscapes.episode import Episode
from ..landscapes.identity import EPISODES_PER_POINT, REMEDY
from ..landscapes.objective import Evaluation, Status
from ..landscapes.plain import read_share
from ..landscapes.randomised import ORDERS, Order, mean_of_pairs, reflect, smoothed_gradient
from ..landscapes.space import LINEAR, LOG10, ParameterSpace, as_whole
from .base import Environment
from .registry import as_environment

MIN_SUCCEEDED = 0.5  # share of the samples around a point that must succeed for a smoothed loss
DECADE = 10.0  # upper over lower bound from which on a parameter may run on a logarithmic scale
SENSITIVITY_POINTS = 64  # points at which `rescale` measures gradients


class Remedy(ABC):
    """Compute losses and gradients from those of another environment; `cost` is the episodes per point."""

    cost: int = 1
    from_losses: bool = False  # whether gradients are estimated from losses alone

    @property
    @abstractmethod
    def text(self) -> str:
        """How the command line spells it, such as smooth:0.02:mixed:16."""

    @abstractmethod
    def evaluate(self, env: Environment, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        """Return losses, and gradients if asked, at points of the space of `env`."""

    def space_of(self, env: Environment) -> ParameterSpace:
        """Return the parameters of the environment with the remedy."""
        return env.space

    def to_inner(self, env: Environment, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Return the points of `env` that points with the remedy stand for."""
        return x

    def over(self, env: Environment) -> Remedy:
        """Return the same remedy for `env`, the inner environment with other settings."""
        return self

    def others(self) -> tuple[Environment, ...]:
        """Return the environments that it evaluates besides the inner one."""
        return ()


class RemediedEnvironment(Environment):
    """An environment with a remedy.

    It has the settings, the episodes and the events of the inner environment, `inner`. Its losses and gradients are
    those of the remedy. One point takes `episodes_per_point` episodes.
    """

    def __init__(self, inner: Environment, remedy: Remedy, /) -> None:
        self.inner, self.remedy, self.space = inner, remedy, remedy.space_of(inner)
        vars(self).update({name: getattr(inner, name) for name in SHARED}, engines=(inner.engine,))
        super().__init__(
            fidelity=inner.fidelity,
            device=inner.device,
            engine=inner.engine,
            deterministic=inner.deterministic,
            **vars(inner.options),
        )

    @property
    def episodes_per_point(self) -> int:  # type: ignore[override] # read only
        """Number of episodes that the evaluation of one point takes."""
        return self.remedy.cost * self.inner.episodes_per_point

    @property
    def gradients_from_losses(self) -> bool:
        """Whether gradients are computed from losses alone and cost nothing extra."""
        return self.remedy.from_losses or self.inner.gradients_from_losses

    @property
    def has_gradient(self) -> bool:  # type: ignore[override] # read only
        """Whether gradients are known, or estimated from losses."""
        return self.remedy.from_losses or self.inner.has_gradient

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the numbers: those of the inner environment, and the remedies in order."""
        within = self.inner.identity()
        remedies = ",".join(filter(None, (within.get(REMEDY, ""), self.remedy.text)))
        return {**within, REMEDY: remedies, EPISODES_PER_POINT: self.episodes_per_point}

    @property
    def precision(self) -> str:
        """float32 or float64: what losses are computed in."""
        return self.inner.precision

    @property
    def packages(self) -> tuple[str, ...]:
        """Additional packages that affect the losses."""
        return self.inner.packages

    @property
    def threads(self) -> int:  # type: ignore[override] # read only
        """One: the inner environment spreads its batches itself."""
        return 1

    @property
    def preferred_batch(self) -> int:  # type: ignore[override] # read only
        """Number of points worth evaluating at once."""
        return max(1, self.inner.preferred_batch // self.remedy.cost)

    def memory(self) -> int:
        """Estimate the bytes that the evaluation of one point takes."""
        return self.remedy.cost * self.inner.memory()

    def about(self) -> str:  # type: ignore[override] # what there is to say is the other environment's
        """Return the description of the inner environment, and the remedy."""
        return f"{self.inner.about()}\n\nWith the remedy {self.remedy.text}."

    def episode(self, x: Float[Tensor, " dim"]) -> Episode:
        """Return the frames of the episode at one point, without the remedy."""
        return self.inner.episode(self.remedy.to_inner(self.inner, x))

    def events(self, x: Float[Tensor, "batch dim"]) -> Mapping[str, Int[Tensor, " batch"]]:
        """Count what happens in the episode at each point, without the remedy."""
        return self.inner.events(self.remedy.to_inner(self.inner, x))

    def noise(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, " batch"] | None:
        """Return None: only repeated evaluation can show how much noise a remedy leaves."""
        return None

    def replicas(self) -> Mapping[str, Environment]:
        """Return the replicas of the inner environment, each with the remedy; one that cannot have it is left out.

        A function's replica has no further replicas to average over.
        """
        found: dict[str, Environment] = {}
        for name, one in self.inner.replicas().items():
            with suppress(ValueError):
                found[name] = self._over(one)
        return found

    def with_horizon(self, horizon: float) -> Environment:
        """Return this environment with episodes of another length."""
        return self._over(self.inner.with_horizon(horizon))

    def plain_point(self, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Return the corresponding points of the environment without its remedies."""
        return self.inner.plain_point(self.remedy.to_inner(self.inner, x))

    def without(self) -> Environment:
        """Return the environment without its remedies."""
        return self.inner.without()

    def _remake(self, **settings: Any) -> Environment:
        return self._over(self.inner.remake(**settings))

    def _over(self, inner: Environment) -> RemediedEnvironment:
        """Return another inner environment with the same remedy."""
        return type(self)(inner, self.remedy.over(inner))

    def _within(self) -> tuple[Environment, ...]:
        return self.inner, *self.remedy.others()

    def _setup(self) -> None:
        if self._max_rows < type(self)._max_rows:  # a batch took too much memory
            within = self._within()
            for one in within:
                one.shrink(max(1, self._max_rows * self.remedy.cost // len(within)))
        self._capacity = self._max_rows

    def _prepare(self) -> None:
        self.inner.prepare()

    def _simulate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        return self._evaluate(x, grad=grad)  # points as they are: `inner` turns them into values

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        return self.remedy.evaluate(self.inner, x, grad=grad)


SHARED = [  # what an environment with a remedy has of the one within
    *("name", "loss_unit", "beyond_box", "decisions", "own_programs", "fidelities", "Options", "presets", "devices"),
    *("horizon_option", "control_step", "contact_stiffness", "material_range", "model_version", "examples"),
]


# ---- Smoothing: the mean loss under a Gaussian around each point.


@dataclass(frozen=True)
class Smooth(Remedy):
    """Average the loss over a Gaussian around each point, reflected at the bounds.

    L(x) = E f(x + s w), w ~ N(0, I), where `width` s is a fraction of every side of the box. The mean is over `samples`
    / 2 pairs of w and -w, drawn once by `seed`. All points share these w, so losses are as smooth as the mean and
    exactly repeatable.
    """

    width: float
    estimator: Order = "mixed"
    samples: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.width <= 1:
            raise ValueError(f"smooth takes a width above 0 and up to 100 % of the box; got {self.width:g}")
        if self.estimator not in ORDERS:
            raise ValueError(f"smooth takes the estimators {', '.join(ORDERS)}; got {self.estimator!r}")
        if as_whole(self.samples, "samples of smooth", least=2) % 2 or (self.samples < 6 and self.estimator == "mixed"):
            raise ValueError(f"smooth takes an even number of samples, at least 6 if mixed; got {self.samples}")

    @property
    def cost(self) -> int:  # type: ignore[override] # read only
        """The samples of a point."""
        return self.samples

    @property
    def from_losses(self) -> bool:  # type: ignore[override] # read only
        """Whether it is zeroth order."""
        return self.estimator == "zeroth"

    @property
    def text(self) -> str:
        """How the command line spells it."""
        seed = f":{self.seed}" if self.seed else ""
        return f"smooth:{self.width:g}:{self.estimator}:{self.samples}{seed}"

    def evaluate(self, env: Environment, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        """Return mean losses, and estimates of their gradients if asked."""
        w, space = self._directions(space_dim := env.space.dim), env.space
        moved = space.to_unit(x)[:, None, None] + self.width * torch.stack([w, -w])  # batch, sign, pair, dim
        places, signs = reflect(moved)
        sloped = grad and not self.from_losses
        found = env.evaluate(space.from_unit(places).reshape(-1, space_dim), grad=sloped)
        shape = moved.shape[:-1]
        loss, status = found.loss.double().reshape(shape), found.status.reshape(shape)
        known = (status == Status.OK).all(dim=1)  # of pairs
        valued = ((status == Status.OK) | (status == Status.NO_GRADIENT)).all(dim=1)
        mean, verdict = mean_of_pairs(loss.mean(dim=1), valued), _joint_status(status, valued)
        if not grad:
            return Evaluation.from_results(mean, None, verdict, found.error)
        half = (loss[:, 0] - loss[:, 1]) / (2 * self.width)
        first = None
        if found.grad is not None:
            sides = space.upper - space.lower
            first = (found.grad.double().reshape(moved.shape) * sides * signs).mean(dim=1)
        slope = smoothed_gradient(half, first, w, known, self.estimator) / (space.upper - space.lower)
        return Evaluation.from_results(mean, slope, verdict, found.error)

    def _directions(self, dim: int) -> Float[Tensor, "pair dim"]:
        generator = torch.Generator().manual_seed(self.seed)
        return torch.randn(self.samples // 2, dim, generator=generator, dtype=torch.float64)


def smooth(
    f: Any, width: float, *, estimator: Order = "mixed", samples: int = 16, seed: int = 0
) -> RemediedEnvironment:
    """Return an environment whose loss is averaged over a Gaussian around each point.

    `width` is its standard deviation as a fraction of every side of the box. Gradients are estimated in one of three
    ways:

    - "first": the mean of gradients. It has little variance where the loss is smooth, and is biased where it jumps.
    - "zeroth": the mean of (f(x + s w) - f(x - s w)) w / (2 s). It is unbiased, and its variance grows with the number
      of parameters.
    - "mixed": zeroth order with the first order of the other pairs as a control variate. It is unbiased everywhere.

    Source: Suh et al. 2022, "Do differentiable simulators give better policy gradients?". Their mixing weights depend
    on a bound of the bias. Here no bias needs to be known, because the control variate has the same mean.

    Raises ValueError for an invalid width, estimator or number of samples.
    """
    return RemediedEnvironment(as_environment(f), Smooth(width, estimator, samples, seed))


def _joint_status(status: Int[Tensor, "batch part pair"], known: Tensor) -> Int[Tensor, " batch"]:
    """Return OK where enough pairs are known, else the status of the first failed one."""
    rows = status.movedim(1, -1).flatten(1)
    bad = torch.where(rows == Status.OK, 0, rows)
    first = bad.gather(1, (bad > 0).to(torch.int8).argmax(dim=1, keepdim=True))[:, 0]
    enough = known.double().mean(dim=1) >= MIN_SUCCEEDED
    return torch.where(enough, int(Status.OK), first.long()).to(torch.int8)


# ---- Clipping, averaging over replicas, other scales of parameters: each one formula.


@dataclass(frozen=True)
class Clip(Remedy):
    """Shorten gradients that are longer than `norm` [loss unit per side of the box]; losses stay as they are."""

    norm: float

    def __post_init__(self) -> None:
        if not 0 < self.norm < torch.inf:
            raise ValueError(f"clip takes a norm above 0 [loss unit per side of the box]; got {self.norm:g}")

    @property
    def text(self) -> str:
        """How the command line spells it."""
        return f"clip:{self.norm:g}"

    def evaluate(self, env: Environment, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        """Return losses, and shortened gradients if asked."""
        found = env.evaluate(x, grad=grad)
        if found.grad is None:
            return found
        size = (found.grad * (env.space.upper - env.space.lower)).norm(dim=1, keepdim=True)
        return replace(found, grad=found.grad * (self.norm / size).clamp(max=1.0))


def clip(f: Any, norm: float) -> RemediedEnvironment:
    """Return an environment whose gradients are shortened to at most `norm` [loss unit per side of the box].

    Directions and losses stay as they are. Source: Pascanu et al. 2013, "On the difficulty of training recurrent neural
    networks". Raises ValueError for a norm that is not positive.
    """
    return RemediedEnvironment(as_environment(f), Clip(norm))


@dataclass(frozen=True)
class Average(Remedy):
    """Average losses and gradients over an environment and its numerical replicas, by their `names`, by default all."""

    replicas: tuple[Environment, ...]
    names: tuple[str, ...] = ()

    @property
    def cost(self) -> int:  # type: ignore[override] # read only
        """The environment and its replicas."""
        return 1 + len(self.replicas)

    @property
    def text(self) -> str:
        """How the command line spells it."""
        return ":".join(["average", *self.names])

    def over(self, env: Environment) -> Remedy:
        """Return the average over `env` and its own replicas."""
        return average(env, self.names).remedy

    def others(self) -> tuple[Environment, ...]:
        """Return the replicas."""
        return self.replicas

    def evaluate(self, env: Environment, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        """Return mean losses and gradients; a point fails where one of them does."""
        found = [one.evaluate(x, grad=grad) for one in (env, *self.replicas)]
        status = torch.stack([one.status for one in found]).amax(dim=0)
        loss = torch.stack([one.loss for one in found]).mean(dim=0)
        slopes = [one.grad for one in found if one.grad is not None]
        error = next((one.error for one in found if one.error), "")
        return Evaluation.from_results(loss, torch.stack(slopes).mean(dim=0) if slopes else None, status, error)


def average(f: Any, replicas: Sequence[str] = ()) -> RemediedEnvironment:
    """Return an environment whose losses and gradients are means over its numerical replicas and itself.

    `replicas` names some of those in `f.replicas()`, by default all. Averaging shrinks effects of the discretisation,
    such as ripples of a grid. Raises ValueError for unknown replicas.
    """
    env = as_environment(f)
    offered = env.replicas()
    if not offered or set(replicas) - set(offered):
        raise ValueError(
            f"{env.name} has {'the replicas ' + ', '.join(offered) if offered else 'no replicas to average over'}"
            + (f"; got {', '.join(replicas)}" if replicas else "")
        )
    names = tuple(replicas)
    return RemediedEnvironment(env, Average(tuple(offered[name] for name in names or offered), names))


@dataclass(frozen=True)
class Rescale(Remedy):
    """Let parameters run from bound to bound on other `scales`, linear or log10."""

    scales: tuple[str, ...]

    @property
    def text(self) -> str:
        """How the command line spells it."""
        return ":".join(["rescale", *self.scales])

    def space_of(self, env: Environment) -> ParameterSpace:
        """Return the same parameters and bounds on the other scales."""
        space = env.space
        lower, upper = space.to_values(space.lower), space.to_values(space.upper)
        return ParameterSpace(space.names, lower, upper, space.units, self.scales)

    def to_inner(self, env: Environment, x: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch dim"]:
        """Return points of the inner environment with the same values."""
        inside: Tensor = env.space.from_values(self.space_of(env).to_values(x))
        return torch.clamp(inside, env.space.lower, env.space.upper)

    def evaluate(self, env: Environment, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        """Return losses, and gradients by the rescaled parameters if asked."""
        space = self.space_of(env)
        values = space.to_values(x)
        found = env.evaluate(self.to_inner(env, x), grad=grad)
        if found.grad is None:
            return found
        ones = torch.ones_like(values)
        return replace(found, grad=found.grad * space.chain(values, ones) / env.space.chain(values, ones))


def rescale(f: Any, scales: Sequence[str] = ()) -> RemediedEnvironment:
    """Return an environment whose parameters run on the scales, linear or log10, that make its sensitivity more even.

    All commands work in fractions of the box, so a constant factor per parameter changes nothing. What matters is how
    evenly the loss changes from bound to bound. `scales` has one scale for each parameter. Without it, gradients at 64
    points decide for each parameter with positive bounds at least a decade apart: the scale with less varying gradients
    wins. Raises ValueError for unknown scales, and where the environment has no gradients to decide by.
    """
    env = as_environment(f)
    chosen = tuple(scales) or _even_scales(env)
    if len(chosen) != env.space.dim:
        raise ValueError(f"rescale takes {env.space.dim} scales, one for each parameter; got {len(chosen)}")
    return RemediedEnvironment(env, Rescale(chosen))


def _even_scales(env: Environment) -> tuple[str, ...]:
    space, points = env.space, env.space.sobol(SENSITIVITY_POINTS, seed=0)
    found, values = env.evaluate(points, grad=True), env.space.to_values(points)
    assert found.grad is not None  # as it was asked for
    by_value = found.grad / space.chain(values, torch.ones_like(values))
    spreads = {LINEAR: _variation(by_value), LOG10: _variation(by_value * values)}
    lower, upper = space.to_values(space.lower), space.to_values(space.upper)
    apart = (lower > 0) & (upper >= DECADE * lower)
    better = torch.where(apart, spreads[LOG10] < spreads[LINEAR], False)
    return tuple(LOG10 if one else LINEAR for one in better.tolist())


def _variation(slopes: Float[Tensor, "point dim"]) -> Float[Tensor, " dim"]:
    """Return the coefficient of variation of each parameter's |slope|, infinite where all are zero."""
    known = slopes[slopes.isfinite().all(dim=1)].abs()
    mean = known.mean(dim=0)
    return torch.where(mean > 0, known.std(dim=0) / mean, torch.inf)


# ---- Settings of the scene itself.


def shorten(f: Any, share: float) -> Environment:
    """Return an environment whose episodes have `share` of their length.

    Gradients of long episodes can explode (Xu et al. 2022, "Accelerated policy learning with parallel differentiable
    simulation"). The loss is that of the shorter episode. Raises ValueError where the environment has no horizon.
    """
    env = as_environment(f)
    if not 0 < share < 1:
        raise ValueError(f"shorten takes a share of the episode between 0 and 1; got {share:g}")
    if env.horizon is None:
        raise ValueError(f"{env.name} has no setting for the length of an episode; name one as horizon")
    return env.with_horizon(env.horizon * share)


def soften(f: Any, share: float | None = None, **settings: Any) -> Environment:
    """Return an environment with softer settings: its contact stiffness times `share`, or settings by name.

    The names are those of its options and `fidelity` and `engine`, such as friction=0.1. Raises ValueError where the
    environment has no contact stiffness, and for an unknown setting.
    """
    env = as_environment(f)
    if share is not None:
        if not env.contact_stiffness:
            raise ValueError(
                f"{env.name} has no contact stiffness to soften; name one of its options: "
                f"{', '.join(vars(env.options)) or 'it has none'}"
            )
        settings[env.contact_stiffness] = vars(env.options)[env.contact_stiffness] * share
    if not settings:
        raise ValueError("soften takes a share of the contact stiffness, or settings by name; got neither")
    return env.remake(**settings)


# ---- Remedies as the command line spells them.


def _read_smooth(f: Environment, width: str, estimator: str = "mixed", samples: str = "16", seed: str = "0") -> Any:
    kind: Any = estimator
    return smooth(f, read_share(width), estimator=kind, samples=int(samples), seed=int(seed))


READERS: dict[str, Callable[..., Environment]] = {
    "smooth": _read_smooth,
    "clip": lambda f, norm: clip(f, float(norm)),
    "average": lambda f, *names: average(f, names),
    "rescale": lambda f, *scales: rescale(f, scales),
    "shorten": lambda f, share: shorten(f, read_share(share)),
    "soften": lambda f, share: soften(f, read_share(share)),
}
FORMS = {
    "smooth": "smooth:WIDTH[:first|zeroth|mixed[:SAMPLES]]",
    "clip": "clip:NORM",
    "average": "average[:REPLICA...]",
    "rescale": "rescale[:SCALE...]",
    "shorten": "shorten:SHARE",
    "soften": "soften:SHARE",
}


def remedied(env: Environment, text: str) -> Environment:
    """Return an environment with the remedies in a text, applied in order, such as smooth:2%,clip:1.

    Raises ValueError for an unknown remedy, or one that the environment cannot take.
    """
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, *values = part.split(":")
        if name not in READERS:
            raise ValueError(f"there is no remedy {name!r}; the remedies are {', '.join(FORMS.values())}")
        try:
            env = READERS[name](env, *values)
        except TypeError as error:
            raise ValueError(f"write the remedy as {FORMS[name]}; got {part!r}") from error
    return env
