"""What a case of the examination is: an objective, and what a check must say of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

import gradscape as gs

Evidence = Literal["gradient", "nan", "wide", "repeat", "rows", "losses", "finer", "growth", "memory"]
"""How a defect shows itself to somebody who knows it: the gradient is no slope of the loss, it is NaN, it is no slope
over a tenth of the box, the same call gives another result, a row depends on others, a loss is another one where a
gradient is asked for, the gradient is another one at a finer time step, it is larger than 10^6, or each call keeps
memory."""

Losses = Callable[[NDArray[np.float64]], NDArray[np.float64]]  # of points, shape (batch, dim)
UNWATCHED: dict[str, Any] = {"device": "cpu", "check_overwrites": False}  # nothing looks for overwritten arrays
ADAPT: dict[str, Callable[..., gs.Environment]] = {
    "torch": gs.from_torch,
    "jax": gs.from_jax,
    "numpy": gs.from_numpy,
    "warp": partial(gs.from_warp, **UNWATCHED),
}


@dataclass(frozen=True, eq=False)
class Case:
    """A function of a framework over a space, and what a check must say of it.

    `word` and `note` are parts of its name. `fn` is the function, or where it is `fresh` what makes it: each objective
    has its own then. `said` are further keywords of `from_...`. `causes` are the names of causes that are right, none
    for a healthy function; `parameters` are those that must be named. `edges` are the places, by parameter and in its
    unit, where a region begins or ends, `region` says which points, shape (batch, dim), lie in it, and `step` is the
    last step that the gradient is right at. `warns` is true where a warning is enough. `evidence` says how the defect
    shows itself, and `reference` gives the losses in float64 where the program's own is another. `place` is where the
    truth is looked at, as shares of the box; None for random points.
    """

    framework: str
    kind: str
    word: str
    fn: Callable[..., Any]
    space: gs.ParameterSpace
    causes: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    edges: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    region: Callable[[Tensor], Tensor] | None = None
    step: int | None = None
    warns: bool = False
    evidence: Evidence = "gradient"
    reference: Losses | None = None
    place: float | tuple[float, ...] | None = None
    note: str = ""
    fresh: bool = False
    said: Mapping[str, Any] = field(default_factory=dict)

    @property
    def healthy(self) -> bool:
        """Whether a check must let it pass."""
        return not self.causes

    @property
    def dim(self) -> int:
        return self.space.dim

    @property
    def name(self) -> str:
        of = (self.word, self.framework) if self.healthy else (self.framework, self.word)
        return "-".join(filter(None, [self.kind.replace(" ", "-"), *of, str(self.dim), self.note]))

    def build(self) -> gs.Environment:
        """Make the objective, without anything that earlier calls have left."""
        fn = self.fn() if self.fresh else self.fn
        return ADAPT[self.framework](fn, self.space, name=self.name, **self.said)
