"""Points that other programs evaluated, as a table laid over a slice like a run: CSV, Parquet, pandas, Optuna, Ax."""

from __future__ import annotations

import hashlib
import json
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from .identity import stored_identity
from .objective import Status
from .plain import plain_json
from .space import ParameterSpace
from .storage.layout import flags

if TYPE_CHECKING:
    import pandas as pd
    from torch import Tensor

SUFFIXES = (".csv", ".parquet")
LOSS = "loss"
LISTED = 8  # columns that a message names
ENDED = ("COMPLETED", "FAILED", "ABANDONED", "EARLY_STOPPED")  # of a trial of Ax
DIGITS = 9  # of a row's number, more than any table has


class GivenKind(IntEnum):
    """Say what a point of another program was evaluated for, which is not known."""

    GIVEN = 0


def read_points(path: Path) -> pd.DataFrame:
    """Return the table in a CSV or Parquet file.

    Raises ValueError where the file cannot be read as one.
    """
    import pandas as pd

    try:
        return pd.read_csv(path) if path.suffix.lower() == ".csv" else pd.read_parquet(path)
    except FileNotFoundError:
        raise ValueError(f"there is no table of points at {path}") from None
    except Exception as error:  # whatever pandas or Arrow raise of a file that is no table
        raise ValueError(f"{path} cannot be read as a table: {' '.join(str(error).split())}") from None


def table_point(space: ParameterSpace, text: str) -> Tensor | None:
    """Return the point in a row of a table, FILE:ROW, counted from 1; FILE alone is its row of the least loss.

    The table is a CSV or Parquet file whose columns are called as the parameters, with or without their units in
    brackets. None is returned where `text` names no such file: a CSV file without a name of a parameter is none.
    Raises ValueError where a column is missing or the row is not there, holds no numbers, or is not said: of several
    rows without a loss none is best.
    """
    place, colon, number = text.rpartition(":")
    path, row = (Path(place), number) if colon and number.isdecimal() and len(number) <= DIGITS else (Path(text), "")
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return None
    frame = read_points(path)
    named = {*space.names, *space.labels} & set(frame.columns)
    if not named and path.suffix.lower() == ".csv":
        return None
    at = int(row) - 1 if row else _best_row(frame, path)
    if not 0 <= at < len(frame):
        raise ValueError(f"{path} has {len(frame)} rows of points, counted from 1; got row {row or 1}")
    return space.from_values(torch.from_numpy(_parameters(frame.iloc[[at]], space, str(path))[0]))


def _best_row(frame: pd.DataFrame, path: Path) -> int:
    """Return the number of the row with the least loss, from 0."""
    name = next((name for name in frame.columns if str(name) == LOSS or str(name).startswith(f"{LOSS} [")), None)
    if name is None:
        if len(frame) > 1:
            raise ValueError(f"{path} has {len(frame)} rows and no column {LOSS!r}; say which one, {path}:ROW, from 1")
        return 0
    losses = _column(frame, str(name), name=str(path), gaps=True)
    if not np.isfinite(losses).any():
        raise ValueError(f"no row of {path} has a {LOSS}; say which one, {path}:ROW, counted from 1")
    return int(np.where(np.isfinite(losses), losses, np.inf).argmin())


def study_frame(study: Any) -> pd.DataFrame:
    """Return the trials of an Optuna study that have ended, a column for each parameter and one for the loss.

    A trial that failed or was pruned has no loss.

    Raises ValueError where the study has several goals, or looks for the greatest value.
    """
    directions = [direction.name for direction in study.directions]
    if directions != ["MINIMIZE"]:
        raise ValueError(
            f"Optuna's study {study.study_name!r} has the directions {', '.join(directions)}; a loss is one value that "
            "is minimised, so give a table with a column loss instead"
        )
    trials = study.trials_dataframe(attrs=("value", "params", "state"))
    ended = trials[trials["state"].isin(["COMPLETE", "PRUNED", "FAIL"])]
    values = ended["value"].where(ended["state"] == "COMPLETE")
    names = [str(name) for name in ended.columns if str(name).startswith("params_")]
    return ended[names].rename(columns=lambda name: name.removeprefix("params_")).assign(**{LOSS: values})


def experiment_frame(experiment: Any) -> pd.DataFrame:
    """Return the arms of an Ax experiment's trials that have ended, a column for each parameter and one for the loss.

    An arm of a trial that failed or was abandoned has no loss; of one that was measured step by step the last counts.

    Raises ValueError where the experiment has several goals, or looks for the greatest value.
    """
    import pandas as pd

    config = experiment.optimization_config
    objective = None if config is None else config.objective
    if objective is None or len(objective.metric_names) != 1 or not objective.minimize:
        raise ValueError(
            f"Ax's experiment {experiment.name!r} has the objective {objective}; a loss is one metric that is "
            "minimised, so give a table with a column loss instead"
        )
    data = experiment.lookup_data().df
    measured = data[data["metric_name"] == objective.metric_names[0]]
    losses = dict(zip(measured["arm_name"], measured["mean"], strict=True))  # the last of each arm's
    rows = [
        {**arm.parameters, LOSS: losses.get(arm.name, np.nan) if trial.status.name == "COMPLETED" else np.nan}
        for trial in experiment.trials.values()
        if trial.status.name in ENDED
        for arm in trial.arms
    ]
    return pd.DataFrame(rows)


def points_table(frame: pd.DataFrame, dataset: xr.Dataset, space: ParameterSpace, name: str) -> xr.Dataset:
    """Return the points of a table, a row each in the order of evaluation, as `landscapes.overlay.overlay` takes a run.

    The columns are called as the parameters of the slice `dataset`, with or without their units in brackets, or as
    "loss"; others do not count. A loss that is missing or not finite says that the evaluation failed. `space` is what
    the points are of, `name` what a picture calls them. Gradients are not known.

    Raises ValueError where a column is missing or holds no numbers, and where there is no point.
    """
    unit = str(dataset["loss"].attrs.get("units", ""))
    x = space.from_values(torch.from_numpy(_parameters(frame, space, name))).numpy()
    loss = _column(frame, LOSS, f"{LOSS} [{unit}]", name=name, gaps=True)
    if not len(x):
        raise ValueError(f"{name} holds no point")
    ended = np.where(np.isfinite(loss), Status.OK, Status.NONFINITE).astype(np.int8)
    deep, flat = ("evaluation", "dim"), "evaluation"
    data = {
        "x": (deep, x),
        "loss": (flat, np.where(ended == Status.OK, loss, np.nan), {"units": unit}),
        "grad": (deep, np.full_like(x, np.nan)),
        "kind": (flat, np.zeros(len(x), np.int8), flags(GivenKind)),
        "status": (flat, ended, flags(Status)),
    }
    own = {"method": name, "points": hashlib.sha256(x.tobytes() + loss.tobytes()).hexdigest()[:12]}
    identity = {key: value for key, value in stored_identity(dataset).items() if key != "plane"} | own
    about = {
        "method": name,
        "lower": space.lower.tolist(),
        "upper": space.upper.tolist(),
        "identity": json.dumps(plain_json(identity, "a table's identity")),
    }
    return xr.Dataset(data, {"dim": dataset["dim"].to_numpy()}, about)


def _parameters(frame: pd.DataFrame, space: ParameterSpace, name: str) -> NDArray[np.float64]:
    """Return the parameters in each row, shape (row, dim), which must be finite."""
    columns = [_column(frame, *names, name=name) for names in zip(space.names, space.labels, strict=True)]
    return np.stack(columns, axis=1)


def _column(frame: pd.DataFrame, *names: str, name: str, gaps: bool = False) -> NDArray[np.float64]:
    """Return the first column that has one of the names, as numbers, which must be finite unless `gaps`."""
    import pandas as pd

    found = next((one for one in names if one in frame.columns), None)
    if found is None:
        there = ", ".join(map(str, frame.columns[:LISTED])) + (", ..." if len(frame.columns) > LISTED else "")
        raise ValueError(
            f"{name} has no column {names[0]!r}; its columns are {there or 'none'}. There must be one for each "
            f"parameter, called as it is, and {LOSS}"
        )
    try:
        values: NDArray[np.float64] = pd.to_numeric(frame[found]).to_numpy(np.float64, na_value=np.nan)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the column {found!r} of {name} holds no numbers: {error}") from None
    if not gaps and not np.isfinite(values).all():
        row = int(np.flatnonzero(~np.isfinite(values))[0])
        raise ValueError(f"the column {found!r} of {name} has no number in row {row + 1}")
    return values
