"""Runs as tables, of points that a test chooses."""

import numpy as np
import torch
import xarray as xr

from gradscape.landscapes.objective import Objective

KINDS = ("random", "population", "descent", "acquisition", "policy")


def run_table(objective: Objective, x: np.ndarray, kind: list[int], *, method: str, seed: int, grad: bool = True):
    """Return the table of a run that evaluated these points, each of a kind by its number among `KINDS`."""
    done, space = objective.evaluate(torch.from_numpy(x)), objective.space
    slope = done.grad.numpy() if grad else np.full_like(x, np.nan)
    columns = {"x": x, "grad": slope, "loss": done.loss.numpy(), "status": done.status.numpy(), "kind": kind}
    shaped = {name: (("evaluation", "dim")[: np.ndim(values)], values) for name, values in columns.items()}
    table = xr.Dataset(shaped, {"dim": list(space.names)})
    table["kind"].attrs = {"flag_values": list(range(len(KINDS))), "flag_meanings": " ".join(KINDS)}
    return table.assign_attrs(method=method, seed=seed, lower=space.lower.tolist(), upper=space.upper.tolist())
