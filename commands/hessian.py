"""A Hessian, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .terminal import SIMPLE, Console, number, table

if TYPE_CHECKING:
    from ..landscapes.measures.hessian import Hessian
    from ..landscapes.statistics import Estimate


def show(found: Hessian, console: Console) -> None:
    """Print the eigenvalues with errors and directions, then the summary of the spectrum, then warnings."""
    unit = f" [{found.loss_unit}]" if found.loss_unit else ""
    console.print(f"{found.env} · {found.fidelity} · at {found.through}: {found.kind}; {found.episodes} episodes")
    console.print(f"In {found.units}. From differences of {found.source} over {found.step:.2g} of the box.")
    rows = table("no.", f"eigenvalue{unit}", "error", "sign", "by losses", "direction", box=SIMPLE)
    rows.columns[0].no_wrap = True
    for pair in found.pairs:
        numbers = (f"{pair.value:.6g}", f"{pair.error:.2g}", pair.sign, number(pair.by_losses, ".6g"))
        rows.add_row(str(pair.place), *numbers, pair.direction())
    console.print(rows)
    console.print(f"trace: {_estimate(found.trace)}{'' if found.whole else f', from {len(found.nodes)} random probes'}")
    console.print(f"condition number: {_condition(found.condition)}")
    untold = f"; the sign of {found.undecided:.0%} is uncertain" if found.undecided else ""
    share = found.negative
    bounds = "" if found.whole and not found.undecided else f" ({share.low:.0%} to {share.high:.0%})"
    console.print(f"negative curvature: {share.value:.0%} of the eigenvalues{bounds}{untold}")
    console.print(
        f"asymmetry: {found.asymmetry:.1g}; the finite differences explain {found.asymmetry_explained:.1g} of it"
    )
    for warning in found.warnings:
        console.print(f"warning: {warning}")


def _estimate(one: Estimate) -> str:
    return f"{one.value:.6g} ({one.low:.6g} to {one.high:.6g})"


def _condition(one: Estimate) -> str:
    if one.value == one.value:
        return _estimate(one)
    return f"cannot tell; at least {one.low:.3g}" if one.low == one.low else "cannot tell"
