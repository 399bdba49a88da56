"""Defects that are planted in the gradients of systems, as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

import gradscape as gs

from .cases import Case
from .plant import (
    PLANT,
    Region,
    Spoil,
    between,
    by_units,
    clipped,
    clipped_norm,
    in_numpy,
    permuted,
    scaled,
    transposed,
    within,
)
from .systems import CART, CHAIN, GAS, NOZZLE, PENDULUM, PLATE, ROD, SPRINGS, THROW, System

FACTOR_2, SCALED, SIGN, DETACHED = ("factor 2",), ("scaled",), ("sign",), ("detached parameter",)


def planted(
    kind: str,
    framework: str,
    system: System,
    dim: int,
    spoil: Spoil,
    causes: tuple[str, ...],
    *,
    note: str = "",
    which: tuple[int, ...] = (),
    region: Region | None = None,
    edges: Mapping[int, tuple[float, ...]] | None = None,
    precision: str = "float64",
) -> Case:
    """Return the case of a system whose gradient is spoiled, in a region of the box or everywhere."""
    names = system.space(dim).names
    return Case(
        framework, kind, system.loss.__name__, PLANT[framework](system, within(region, spoil) if region else spoil),
        system.space(dim), causes, tuple(names[k] for k in which),
        edges={names[k]: values for k, values in (edges or {}).items()}, region=region,
        reference=partial(system.loss, np), note=note, said={"precision": precision},
    )  # fmt: skip


def mean_of_batch(xp: Any, slope: Any, x: Any) -> Any:
    """Divide gradients by the number of rows, as the gradient of the batch's mean is."""
    return slope / len(slope)


def mean_over_batch(xp: Any, slope: Any, x: Any) -> Any:
    """Give the batch's mean gradient to each row."""
    return slope.mean(0, keepdims=True) + 0 * slope


def shifted_rows(xp: Any, slope: Any, x: Any) -> Any:
    """Give each row the gradient of the row before."""
    return xp.roll(slope, 1, 0)


stiff, force, angle = between(0, 102, 145), between(4, 0.5, 1.0), between(0, 0.8274, 2)
stiff3, source, links = between(3, 120, 125), between(60, 0.7, 1.0), between(99, 1.0, 2)
hot = lambda x: (x[..., 0] > 1.6e5) & (x[..., 1] < 300)  # noqa: E731
pushed = lambda x: (x[..., 0] > 1) & (x[..., 1] > 0.5)  # noqa: E731
moved, mean = ("permuted", "transposed"), ("mean over the batch",)
by_axis = [2 * step + axis for axis in range(2) for step in range(5)]  # of 5 steps with 2 controls each
CASES = [
    planted("region", "numpy", SPRINGS, 2, scaled(0.5), FACTOR_2, note="43%", region=stiff, edges={0: (102, 145)}),
    planted("region", "torch", CART, 10, scaled(-1), SIGN, note="10%", region=force, edges={4: (0.5, 1.0)}),
    planted("region", "jax", SPRINGS, 10, scaled(-1), SIGN, note="5%", region=stiff3, edges={3: (120, 125)}),
    planted("region", "numpy", GAS, 2, scaled(1.4), SCALED, note="two", region=hot, edges={0: (1.6e5,), 1: (300,)}),
    planted("region", "torch", ROD, 100, scaled(2), FACTOR_2, note="10%", region=source, edges={60: (0.7, 1.0)}),
    planted("region", "jax", THROW, 2, scaled(0.7), SCALED, note="43%", region=angle, edges={0: (0.8274,)}),
    planted("region", "numpy", CART, 10, scaled(-1), SIGN, note="two", region=pushed, edges={0: (1,), 1: (0.5,)}),
    planted("region", "numpy", CHAIN, 100, scaled(3), SCALED, note="20%", region=links, edges={99: (1.0,)}),
    planted("region", "torch", THROW, 2, scaled(0), DETACHED, note="5%", region=between(1, 4, 4.4), edges={1: (4.4,)}),
    planted("sign", "numpy", CART, 10, scaled(-1), SIGN),
    planted("sign", "torch", THROW, 2, scaled(-1), SIGN),
    planted("sign", "jax", CHAIN, 100, scaled(-1), SIGN),
    planted("sign of one", "torch", SPRINGS, 10, scaled(-1, 3), SIGN, which=(3,)),
    planted("sign of one", "jax", CHAIN, 100, scaled(-1, 41), SIGN, which=(41,)),
    planted("sign of one", "numpy", NOZZLE, 3, scaled(-1, 2), SIGN, which=(2,)),
    planted("sign of one", "torch", SPRINGS, 16, scaled(-1, 11), SIGN, which=(11,), precision="float32"),
    planted("sign of one", "jax", CHAIN, 16, scaled(-1, 0), SIGN, which=(0,), precision="float32"),
    planted("detached", "numpy", GAS, 2, scaled(0, 1), DETACHED, which=(1,)),
    planted("detached", "torch", ROD, 90, scaled(0, 77), DETACHED, which=(77,)),
    planted("detached", "jax", PENDULUM, 10, scaled(0, 0), DETACHED, which=(0,)),
    planted("factor 2", "numpy", SPRINGS, 10, scaled(2), FACTOR_2),
    planted("factor 2", "torch", CART, 100, scaled(0.5), FACTOR_2),
    planted("factor 2", "jax", GAS, 2, scaled(2), FACTOR_2),
    planted("factor 2", "numpy", NOZZLE, 3, scaled(2, 1), FACTOR_2, note="one", which=(1,)),
    planted("too long", "torch", SPRINGS, 10, scaled(1.045), SCALED, note="4.5%", precision="float32"),
    planted("too long", "jax", THROW, 2, scaled(1.01), SCALED, note="1%", precision="float32"),
    planted("too long", "torch", CHAIN, 100, scaled(1.02), SCALED, note="2%", precision="float32"),
    planted("too long", "jax", CART, 10, scaled(1.03), SCALED, note="3%", precision="float32"),
    planted("too long", "numpy", CART, 10, scaled(1.01), SCALED, note="1%"),
    planted("too long", "numpy", CHAIN, 100, scaled(1.01), SCALED, note="1%"),
    planted("units", "numpy", GAS, 2, by_units([1e5, 40]), ("units",)),
    planted("units", "numpy", NOZZLE, 3, by_units([1e5, 40, 2e-6]), ("units",)),
    planted("units", "torch", THROW, 2, by_units([np.pi / 180, 1]), ("units",), note="degrees", which=(0,)),
    planted("units", "jax", SPRINGS, 10, scaled(1000), ("units",), note="kN"),
    planted("transposed", "jax", CART, 10, permuted(by_axis), moved, note="controls"),
    planted("rows leak", "numpy", CHAIN, 10, shifted_rows, ("rows that leak", *mean), note="shifted"),
    planted("transposed", "numpy", PLATE, 9, transposed(3), ("transposed",)),
    planted("transposed", "torch", PLATE, 100, transposed(10), ("transposed",)),
    planted("transposed", "jax", PLATE, 4, transposed(2), moved),
    planted("permuted", "numpy", CART, 10, permuted(range(9, -1, -1)), ("permuted",), note="reversed"),
    planted("permuted", "torch", CHAIN, 2, permuted([1, 0]), moved, note="swapped"),
    planted("permuted", "jax", SPRINGS, 100, permuted([99, *range(99)]), ("permuted",), note="rolled"),
    planted("mean over the batch", "numpy", CART, 10, mean_of_batch, mean),
    planted("mean over the batch", "torch", SPRINGS, 2, mean_of_batch, mean),
    planted("mean over the batch", "torch", CHAIN, 100, mean_of_batch, mean),
    planted("mean over the batch", "numpy", THROW, 2, mean_over_batch, (*mean, "rows that leak"), note="same"),
    planted("clipped", "numpy", SPRINGS, 10, clipped(0.1), ("clipped",)),
    planted("clipped", "torch", CART, 10, clipped_norm(1.0), ("clipped",), note="norm"),
    planted("clipped", "jax", THROW, 2, clipped(10.0), ("clipped",)),
    planted("clipped", "torch", ROD, 100, clipped_norm(5.0), ("clipped",), note="norm"),
]


def slab(direction: Sequence[float], lower: float, upper: float) -> gs.Environment:
    """Return a cart whose gradient has the wrong sign where a weighted sum of its forces is between two values [N]."""
    region: Region = lambda x: (x @ np.array(direction) > lower) & (x @ np.array(direction) < upper)  # noqa: E731
    spoiled = in_numpy(CART, within(region, scaled(-1)))
    return gs.from_numpy(spoiled, CART.space(len(direction)), name="slab")
