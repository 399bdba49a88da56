"""An environment from another package: a ball is thrown at a target."""

import torch

from gradscape import Environment, Evaluation, Fidelity, ParameterSpace, Status


class Throw(Environment):
    """Throw a ball so that it lands 8 m away.

    Parameters: angle [rad] and speed [m/s] of the throw. Loss: squared miss [m^2].
    """

    name = "throw"
    loss_unit = "m²"
    fidelities = {"exact": Fidelity("exact", dt=0.0, precision="float64")}
    space = ParameterSpace(("angle", "speed"), torch.tensor([0.1, 1.0]), torch.tensor([1.4, 14.0]), ("rad", "m/s"))

    def _evaluate(self, x, *, grad):
        x = x.clone().requires_grad_(grad)
        loss = (x[:, 1] ** 2 * torch.sin(2 * x[:, 0]) / 9.81 - 8.0) ** 2
        slope = torch.autograd.grad(loss.sum(), x)[0] if grad else None
        return Evaluation(loss.detach(), slope, torch.full((len(x),), Status.OK))
