"""A scene whose model has parts of known effect and price, which a clock of its own tells."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from gradscape.envs.base import Environment, ModelPart
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.space import ParameterSpace

from .clock import Clock

CLOCK = Clock()


@dataclass(frozen=True)
class Switches:
    """`glass`: where the loss is not finite; `noise`: of every evaluation."""

    wind: bool = True
    offset: bool = True
    paint: bool = True
    slope: float = 1.0
    glass: bool = False
    gust: bool = False
    tank: bool = True
    motor: bool = True
    noise: float = 0.0


class Parted(Environment):
    """A bowl with wind, whose parts do what their names say; painting takes as long as all the rest."""

    name = "parted"
    Options: ClassVar[type[Any]] = Switches
    loss_unit = "J"
    space = ParameterSpace.box(["x0", "x1"], 0.0, 1.0)
    model_parts: ClassVar[tuple[ModelPart, ...]] = (
        ModelPart("wind", {"wind": False}, "no wind"),
        ModelPart("offset", {"offset": False}, "no constant"),
        ModelPart("paint", {"paint": False}, "no paint"),
        ModelPart("slope", {"slope": 0.5}, "half the gradient"),
        ModelPart("tough glass", {"glass": True}, "glass that breaks"),
        ModelPart("gust", {"gust": True}, "a gust", missing=True),
        ModelPart("tank", {"tank": False}, "no tank"),
        ModelPart("motor", {"motor": False}, "no motor"),
        ModelPart("as it is", {"wind": True}, "wind"),
    )
    chance = torch.Generator()

    def _setup(self) -> None:
        if not self.options.tank:
            raise ValueError("parted needs its tank")

    def _evaluate(self, x: Tensor, *, grad: bool) -> Evaluation:
        o = self.options
        if not o.motor:
            raise RuntimeError("the engine gives up")
        CLOCK.sleep(len(x) * 1e-3 * (2 if o.paint else 1) * (2 if grad else 1) * (3 if o.gust else 1))
        loss = x.square().sum(dim=1) + 2.0 * o.wind * torch.sin(9 * x[:, 0]) + 1.0 * o.offset
        loss = loss + 0.2 * o.gust * x[:, 1]
        loss = loss + o.noise * torch.rand(len(x), generator=self.chance, dtype=torch.float64)
        slope = 2 * x
        slope[:, 0] += 18.0 * o.wind * torch.cos(9 * x[:, 0])
        slope[:, 1] += 0.2 * o.gust
        if o.glass:
            loss[x[:, 0] > 0.5] = torch.nan
        return Evaluation.from_results(loss, o.slope * slope if grad else None)
