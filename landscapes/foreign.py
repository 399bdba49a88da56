"""Points that other programs evaluated, overlaid on a slice like a run: CSV, Parquet, pandas, Optuna, Ax."""

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
    """The purpose of a point of another program, which is unknown."""

    GIVEN = 0


@dataclass(frozen=True)
class Trials:
    """The trials of a search by another program; if it maximised, losses are its values `negated`."""

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
    """Return the cells of a CSV file, separated by commas, semicolons or tabs, as text; empty lines are skipped.

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
    """Return the separator of a heading's cells: the one that makes most cells, a comma where none does."""
    return max(SEPARATORS, key=lambda one: len(next(csv.reader([heading], delimiter=one), [])))


def table_point(space: ParameterSpace, text: str) -> Tensor | None:
    """Return the point in a row of a table, FILE:ROW; FILE alone is its row with the lowest loss.

    The table is a CSV or Parquet file whose columns have the names of the parameters, with or without their units in
    brackets. ROW counts as in the file: row 1 of a CSV file is its heading. Returns None where `text` names no such
    file; a CSV file without a parameter name does not count. Raises ValueError where a column or the row is missing,
    where the row has no numbers, and where several rows without a loss leave the choice open.
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
            f"{path} has points in rows {frame.index[0]} to {frame.index[-1]}{heading}; got row {int(row)}"
        )
    if gaps := _gaps(frame, x[[at]], space, str(path)):
        raise ValueError(f"row {frame.index[at]} of {path} has no number in column {gaps[0]}")
    return space.from_values(torch.from_numpy(x[at]))


def _best_row(frame: pd.DataFrame, x: Values, name: str) -> int:
    """Return the position of the row with the lowest loss among those with a point."""
    names = [one for one in _heading(frame) if one.casefold() == LOSS or one.casefold().startswith(f"{LOSS} [")]
    rows = f"choose one as {name}:ROW, counted as in the file"
    if not names:
        if len(frame) > 1:
            raise ValueError(f"{name} has {len(frame)} rows and no column {LOSS!r}; {rows}")
        return 0
    losses = np.where(np.isfinite(x).all(axis=1), _losses(frame, names, name), np.nan)
    if not np.isfinite(losses).any():
        raise ValueError(f"no row of {name} has a {LOSS}; {rows}")
    return int(np.where(np.isfinite(losses), losses, np.inf).argmin())


def study_trials(study: Any) -> Trials:
    """Return the trials of an Optuna study, with its numbers; values are negated if the study maximises.

    Raises ValueError where the study has several goals, or no trial.
    """
    directions = [direction.name for direction in study.directions]
    if len(directions) != 1:
        raise ValueError(
            f"Optuna's study {study.study_name!r} has the directions {', '.join(directions)}; a loss is a single "
            f"value, so pass a table with a column {LOSS} instead"
        )
    trials = study.trials_dataframe(attrs=("number", VALUE, "params", STATE))
    if not len(trials):
        raise ValueError(f"Optuna's study {study.study_name!r} has no trial yet; run `study.optimize` first")
    negated = directions == ["MAXIMIZE"]
    if negated:
        trials[VALUE] = -trials[VALUE].astype(float)
    return Trials(trials.set_index("number"), negated)


def experiment_trials(experiment: Any) -> Trials:
    """Return the arms of an Ax experiment's ended trials, a column for each parameter and one for the loss.

    An arm of a failed or abandoned trial has no loss. If a trial was measured step by step, the last value counts.
    Values are negated if the experiment maximises. Raises ValueError where it has several goals, or no arm.
    """
    import pandas as pd

    config = experiment.optimization_config
    objective = None if config is None else config.objective
    if objective is None or len(objective.metric_names) != 1:
        raise ValueError(
            f"Ax's experiment {experiment.name!r} has the objective {objective}; a loss is a single metric, so pass a "
            f"table with a column {LOSS} instead"
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
        raise ValueError(f"Ax's experiment {experiment.name!r} has no ended trial")
    return Trials(pd.DataFrame(rows), sign < 0)


def points_table(
    frame: pd.DataFrame, dataset: xr.Dataset, space: ParameterSpace, name: str, *, note: Note = lambda _: None
) -> xr.Dataset:
    """Return the points of a table, a row each in the order of evaluation, as `landscapes.overlay.overlay` takes a run.

    Columns have the names of the parameters of the slice `dataset`, with or without their units in brackets, "loss", or
    the names in Optuna's `trials_dataframe`. Other columns are ignored. A missing or non-finite loss means that the
    evaluation failed. A row without a number for each parameter is skipped, and counted in the attribute `skipped`;
    `note` receives the messages. `space` is the space of the points, and `name` labels them in a picture. Gradients are
    unknown. Raises ValueError where a column is missing, duplicate or without numbers, and where there is no point.
    """
    unit = str(dataset["loss"].attrs.get("units", ""))
    frame = _points_of(frame, space, name, note)
    x, loss = _parameters(frame, space, name), _losses(frame, (LOSS, f"{LOSS} [{unit}]"), name)
    point = np.isfinite(x).all(axis=1)
    skipped = int((~point).sum())
    if gaps := ", ".join(_gaps(frame, x, space, name)):
        note(f"{name}: {skipped} of {len(x)} rows skipped: no number in column {gaps}")
    if not point.any():
        raise ValueError(f"{name} has no point: each of its {len(x)} rows lacks a number in column {gaps}")
    points = space.from_values(torch.from_numpy(x[point])).numpy()
    return _run_of(points, loss[point], dataset, space, name).assign_attrs(skipped=skipped)


def _run_of(x: Values, loss: Values, dataset: xr.Dataset, space: ParameterSpace, name: str) -> xr.Dataset:
    """Return points and their losses as a run in the landscape of the slice `dataset`."""
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
    """Return the rows of a table that can be points: no row of units below the heading, no running trials.

    Raises ValueError where there is none.
    """
    if len(frame) and (units := _units(frame, space)):
        note(f"{name}: row {frame.index[0]} contains units ({', '.join(units)}) and is skipped")
        frame = frame.iloc[1:]
    if not len(frame):
        raise ValueError(f"{name} has no point: there is no row of numbers below its heading")
    ended = _ended(frame)
    if len(ended) < len(frame):
        note(f"{name}: {len(frame) - len(ended)} of {len(frame)} trials have not ended and are left out")
    if not len(ended):
        raise ValueError(f"{name} has no point: none of its {len(frame)} trials has ended")
    return ended


def _units(frame: pd.DataFrame, space: ParameterSpace) -> list[str]:
    """Return the words of the first row if it contains units.

    It does if no cell is a number or marks a missing one, and a word is in a column for numbers.
    """
    wanted = {one.casefold() for names in _names(space) for one in names} | {LOSS, VALUE}
    cells = dict(zip(_heading(frame, str.casefold), frame.iloc[0].tolist(), strict=False))
    words = {name: cell.strip() for name, cell in cells.items() if _is_word(cell)}
    blank = all(name in words or str(cell).strip() in ("", "nan", "None", "<NA>") for name, cell in cells.items())
    return list(words.values()) if blank and wanted & words.keys() else []


def _ended(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the trials of Optuna's `trials_dataframe` that have ended, with a loss where they are complete.

    Any other table is returned unchanged.
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
    """Return the names of the columns; those of several levels, as Optuna can have them, are joined."""
    parts = (one if isinstance(one, tuple) else (one,) for one in frame.columns)
    return [case("_".join(str(part) for part in name if part != "").strip()) for name in parts]


def _names(space: ParameterSpace) -> list[tuple[str, str, str]]:
    """Return the possible names of the column of each parameter."""
    return [(name, label, PARAMETER + name) for name, label in zip(space.names, space.labels, strict=True)]


def _parameters(frame: pd.DataFrame, space: ParameterSpace, name: str) -> Values:
    """Return the parameters in each row, shape (row, dim), NaN where there is no number.

    Raises ValueError where a column is missing, duplicate, or without any number.
    """
    columns = []
    for at in _places(frame, space, name):
        columns.append(_column(frame, at))
        if not np.isfinite(columns[-1]).any():
            _refuse_words(frame, at, name)
    found = np.stack(columns, axis=1)
    return np.where(np.isfinite(found), found, np.nan)


def _places(frame: pd.DataFrame, space: ParameterSpace, name: str) -> list[int]:
    """Return the position of the column of each parameter."""
    every = _names(space)
    return [_place(frame, own, name, {one for other in every if other != own for one in other}) for own in every]


def _gaps(frame: pd.DataFrame, x: Values, space: ParameterSpace, name: str) -> list[str]:
    """Return the names of the columns that lack a number for a parameter in any row of `x`."""
    heading, lacks = _heading(frame), np.flatnonzero(~np.isfinite(x).all(axis=0))
    places = _places(frame, space, name)
    return [heading[places[number]] for number in lacks]


def _losses(frame: pd.DataFrame, names: Sequence[str], name: str) -> Values:
    """Return the loss in each row, not finite where there is none.

    Raises ValueError where the column is missing, duplicate, or has only words that do not mean a missing loss.
    """
    at = _place(frame, names, name)
    values = _column(frame, at)
    if not np.isfinite(values).any() and any(_is_word(cell) for cell in frame.iloc[:, at]):
        _refuse_words(frame, at, name)
    return values


def _place(frame: pd.DataFrame, names: Sequence[str], name: str, others: Collection[str] = ()) -> int:
    """Return the position of the column with one of the names, or else with one of them in other capitals.

    A column with exactly a name in `others` belongs to them. Raises ValueError where there is none, or several.
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
        f"{name} has no column {names[0]!r}; its columns are {there or 'none'}. It needs a column for each parameter, "
        f"with its name, and {LOSS}"
    )


def _column(frame: pd.DataFrame, at: int) -> Values:
    """Return a column as numbers, NaN for cells without a number."""
    cells = frame.iloc[:, at]
    if getattr(cells.dtype, "kind", "O") in "iufb":
        numbers: Values = cells.to_numpy(np.float64, na_value=np.nan)
        return numbers
    return np.array([_number(cell) for cell in cells], dtype=np.float64)


def _number(cell: Any) -> float:
    """Return a cell as a number, NaN if it is none."""
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def _is_word(cell: Any) -> bool:
    """Return whether a cell is no number, and does not mark a missing one."""
    return isinstance(cell, str) and np.isnan(_number(cell)) and cell.strip().casefold() not in MISSING


def _refuse_words(frame: pd.DataFrame, at: int, name: str) -> None:
    """Raise ValueError for a column without a number, quoting its first cell."""
    cells = frame.iloc[:, at]
    first = next((row for row, cell in enumerate(cells) if _is_word(cell)), 0)
    there = f"row {frame.index[first]} has {cells.iloc[first]!r}"
    raise ValueError(f"the column {_heading(frame)[at]!r} of {name} contains no numbers: {there}")
