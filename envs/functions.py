"""BoTorch's synthetic test functions as environments: known minima and exact gradients, to test tools against."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from botorch.test_functions import synthetic
from jaxtyping import Float
from torch import Tensor

from ..landscapes.objective import Evaluation, Status
from ..landscapes.options import NoOptions
from ..landscapes.space import ParameterSpace
from .base import Environment, Fidelity


@dataclass(frozen=True)
class AnyDimension:
    """`dim`: number of variables of the function."""

    dim: int = field(default=2, metadata={"most": 100_000})  # many more, and lists of their names alone fill memory


class Function(Environment):
    """Evaluate one of BoTorch's synthetic functions and its exact gradient (float64 throughout).

    Parameters: x0, x1, ..., without units, in the function's customary box.
    Loss: the function's value, without a unit. The formula is also defined outside the box.
    """

    model_version = 1
    beyond_box = True

    fidelities: ClassVar[dict[str, Fidelity]] = {"exact": Fidelity("exact", dt=0.0, precision="float64")}
    synthetic: ClassVar[Any]  # a class of botorch.test_functions.synthetic

    def _setup(self) -> None:
        dim = getattr(self.options, "dim", None)
        try:
            self.function = self.synthetic() if dim is None else self.synthetic(dim=dim)
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"{self.name} cannot be made with dim={dim}: {error}") from None
        lower, upper = self.function.bounds.double()
        names = tuple(f"x{i}" for i in range(len(lower)))
        self.space = ParameterSpace(names, lower, upper, ("",) * len(names))

    def memory(self) -> int:
        """Estimate the bytes of one row: its numbers, and what torch keeps for differentiation."""
        return 18_000 + 80 * self.space.dim

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        x = x.clone().requires_grad_(grad)
        with torch.set_grad_enabled(grad):
            formula = self.function._evaluate_true  # without the check that x lies in the box
            loss = torch.stack([formula(row[None])[0] for row in x.unbind()])
        slope = torch.autograd.grad(loss.sum(), x)[0] if grad else None
        return Evaluation(loss.detach(), slope, torch.full((len(x),), Status.OK, dtype=torch.int8))


def _make_class(name: str, function: type[synthetic.SyntheticTestFunction], options: type[Any]) -> type[Function]:
    """Return the environment of one function."""
    body = {
        "name": name,
        "synthetic": function,
        "Options": options,
        "__doc__": Function.__doc__,
        "__module__": __name__,
    }
    return type(function.__name__, (Function,), body)


Branin = _make_class("branin", synthetic.Branin, NoOptions)
Beale = _make_class("beale", synthetic.Beale, NoOptions)
SixHumpCamel = _make_class("six-hump-camel", synthetic.SixHumpCamel, NoOptions)
Ackley = _make_class("ackley", synthetic.Ackley, AnyDimension)
Griewank = _make_class("griewank", synthetic.Griewank, AnyDimension)
Levy = _make_class("levy", synthetic.Levy, AnyDimension)
Rastrigin = _make_class("rastrigin", synthetic.Rastrigin, AnyDimension)
Rosenbrock = _make_class("rosenbrock", synthetic.Rosenbrock, AnyDimension)
StyblinskiTang = _make_class("styblinski-tang", synthetic.StyblinskiTang, AnyDimension)
