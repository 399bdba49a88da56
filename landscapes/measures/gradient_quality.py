"""Gradient quality by scale: against finite differences, and first order against zeroth order.

Slopes are taken along the plane's axes, per side of its box, as a picture shows them. Scales and widths are fractions
of the box.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from torch import Tensor

from ..identity import plane_of
from ..objective import Objective, evaluate
from ..plane import Plane
from ..statistics import Estimate, Values, mean, share, student
from .ruggedness import box_slopes, losses_of

SCALES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
STRIDES = (1, 2, 4)  # of the slice's own samples
WIDTHS = (0.01, 0.03)
CHANCE = 0.001  # a bias is beyond chance where Student's test says that chance alone would show it this rarely,
NOTABLE_BIAS = 0.1  # and worth a word where first and zeroth order disagree by more than this


@dataclass(frozen=True, eq=False)
class GradientQuality:
    """The data for drawing the gradients of a slice.

    `steps` is a result of `compare_differences`, `samples` of `compare_samples`, `smooth` of `smoothed_slopes`.
    """

    steps: xr.Dataset
    samples: xr.Dataset
    smooth: xr.Dataset


@dataclass(frozen=True)
class ScaleRow:
    """The comparison of gradients with differences over one `scale`, a fraction of the box.

    `points` of the `of` points have a slope; `error` is their median.
    """

    scale: float
    points: int
    of: int
    cosine: Estimate
    sign: Estimate
    uphill: Estimate
    error: float


@dataclass(frozen=True)
class WidthRow:
    """The comparison of first- and zeroth-order slopes under a Gaussian of one `width`, a fraction of the box."""

    width: float
    points: int
    of: int
    biased: Estimate
    disagreement: Estimate
    variance_ratio: float


def subgrid(plane: Plane, points: int) -> Float[Tensor, "count rank"]:
    """Return plane coordinates of this many points per axis, half a step away from the borders, u fastest."""
    places = (torch.arange(points, dtype=torch.float64) + 0.5) / points
    grid = torch.cartesian_prod(*[places] * plane.rank).reshape(-1, plane.rank).flip(-1)
    return plane.lower + grid * (plane.upper - plane.lower)


def compare_differences(
    objective: Objective, plane: Plane, u: Float[Tensor, "count rank"], *, deviation: float = 0.0
) -> xr.Dataset:
    """Compare slopes by AD with central differences over steps of several scales, at points of a plane.

    Returns `cosine`, `sign` and `error`, dims (scale, point), as in `agreement`, and `place`, dims (point, axis).
    """
    exact = evaluate(objective, plane.lift(u), grad=True)
    assert exact.grad is not None  # as it was asked for
    slope = (plane.slope(exact.grad) * (plane.upper - plane.lower)).numpy()
    (differences,) = central_differences(objective, [plane], u[None], SCALES)
    over = zip(SCALES, differences, strict=True)
    parts = [agreement(slope, difference, math.sqrt(2) * deviation / scale) for scale, difference in over]
    return xr.Dataset(_stack(parts, "scale", "point"), {"scale": list(SCALES), "place": (("point", "axis"), u.numpy())})


def central_differences(
    objective: Objective, planes: Sequence[Plane], u: Float[Tensor, "plane point rank"], scales: Sequence[float]
) -> Float[Values, "plane scale point rank"]:
    """Return central differences over parts of the box at points of planes, from one batch [loss unit per side]."""
    sides = torch.stack([plane.upper - plane.lower for plane in planes])
    widths = torch.tensor(scales, dtype=torch.float64).reshape(1, -1, 1, 1, 1)
    steps, at = torch.diag_embed(sides)[:, None, None] * widths / 2, u[:, None, :, None]
    ends = torch.stack([at - steps, at + steps], dim=1)  # plane way scale point axis u
    x = [plane.lift(part.reshape(-1, plane.rank)) for plane, part in zip(planes, ends, strict=True)]
    loss = evaluate(objective, torch.cat(x), grad=False).loss.reshape(ends.shape[:-1]).numpy()
    found: Values = (loss[:, 1] - loss[:, 0]) / np.reshape(scales, (1, -1, 1, 1))
    return found


def compare_samples(dataset: xr.Dataset, *, deviation: float = 0.0) -> xr.Dataset:
    """Compare a slice's gradients with differences of its own losses, over 2, 4 and 8 of its steps.

    It evaluates nothing. The result is that of `compare_differences`, dims (scale, v, u); scales are by the longer
    axis's samples. Samples too close to the border for a central difference have none.
    """
    plane = plane_of(dataset)
    loss = losses_of(dataset)
    strides = [stride for stride in STRIDES if 2 * stride < min(loss.shape)]
    parts = []
    for stride in strides:
        axes = [differences_of_samples(loss, axis, stride) for axis in range(loss.ndim)][::-1]  # u first
        widths = np.array([2 * stride / (size - 1) for size in plane.resolution])
        fuzz = math.sqrt(2) * deviation / widths.min()
        parts.append(agreement(box_slopes(dataset), np.stack(axes, axis=-1), fuzz))
    found = _stack(parts, "scale", *(name for name in ("v", "u") if name in dataset.dims))
    return xr.Dataset(found, {"scale": [2 * stride / (max(plane.resolution) - 1) for stride in strides]})


def _stack(parts: Sequence[Mapping[str, Values]], *dims: str) -> dict[str, tuple[tuple[str, ...], Values]]:
    """Return the values of all parts in one array by name, the parts along the first dimension; or nothing."""
    arrays = {name: np.stack([part[name] for part in parts]) for name in (parts[0] if parts else ())}
    return {name: (dims[: values.ndim], values) for name, values in arrays.items()}


def agreement(slope: Values, difference: Values, noise: float) -> dict[str, Values]:
    """Compare slopes by AD with differences, both of shape (..., axis): NaN where neither is above the noise.

    `cosine` of the angle between them, 0 where only one is zero. `sign`, the share of axes with the same sign among
    those where one is above the noise. `error`, the length of their difference relative to the finite difference.
    """
    sizes = np.linalg.norm(slope, axis=-1), np.linalg.norm(difference, axis=-1)
    known = np.isfinite(sizes[0]) & np.isfinite(sizes[1])
    seen = known & (np.maximum(*sizes) > 2 * noise)
    with np.errstate(divide="ignore", invalid="ignore"):
        product = sizes[0] * sizes[1]
        cosine = np.where(product > 0, (slope * difference).sum(axis=-1) / product, 0.0)
        error = np.linalg.norm(slope - difference, axis=-1) / sizes[1]
        counted = np.maximum(np.abs(slope), np.abs(difference)) > 2 * noise
        sign = (counted & (np.sign(slope) == np.sign(difference))).sum(axis=-1) / counted.sum(axis=-1)
    return {name: np.where(seen, part, np.nan) for name, part in (("cosine", cosine), ("sign", sign), ("error", error))}


def scale_table(found: xr.Dataset) -> tuple[ScaleRow, ...]:
    """Return a row for each scale: points with a slope, their mean cosine and sign agreement, median error."""
    rows = list[ScaleRow]()
    for scale in found["scale"].to_numpy():
        values = [found[name].sel(scale=scale).to_numpy() for name in ("cosine", "sign", "error")]
        seen = np.isfinite(values[0])
        cosine, sign, error = (one[seen] for one in values)
        rows.append(
            ScaleRow(
                scale=float(scale),
                points=len(cosine),
                of=seen.size,
                cosine=mean(cosine, least=-1, most=1),
                sign=mean(sign, least=0, most=1),
                uphill=share(int((cosine < 0).sum()), len(cosine)),
                error=float(np.median(error)) if len(error) else math.nan,
            )
        )
    return tuple(rows)


def smoothed_slopes(
    objective: Objective,
    plane: Plane,
    u: Float[Tensor, "count rank"],
    *,
    widths: Sequence[float] = WIDTHS,
    pairs: int = 16,
    seed: int = 0,
) -> xr.Dataset:
    """Estimate the slope of the loss averaged over a Gaussian, from gradients and from losses of the same samples.

    Suh et al. 2022, "Do differentiable simulators give better policy gradients?": first order averages gradients,
    zeroth order (f(x + w) - f(x - w)) w / (2 sigma^2), over `pairs` of w and -w (antithetic: the same mean, less
    variance). Where the loss jumps, first order is biased. To detect that, zeroth order has as a control variate the
    line g fitted to the losses of the other pairs: g - (g w) w / sigma^2 has mean zero for every g.

    Returns, dims (width, point, axis), `first` and `zeroth`, their standard errors `first_error` and `zeroth_error`,
    their plain variances of one pair `first_variance` and `zeroth_variance`, the `bias` of first order, which is the
    difference of means, and its standard error `bias_error`; `count`, the successful pairs, dims (width, point); and
    `place`, dims (point, axis). Widths are standard deviations, as fractions of the box.
    """
    generator = torch.Generator().manual_seed(seed)
    sides = plane.upper - plane.lower
    parts = []
    for width in widths:
        w = torch.randn(len(u), pairs, plane.rank, generator=generator, dtype=torch.float64)
        ends = u[:, None] + torch.stack([w, -w]) * width * sides
        found = evaluate(objective, plane.lift(ends.reshape(-1, plane.rank)), grad=True)
        assert found.grad is not None  # as it was asked for
        slopes = (plane.slope(found.grad) * sides).reshape(2, len(u), pairs, plane.rank)
        above, below = found.loss.reshape(2, len(u), pairs)
        parts.append(_compare_orders(slopes.mean(dim=0), (above - below) / (2 * width), w))
    about = {"width": list(widths), "place": (("point", "axis"), u.numpy())}
    return xr.Dataset(_stack(parts, "width", "point", "axis"), about)


def find_bias(found: xr.Dataset) -> xr.DataArray:
    """Return at which points first order is biased along an axis, by more than a little and more than chance."""
    level = 1 - CHANCE / 2 / found.sizes["axis"]
    sure = xr.apply_ufunc(lambda count: student(np.maximum(count - 1, 1), level), found["count"])
    flags: xr.DataArray = (abs(found["bias"]) > sure * found["bias_error"]).any("axis") & (
        disagreement(found) > NOTABLE_BIAS
    )
    return flags


def disagreement(found: xr.Dataset) -> xr.DataArray:
    """Return |first - zeroth| / (|first| + |zeroth|), dims (width, point): 0 equal, 1 opposite or one is zero."""
    first, zeroth, bias = ((found[name] ** 2).sum("axis", skipna=False) ** 0.5 for name in ("first", "zeroth", "bias"))
    total = first + zeroth
    apart: xr.DataArray = bias / total.where(total > 0, 1.0)
    return apart


def width_table(found: xr.Dataset) -> tuple[WidthRow, ...]:
    """Return a row for each width: points, share biased, disagreement, and zeroth order's variance over first's."""
    rows = list[WidthRow]()
    for width in found["width"].to_numpy():
        part = found.sel(width=width)
        known = np.isfinite(part["bias"].to_numpy()).all(axis=-1)
        first, zeroth = (part[f"{name}_variance"].sum("axis").to_numpy()[known] for name in ("first", "zeroth"))
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = zeroth / first
        flags = find_bias(found).sel(width=width).to_numpy()[known]
        rows.append(
            WidthRow(
                width=float(width),
                points=int(known.sum()),
                of=len(known),
                biased=share(int(flags.sum()), int(known.sum())),
                disagreement=mean(disagreement(found).sel(width=width).to_numpy()[known], least=0, most=1),
                variance_ratio=float(np.nanmedian(ratio)) if np.isfinite(ratio).any() else math.nan,
            )
        )
    return tuple(rows)


def differences_of_samples(loss: Values, axis: int, stride: int) -> Values:
    """Return central differences over 2 * stride samples [loss unit per side of the box]."""
    size = loss.shape[axis]
    moved = np.moveaxis(loss, axis, 0)
    difference = np.full_like(moved, np.nan)
    difference[stride : size - stride] = (moved[2 * stride :] - moved[: size - 2 * stride]) * (size - 1) / (2 * stride)
    return np.moveaxis(difference, 0, axis)


def _compare_orders(
    first: Float[Tensor, "point pair axis"], half: Float[Tensor, "point pair"], w: Float[Tensor, "point pair axis"]
) -> dict[str, Values]:
    """Return means, errors and variances over the successful pairs; NaN with too few to fit a line without one."""
    known = first.isfinite().all(dim=-1) & half.isfinite()
    count = known.sum(dim=1, keepdim=True).double()
    enough, seen = count > w.shape[-1] + 1, known[..., None]

    def moments(values: Tensor) -> tuple[Tensor, Tensor]:
        total = torch.where(seen, values, 0.0).sum(dim=1) / count
        spread = torch.where(seen, values - total[:, None], 0.0).square().sum(dim=1) / (count - 1)
        return torch.where(enough, total, torch.nan), torch.where(enough, spread, torch.nan)

    steady = _reduce_variance(torch.where(known, half, 0.0), torch.where(seen, w, 0.0))
    values = {"first": first, "zeroth": steady, "bias": first - steady}
    found = {"count": count[:, 0], "zeroth_variance": moments(half[..., None] * w)[1]}
    for name, sample in values.items():
        found[name], variance = moments(sample)
        found[f"{name}_error"] = (variance / count).sqrt()
        if name == "first":
            found["first_variance"] = variance
    return {name: part.numpy() for name, part in found.items()}


def _reduce_variance(half: Float[Tensor, "point pair"], w: Float[Tensor, "point pair axis"]) -> Tensor:
    """Return each pair's zeroth-order sample with the fit of the others as its control variate."""
    gram, moment = w[..., :, None] * w[..., None, :], w * half[..., None]
    gram, moment = (part.sum(dim=1, keepdim=True) - part for part in (gram, moment))
    fit = (torch.linalg.pinv(gram) @ moment[..., None])[..., 0]
    steady: Tensor = (half - (fit * w).sum(dim=-1))[..., None] * w + fit
    return steady
