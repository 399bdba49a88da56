"""`gs.plan`: what another verb will take, before it starts."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from ..jobs.watch import Planned, Watch
from .call import calling, current, hint_of, verb
from .options import ARGUMENT, Out

if TYPE_CHECKING:
    from ..jobs.plan import Plan
    from ..jobs.watch import Work


class _Planner(Watch):
    """Take the work of the job that is about to begin, and stop it there."""

    def plan(self, works: Iterable[Work]) -> None:
        """Take what a job would do."""
        raise Planned(list(works))


@verb
def plan(verb: Annotated[Callable[..., Any], ARGUMENT], *given: Any, **named: Any) -> Plan:
    """Predict the episodes, time, memory and disk of another verb before computing it.

    The time is the number of episodes times the time of one, which is measured now on a few. A formula gives the size
    of the files. The time of search methods and pictures themselves is not included. For a CUDA device that this
    machine does not have, it uses rates that `landscape study fidelity` stored. It writes no file.

    Raises ValueError if the verb refuses its arguments, or if no rates are stored for a device that is not here.

    Example: landscape plan slice fluid --dims 6 8 --resolution 48 --fidelity standard

    Parameters
    ----------
    verb
        The verb to plan, followed by its own arguments and options. In Python it is the function, such as
        `gradscape.slice`.
    """
    call, elsewhere = current(), _elsewhere(named)
    works = work_of(verb, given, named | ({"device": "cpu"} if elsewhere else {}))
    if not works:
        raise ValueError(f"{verb.__name__} simulates nothing, so there is nothing to plan: it takes only seconds")
    from ..jobs.plan import plan_work

    return plan_work(works, call.command, call.watch, device=elsewhere)


def work_of(verb: Callable[..., Any], given: Sequence[Any], named: dict[str, Any]) -> Sequence[Work]:
    """Return what a call of a verb would simulate. Raises ValueError for what the verb refuses before that."""
    with tempfile.TemporaryDirectory() as folder:
        if (out := signature(verb).parameters.get("out")) and hint_of(verb, out.annotation) is Out:
            named = named | {"out": str(Path(folder) / "planned")}
        try:
            with calling(replace(current(), watch=_Planner())):
                verb(*given, **named)
        except Planned as planned:
            return planned.works
    return []


def _elsewhere(named: dict[str, Any]) -> str | None:
    """Return the device that is asked for and not here."""
    if named.get("device") != "cuda":
        return None
    from ..envs.engines.runtime import cuda_available

    return None if cuda_available() else "cuda"
