"""`gs.list_envs`, and the verbs `envs` and `methods`: the environments, and the optimisation methods."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from ..envs.registry import complete_entry, entries
from .call import verb
from .options import ARGUMENT

if TYPE_CHECKING:
    import pandas as pd

    from ..envs.base import Environment
    from ..envs.registry import Entry
    from ..optim.base import Optimizer
    from ..optim.registry import Method


def list_envs() -> pd.DataFrame:
    """Return a table of all registered environments: name, dim, parameters with units, model, fidelities.

    This imports the environments that other packages register.
    """
    import pandas as pd

    rows = [
        {"name": one.name, "dim": one.dim, "parameters": one.parameters, "model": one.model,
         "fidelities": ", ".join(one.fidelities)}
        for one in map(complete_entry, entries().values())
    ]  # fmt: skip
    return pd.DataFrame(rows).set_index("name")


@verb
def envs(name: Annotated[str | None, ARGUMENT] = None) -> Environment | list[Entry]:
    """List the environments, or describe one in full.

    With NAME it shows what the environment models, its bounds, fidelities, engines, options and examples. It also shows
    how close the time step is to the stability limit, if `landscape study extremes` has measured that. It writes no
    file.

    Example: landscape envs fluid

    Parameters
    ----------
    name
        Name of the environment to describe in full.
    """
    if not name:
        return list(map(complete_entry, entries().values()))
    from ..envs.registry import make, refuse_unknown

    refuse_unknown(name)
    return make(name, device="cpu")


@verb
def methods(name: Annotated[str | None, ARGUMENT] = None) -> type[Optimizer] | list[Method]:
    """List the optimisation methods, or describe one with its options.

    It writes no file.

    Example: landscape methods bo-leap

    Parameters
    ----------
    name
        Name of the method to describe in full.
    """
    from ..optim.registry import methods as registered
    from ..optim.registry import optimizer_class

    return optimizer_class(name) if name else list(registered().values())
