"""Points to lay over a slice: runs and races on disk, runs in memory, and points that other programs evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray as xr

from ..landscapes.foreign import SUFFIXES, Note, Trials, experiment_trials, points_table, read_points, study_trials
from ..landscapes.identity import stored_space
from ..landscapes.plain import plain_name
from .folder import run_tables
from .scene import environment_of
from .watch import Watch

if TYPE_CHECKING:
    import pandas as pd

    from ..landscapes.slice import Slice

TABLE, STUDY, EXPERIMENT = "table", "optuna", "ax"  # what points in memory are called
NEGATED = " (negated)"  # after that, where losses are the values of what was maximised


def tables_over(slice: Slice, given: Sequence[Any], watch: Watch | None = None) -> list[xr.Dataset]:
    """Return what runs evaluated, and tables of points, as they are laid over a slice: first runs on disk, then others.

    Each is the folder of a run or a race, a CSV or Parquet file, a `Run`, a pandas table, an Optuna study, or a client
    or an experiment of Ax, whose values are negated where they are maximised. Runs without an episode are left out.
    `watch` is told what is left out of tables and what is made of them.

    Raises ValueError where a path holds none of these, a table lacks a column, or there is no episode at all.
    """
    tables = [one for one in given if _is_table(one)]
    paths = [str(one) for one in given if isinstance(one, str | Path) and not _is_table(one)]
    runs = [one for one in given if not isinstance(one, str | Path) and not _is_table(one)]
    for one in runs:
        if not isinstance(getattr(one, "data", None), xr.Dataset):
            raise ValueError(
                "overlay takes runs, their folders, CSV and Parquet files, pandas tables, Optuna studies and Ax "
                f"experiments; got {one!r}"
            )
    found = [*(run_tables(paths) if paths else []), *(run.data for run in runs if run.data.sizes["evaluation"])]
    if tables:
        space = stored_space(slice.data) or environment_of(slice.data, "cpu").space
        for one in tables:
            frame, name = _frame(one, note := (watch or Watch()).note)
            found.append(points_table(frame, slice.data, space, name, note=note))
    if not found:
        raise ValueError("these runs have no episodes yet; `gradscape.optimize` evaluates them")
    return found


def _is_table(one: Any) -> bool:
    if isinstance(one, str | Path):
        return Path(one).suffix.lower() in SUFFIXES
    return hasattr(one, "trials_dataframe") or hasattr(one, "columns") or _experiment_of(one) is not None


def _experiment_of(one: Any) -> Any:
    """Return the experiment of Ax that this is, or that its client holds; None where it is none."""
    held = getattr(one, "experiment", None) or getattr(one, "_experiment", None) or one
    return held if hasattr(held, "lookup_data") else None


def _frame(one: Any, note: Note) -> tuple[pd.DataFrame, str]:
    """Return a table of points, and what a picture calls it."""
    if isinstance(one, str | Path):
        return read_points(Path(one)), plain_name(Path(one).stem)
    if hasattr(one, "trials_dataframe"):
        return _losses_of(study_trials(one), plain_name(f"{STUDY}-{one.study_name}"), note)
    if (experiment := _experiment_of(one)) is not None:
        return _losses_of(experiment_trials(experiment), plain_name(f"{EXPERIMENT}-{experiment.name}"), note)
    return one, TABLE


def _losses_of(trials: Trials, name: str, note: Note) -> tuple[pd.DataFrame, str]:
    """Return trials and their name, which says where their losses are values of another sign; so does a note."""
    if not trials.negated:
        return trials.frame, name
    note(f"{name} maximises: its values are negated, so that a smaller loss is better")
    return trials.frame, name + NEGATED
