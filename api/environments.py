"""`gs.list_envs`: what there is to simulate."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..envs.registry import complete_entry, entries

if TYPE_CHECKING:
    import pandas as pd


def list_envs() -> pd.DataFrame:
    """Return every registered environment, a row each: name, dim, parameters with units, model, fidelities.

    Of those that other packages register, the class is imported for that.
    """
    import pandas as pd

    rows = [
        {"name": one.name, "dim": one.dim, "parameters": one.parameters, "model": one.model,
         "fidelities": ", ".join(one.fidelities)}
        for one in map(complete_entry, entries().values())
    ]  # fmt: skip
    return pd.DataFrame(rows).set_index("name")
