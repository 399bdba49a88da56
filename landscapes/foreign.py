"""Points that other programs evaluated, as a table laid over a slice like a run: CSV, Parquet, pandas, Optuna, Ax."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from .export import unquoted
from .identity import stored_identity
from .objective import Status
from .plain import plain_json
from .space import ParameterSpace
from .storage.arrays import flags

if TYPE_CHECKING:
    import pandas as pd
    from torch import Tensor

SUFFIXES = (".csv", ".parquet")
LOSS, VALUE, STATE = "loss", "value", "state"  # the last two are Optuna's
PARAMETER = "params_"  # what Optuna begins a parameter's column with
LISTED = 8  # columns that a message names
OPTUNA_ENDED = ("COMPLETE", "PRUNED", "FAIL")  # of a trial of Optuna
AX_ENDED = ("COMPLETED", "FAILED", "ABANDONED", "EARLY_STOPPED")  # of a trial of Ax
MISSING = {"", "nan", "na", "n/a", "none", "null", "fail", "failed", "error"}  # instead of a number
SEPARATORS = ",;\t"
DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+(?:[eE][+-]?\d+)?\s*")
DIGITS = 9  # of a row's number, more than any table has

Note = Callable[[str], object]  # takes a line that is worth showing
Values = NDArray[np.float64]


class GivenKind(IntEnum):
    """Say what a point of another program was evaluated for, which is not known."""

    GIVEN = 0


@dataclass(frozen=True)
class Trials:
    """Hold the trials of a search by another program; where it maximised, losses are its values `negated`."""

    frame: pd.DataFrame
    negated: bool


def read_points(path: Path) -> pd.DataFrame:
    """Return the table in a CSV or Parquet file, its rows numbered as in the file: 1 is the heading of a CSV file.

    Raises ValueError where the file cannot be read as one.
    """
    import pandas as pd

    try:
        if path.suffix.lower() == ".csv":
            return _read_csv(path)
        frame = pd.read_parquet(path)
    except FileNotFoundError:
        raise ValueError(f"there is no table of points at {path}") from None
    except Exception as error:  # whatever pandas or Arrow raise of a file that is no table
        raise ValueError(f"{path} cannot be read as a table: {' '.join(str(error).split())}") from None
    return frame.set_axis(range(1, len(frame) + 1))


def _read_csv(path: Path) -> pd.DataFrame:
    """Return the cells of a CSV file, separated by commas, semicolons or tabs, as text; lines without any are no rows.

    Decimal commas become points where commas do not separate. Raises ValueError for a row longer than the heading.
    """
    import pandas as pd

    rows: dict[int, list[str]] = {}
    with path.open(newline="", encoding="utf-8-sig") as file:
        separator = _separator(next((line for line in file if line.strip()), ""))
        file.seek(0)
        reader, line = csv.reader(file, delimiter=separator), 1
        for row in reader:
            if any(cell.strip() for cell in row):
                rows[line] = row
            line = reader.line_num + 1
    if not rows:
        raise ValueError("it is empty; the first row is a heading that names the columns")
    first, *lines = rows
    heading = [unquoted(cell.strip()) for cell in rows[first]]
    for line in lines:
        if any(cell.strip() for cell in rows[line][len(heading) :]):
            raise ValueError(f"row {line} has {len(rows[line])} cells, the heading {len(heading)}")
    cells = [(rows[line] + [""] * len(heading))[: len(heading)] for line in lines]
    if separator != ",":
        cells = [[one.replace(",", ".") if DECIMAL_COMMA.fullmatch(one) else one for one in row] for row in cells]
    return pd.DataFrame(cells, index=lines, columns=heading, dtype=object)


def _separator(heading: str) -> str:
    """Return what separates the cells of a heading: what makes most of them, a comma where nothing does."""
    return max(SEPARATORS, key=lambda one: len(next(csv.reader([heading], delimiter=one), [])))


def table_point(space: ParameterSpace, text: str) -> Tensor | None:
    """Return the point in a row of a table, FILE:ROW; FILE alone is its row of the least loss.

    The table is a CSV or Parquet file whose columns are called as the parameters, with or without their units in
    brackets. ROW counts as the file does: row 1 of a CSV file is its heading. None is returned where `text` names no
    such file: a CSV file without a name of a parameter is none. Raises ValueError where a column is missing or the row
    is not there, holds no numbers, or is not said: of several rows without a loss none is best.
    """
    place, colon, number = text.rpartition(":")
    path, row = (Path(place), number) if colon and number.isdecimal() and len(number) <= DIGITS else (Path(text), "")
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return None
    frame = read_points(path)
    known = {one.casefold() for names in _names(space) for one in names}
    if path.suffix.lower() == ".csv" and known.isdisjoint(_heading(frame, str.casefold)):
        return None
    frame = _points_of(frame, space, str(path))
    x = _parameters(frame, space, str(path))
    at = frame.index.get_indexer([int(row)])[0] if row else _best_row(frame, x, str(path))
    if at < 0:
        heading = " (1 is the heading)" if path.suffix.lower() == ".csv" else ""
        raise ValueError(
            f"{path} has points in its rows {frame.index[0]} to {frame.index[-1]}{heading}; got row {int(row)}"
        )
    if gaps := _gaps(frame, x[[at]], space, str(path)):
        raise ValueError(f"row {frame.index[at]} of {path} has no number in column {gaps[0]}")
    return space.from_values(torch.from_numpy(x[at]))


def _best_row(frame: pd.DataFrame, x: Values, name: str) -> int:
    """Return the position of the row with the least loss, of those that hold a point."""
    names = [one for one in _heading(frame) if one.casefold() == LOSS or one.casefold().startswith(f"{LOSS} [")]
    rows = f"say which one, {name}:ROW, as the file counts them"
    if not names:
        if len(frame) > 1:
            raise ValueError(f"{name} has {len(frame)} rows and no column {LOSS!r}; {rows}")
        return 0
    losses = np.where(np.isfinite(x).all(axis=1), _losses(frame, names, name), np.nan)
    if not np.isfinite(losses).any():
        raise ValueError(f"no row of {name} has a {LOSS}; {rows}")
    return int(np.where(np.isfinite(losses), losses, np.inf).argmin())


def study_trials(study: Any) -> Trials:
    """Return the trials of an Optuna study, numbered as there; of a study that maximises the values are negated.

    Raises ValueError where the study has several goals, or no trial.
    """
    directions = [direction.name for direction in study.directions]
    if len(directions) != 1:
        raise ValueError(
            f"Optuna's study {study.study_name!r} has the directions {', '.join(directions)}; a loss is one value, so "
            f"give a table with a column {LOSS} instead"
        )
    trials = study.trials_dataframe(attrs=("number", VALUE, "params", STATE))
    if not len(trials):
        raise ValueError(f"Optuna's study {study.study_name!r} holds no trial yet; `study.optimize` evaluates them")
    negated = directions == ["MAXIMIZE"]
    if negated:
        trials[VALUE] = -trials[VALUE].astype(float)
    return Trials(trials.set_index("number"), negated)


def experiment_trials(experiment: Any) -> Trials:
    """Return the arms of an Ax experiment's trials that have ended, a column for each parameter and one for the loss.

    An arm of a trial that failed or was abandoned has no loss; of one that was measured step by step the last counts.
    Of an experiment that maximises the values are negated. Raises ValueError where it has several goals, or no arm.
    """
    import pandas as pd

    config = experiment.optimization_config
    objective = None if config is None else config.objective
    if objective is None or len(objective.metric_names) != 1:
        raise ValueError(
            f"Ax's experiment {experiment.name!r} has the objective {objective}; a loss is one metric, so give a table "
            f"with a column {LOSS} instead"
        )
    data, sign = experiment.lookup_data().df, 1.0 if objective.minimize else -1.0
    measured = data[data["metric_name"] == objective.metric_names[0]]
    losses = dict(zip(measured["arm_name"], sign * measured["mean"], strict=True))  # the last of each arm's
    rows = [
        {**arm.parameters, LOSS: losses.get(arm.name, np.nan) if trial.status.name == "COMPLETED" else np.nan}
        for trial in experiment.trials.values()
        if trial.status.name in AX_ENDED
        for arm in trial.arms
    ]
    if not rows:
        raise ValueError(f"Ax's experiment {experiment.name!r} holds no trial that has ended")
    return Trials(pd.DataFrame(rows), sign < 0)


def points_table(
    frame: pd.DataFrame, dataset: xr.Dataset, space: ParameterSpace, name: str, *, note: Note = lambda _: None
) -> xr.Dataset:
    """Return the points of a table, a row each in the order of evaluation, as `landscapes.overlay.overlay` takes a run.

    The columns are called as the parameters of the slice `dataset`, with or without their units in brackets, or as
    "loss", or as Optuna's `trials_dataframe` calls them; others do not count. A loss that is missing or not finite says
    that the evaluation failed. A row without a number for each parameter is skipped, and counted in the attribute
    `skipped`; `note` takes what is said of it. `space` is what the points are of, `name` what a picture calls them.
    Gradients are not known.

    Raises ValueError where a column is missing, is there twice or holds no numbers, and where there is no point.
    """
    unit = str(dataset["loss"].attrs.get("units", ""))
    frame = _points_of(frame, space, name, note)
    x, loss = _parameters(frame, space, name), _losses(frame, (LOSS, f"{LOSS} [{unit}]"), name)
    point = np.isfinite(x).all(axis=1)
    skipped = int((~point).sum())
    if gaps := ", ".join(_gaps(frame, x, space, name)):
        note(f"{name}: {skipped} of {len(x)} rows skipped: no number in column {gaps}")
    if not point.any():
        raise ValueError(f"{name} holds no point: each of its {len(x)} rows lacks a number in column {gaps}")
    points = space.from_values(torch.from_numpy(x[point])).numpy()
    return _run_of(points, loss[point], dataset, space, name).assign_attrs(skipped=skipped)


def _run_of(x: Values, loss: Values, dataset: xr.Dataset, space: ParameterSpace, name: str) -> xr.Dataset:
    """Return points and their losses as a run of the landscape of which `dataset` is a slice."""
    ended = np.where(np.isfinite(loss), Status.OK, Status.NONFINITE).astype(np.int8)
    deep, flat = ("evaluation", "dim"), "evaluation"
    data = {
        "x": (deep, x),
        "loss": (flat, np.where(ended == Status.OK, loss, np.nan), {"units": dataset["loss"].attrs.get("units", "")}),
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


def _points_of(frame: pd.DataFrame, space: ParameterSpace, name: str, note: Note = lambda _: None) -> pd.DataFrame:
    """Return the rows of a table that may hold points: not one of units below the heading, nor trials that continue.

    Raises ValueError where there is none.
    """
    if len(frame) and (units := _units(frame, space)):
        note(f"{name}: row {frame.index[0]} holds units ({', '.join(units)}) and is no point")
        frame = frame.iloc[1:]
    if not len(frame):
        raise ValueError(f"{name} holds no point: below its heading there is no row of numbers")
    ended = _ended(frame)
    if len(ended) < len(frame):
        note(f"{name}: {len(frame) - len(ended)} of {len(frame)} trials have not ended and are left out")
    if not len(ended):
        raise ValueError(f"{name} holds no point: none of its {len(frame)} trials has ended")
    return ended


def _units(frame: pd.DataFrame, space: ParameterSpace) -> list[str]:
    """Return the words of the first row where it holds units.

    It does where no cell is a number, none says that one lacks, and a word stands in a column that should hold numbers.
    """
    wanted = {one.casefold() for names in _names(space) for one in names} | {LOSS, VALUE}
    cells = dict(zip(_heading(frame, str.casefold), frame.iloc[0].tolist(), strict=False))
    words = {name: cell.strip() for name, cell in cells.items() if _is_word(cell)}
    blank = all(name in words or str(cell).strip() in ("", "nan", "None", "<NA>") for name, cell in cells.items())
    return list(words.values()) if blank and wanted & words.keys() else []


def _ended(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the trials of Optuna's `trials_dataframe` that have ended, with a loss where they are complete.

    Any other table is returned as it is.
    """
    names = _heading(frame)
    if names.count(VALUE) != 1 or names.count(STATE) != 1:
        return frame
    frame = frame.set_axis(names, axis=1)
    state = frame[STATE].astype(str).str.upper().str.rpartition(".")[2]
    losses = frame[VALUE].astype(object).where(state == "COMPLETE", np.nan)
    found = frame.drop(columns=VALUE).assign(**{LOSS: losses}) if LOSS not in names else frame
    return found[state.isin(OPTUNA_ENDED)]


def _heading(frame: pd.DataFrame, case: Callable[[str], str] = str) -> list[str]:
    """Return the names of the columns; those of several levels, as Optuna may have them, are joined."""
    parts = (one if isinstance(one, tuple) else (one,) for one in frame.columns)
    return [case("_".join(str(part) for part in name if part != "").strip()) for name in parts]


def _names(space: ParameterSpace) -> list[tuple[str, str, str]]:
    """Return what the column of each parameter may be called."""
    return [(name, label, PARAMETER + name) for name, label in zip(space.names, space.labels, strict=True)]


def _parameters(frame: pd.DataFrame, space: ParameterSpace, name: str) -> Values:
    """Return the parameters in each row, shape (row, dim), NaN where there is no number.

    Raises ValueError where a column is missing, is there twice, or holds no number at all.
    """
    columns = []
    for at in _places(frame, space, name):
        columns.append(_column(frame, at))
        if not np.isfinite(columns[-1]).any():
            _refuse_words(frame, at, name)
    found = np.stack(columns, axis=1)
    return np.where(np.isfinite(found), found, np.nan)


def _places(frame: pd.DataFrame, space: ParameterSpace, name: str) -> list[int]:
    """Return where the column of each parameter is."""
    every = _names(space)
    return [_place(frame, own, name, {one for other in every if other != own for one in other}) for own in every]


def _gaps(frame: pd.DataFrame, x: Values, space: ParameterSpace, name: str) -> list[str]:
    """Return the names of the columns that lack a number for a parameter in any row of `x`."""
    heading, lacks = _heading(frame), np.flatnonzero(~np.isfinite(x).all(axis=0))
    places = _places(frame, space, name)
    return [heading[places[number]] for number in lacks]


def _losses(frame: pd.DataFrame, names: Sequence[str], name: str) -> Values:
    """Return the loss in each row, not finite where there is none.

    Raises ValueError where the column is missing, is there twice, or holds words alone that do not say that.
    """
    at = _place(frame, names, name)
    values = _column(frame, at)
    if not np.isfinite(values).any() and any(_is_word(cell) for cell in frame.iloc[:, at]):
        _refuse_words(frame, at, name)
    return values


def _place(frame: pd.DataFrame, names: Sequence[str], name: str, others: Collection[str] = ()) -> int:
    """Return where the column is that has one of the names, or else one of them in other capitals.

    What is exactly the name of one of the `others` is theirs. Raises ValueError where there is none, or several are.
    """
    heading = _heading(frame)
    folded = [one.casefold() for one in names]
    exact = [at for at, one in enumerate(heading) if one in names]
    found = exact or [at for at, one in enumerate(heading) if one.casefold() in folded and one not in others]
    if len(found) == 1:
        return found[0]
    if found:
        twice = " and ".join(f"{heading[at]!r} (column {at + 1})" for at in found)
        raise ValueError(f"{name} has several columns for {names[0]!r}: {twice}; keep one of them")
    there = ", ".join(heading[:LISTED]) + (", ..." if len(heading) > LISTED else "")
    raise ValueError(
        f"{name} has no column {names[0]!r}; its columns are {there or 'none'}. There must be one for each "
        f"parameter, called as it is, and {LOSS}"
    )


def _column(frame: pd.DataFrame, at: int) -> Values:
    """Return a column as numbers, NaN where a cell holds none."""
    cells = frame.iloc[:, at]
    if getattr(cells.dtype, "kind", "O") in "iufb":
        numbers: Values = cells.to_numpy(np.float64, na_value=np.nan)
        return numbers
    return np.array([_number(cell) for cell in cells], dtype=np.float64)


def _number(cell: Any) -> float:
    """Return a cell as a number, NaN where it is none."""
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def _is_word(cell: Any) -> bool:
    """Return whether a cell holds something that is no number, and does not say that a number lacks."""
    return isinstance(cell, str) and np.isnan(_number(cell)) and cell.strip().casefold() not in MISSING


def _refuse_words(frame: pd.DataFrame, at: int, name: str) -> None:
    """Raise ValueError for a column without a number, with the first cell that it holds in its place."""
    cells = frame.iloc[:, at]
    first = next((row for row, cell in enumerate(cells) if _is_word(cell)), 0)
    there = f"row {frame.index[first]} has {cells.iloc[first]!r}"
    raise ValueError(f"the column {_heading(frame)[at]!r} of {name} holds no numbers: {there}")
