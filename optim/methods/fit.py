"""Hyper-parameters of Gaussian processes: where the marginal likelihood times priors is largest."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import torch
from botorch.optim.fit import fit_gpytorch_mll_scipy
from gpytorch.mlls import ExactMarginalLogLikelihood
from gpytorch.models import ExactGP
from jaxtyping import Float
from linear_operator.utils.cholesky import psd_safe_cholesky
from torch import Tensor

from ..base import Points
from .process import Covariance, covariance_of

GROWTH = 1.1  # hyper-parameters are fitted anew when there are this many times more points than at the last fit
FIT_STEPS = 30  # of L-BFGS, from where the last fit ended

Model = TypeVar("Model", bound=ExactGP)


def fitted(model: ExactGP) -> dict[str, Points]:
    """Return the parameters at which marginal likelihood times priors is largest, from where they are, by name.

    Beside them it holds what they stand for: the length-scales, `scale`, and the noise's variance, `noise`, shape (1,).
    """
    likelihood = ExactMarginalLogLikelihood(model.likelihood, model).train()
    parameters = {name: one for name, one in likelihood.named_parameters() if one.requires_grad}
    fit_gpytorch_mll_scipy(likelihood, parameters, closure=closure_of(likelihood), options={"maxiter": FIT_STEPS})
    found = {name: value.detach().numpy().copy() for name, value in model.named_parameters()}
    scale, noise = model.covar_module.lengthscale, model.likelihood.noise
    return found | {"scale": scale.detach().reshape(-1).numpy(), "noise": noise.detach().reshape(-1).numpy()}


def with_parameters(model: Model, parameters: Mapping[str, Points]) -> Model:
    """Return a process, those of its parameters that are named set to these."""
    with torch.no_grad():
        for name, value in model.named_parameters():
            if name in parameters:
                value.copy_(torch.from_numpy(parameters[name]))
    return model


def closure_of(likelihood: ExactMarginalLogLikelihood) -> Callable[[], tuple[Tensor, list[Tensor]]]:
    """Return what gives minus the logarithm of likelihood times priors, for each row, and its slopes by parameters.

    It is what BoTorch's closure gives for a process without mean.
    """
    model = likelihood.model
    u, values = model.train_inputs[0], model.train_targets.reshape(-1)
    parameters = [one for one in likelihood.parameters() if one.requires_grad]

    def closure() -> tuple[Tensor, list[Tensor]]:
        kernel, noise = model.covar_module, model.likelihood.noise
        with torch.no_grad():
            found = marginal_likelihood(covariance_of(kernel), float(noise), u, values)
        # what is linear in the parameters with these slopes has the likelihood's slopes
        linear = (kernel.lengthscale.reshape(-1) * found.scale).sum() + (noise * found.noise).sum()
        priors = sum(prior.log_prob(of(module)).sum() for _, module, prior, of, _ in model.named_priors())
        slopes = torch.autograd.grad(-(linear + priors) / len(values), parameters)
        return -(found.value + priors.detach()) / len(values), list(slopes)

    return closure


@dataclass(frozen=True)
class Likelihood:
    """The logarithm of a marginal likelihood, and its derivatives by length-scales and by the noise's variance."""

    value: float
    scale: Float[Tensor, " dim"]
    noise: float


def marginal_likelihood(
    covariance: Covariance, noise: float, u: Float[Tensor, "point dim"], values: Float[Tensor, " row"]
) -> Likelihood:
    """Return how likely values at points are under a process with zero mean (Rasmussen & Williams 2006, section 5.4.1).

    With W = alpha alpha^T - K^-1, alpha = K^-1 values, a derivative is tr(W dK) / 2 (eq. 5.9).
    """
    matrix, pull = covariance.within(u)
    matrix.diagonal().add_(noise)
    lower = psd_safe_cholesky(matrix)
    inverse = torch.cholesky_inverse(lower)
    alpha = inverse @ values
    value = -0.5 * (values @ alpha) - lower.diagonal().log().sum() - 0.5 * len(values) * math.log(2.0 * math.pi)
    weights = torch.outer(alpha, alpha).sub_(inverse)
    return Likelihood(float(value), 0.5 * pull(weights), 0.5 * float(weights.diagonal().sum()))
