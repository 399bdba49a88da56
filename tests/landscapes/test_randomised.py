"""Estimates of a smoothed gradient from pairs, against closed forms: lines, a step, ripples in many dimensions."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gradscape.landscapes.randomised import Order, shrunk_gradient, smoothed_gradient

WIDTH = 0.1
ALL = torch.ones(1, 1, dtype=torch.bool)


def pairs(f: Callable[[Tensor], Tensor], at: Tensor, count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return half the differences of a function over pairs around a point, mean gradients of pairs, and directions."""
    w = torch.randn(count, len(at), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    x = (at + WIDTH * torch.stack([w, -w])).requires_grad_()
    loss = f(x)
    (grad,) = torch.autograd.grad(loss.sum(), x)
    loss = loss.detach()
    return ((loss[0] - loss[1]) / (2 * WIDTH))[None], grad.mean(dim=0)[None], w


def shrunk(f: Callable[[Tensor], Tensor], at: Tensor, count: int, seed: int) -> Tensor:
    return shrunk_gradient(*pairs(f, at, count, seed), ALL.expand(1, count))[0]


def of_order(order: Order, f: Callable[[Tensor], Tensor], at: Tensor, count: int, seed: int) -> Tensor:
    return smoothed_gradient(*pairs(f, at, count, seed), ALL.expand(1, count), order)[0]


def test_of_a_line_four_pairs_know_the_gradient() -> None:
    slope = torch.linspace(-1, 2, 50, dtype=torch.float64)
    torch.testing.assert_close(shrunk(lambda x: x @ slope, torch.zeros(50, dtype=torch.float64), 4, 0), slope)


def test_without_gradients_it_is_the_estimate_of_zeroth_order() -> None:
    half, first, w = pairs(lambda x: (x**3).sum(dim=-1), torch.ones(6, dtype=torch.float64), 4, 1)
    known, nothing = ALL.expand(1, 4), torch.zeros_like(first)
    wanted = smoothed_gradient(half, None, w, known, "zeroth")
    torch.testing.assert_close(shrunk_gradient(half, nothing, w, known), wanted)


def test_many_pairs_find_a_step_that_gradients_do_not_see() -> None:
    """The smoothed step a / 10 + [a > 0.05] has the slope of the Gaussian's density there; gradients say 1/10."""

    def step(x: Tensor) -> Tensor:
        return x[..., 0] / 10 + (x[..., 0] > 0.05).double() + 0 * x.sum(dim=-1)

    density = math.exp(-((0.05 / WIDTH) ** 2) / 2) / (WIDTH * math.sqrt(2 * math.pi))
    found = torch.stack([shrunk(step, torch.zeros(2, dtype=torch.float64), 500, seed) for seed in range(20)])
    mean, error = found.mean(dim=0), found.std(dim=0) / 20**0.5
    torch.testing.assert_close(mean, mean.new_tensor([0.1 + density, 0.0]), rtol=0.02, atol=float(3 * error.max()))


def test_in_many_dimensions_shrinking_leaves_less_noise() -> None:
    """Of (x.x) / 2 + sin(30 x) / 60, which is as good as x.x / 2 under the Gaussian, the gradient is x."""

    def rippled(x: Tensor) -> Tensor:
        return (x.square() / 2 + torch.sin(30 * x) / 60).sum(dim=-1)

    at = torch.ones(100, dtype=torch.float64)
    error = {
        name: float(torch.stack([(estimate(rippled, at, 4, seed) - at).norm() for seed in range(20)]).mean())
        for name, estimate in (("shrunk", shrunk), ("mixed", lambda *how: of_order("mixed", *how)))
    }
    assert error["shrunk"] < error["mixed"] / 1.5
