"""All cases of the examination."""

from __future__ import annotations

from . import defects_jax, defects_numpy, defects_torch, defects_warp, healthy, planted
from .cases import Case

DEFECTS = (planted, defects_torch, defects_jax, defects_numpy, defects_warp)


def defects() -> list[Case]:
    """Return the planted defects."""
    return [case for module in DEFECTS for case in module.CASES]


def healthy_functions() -> list[Case]:
    """Return the healthy functions that are awkward to judge."""
    return healthy.CASES
