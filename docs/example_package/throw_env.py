"""An environment from another package: a ball is thrown at a target."""

import torch

import gradscape as gs


class Throw(gs.Environment):
    """Throw a ball so that it lands 8 m away.

    Parameters: angle [rad] and speed [m/s] of the throw. Loss: squared miss [m²].
    """

    loss_unit = "m²"
    space = gs.ParameterSpace({"angle": (0.1, 1.4, "rad"), "speed": (1, 14, "m/s")})

    def _evaluate(self, x, *, grad):
        x = x.clone().requires_grad_(grad)
        loss = (x[:, 1] ** 2 * torch.sin(2 * x[:, 0]) / 9.81 - 8.0) ** 2
        slope = torch.autograd.grad(loss.sum(), x)[0] if grad else None
        return gs.Evaluation.from_results(loss.detach(), slope)
