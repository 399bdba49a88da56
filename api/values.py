"""Convert the text of options, from the command line or from Python: names, shares, windows, settings and paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..landscapes.plain import read_share


def as_names(given: str | Sequence[str] | None) -> list[str]:
    """Return names that are given as a,b or several times."""
    texts = [given] if isinstance(given, str) else given or ()
    return [name.strip() for text in texts for name in str(text).split(",") if name.strip()]


LEAST_POWER, MOST_POWER = 5e-4, 0.6  # of the box: what 6000 points find, and what four do


def as_share(given: float | str | None, option: str) -> float | None:
    """Return a share that is given as 1% or 0.01. Raises ValueError where it is neither."""
    if given is None or not isinstance(given, str):
        return given
    try:
        return read_share(given)
    except ValueError:
        raise ValueError(f"{option} takes a share such as 1% or 0.01; got {given!r}") from None


def as_power(given: float | str) -> float:
    """Return the share of the box that a defect fills. Raises ValueError where it is none, or no check finds it."""
    share = as_share(given, "power")
    if share is None or not LEAST_POWER <= share <= MOST_POWER:
        raise ValueError(f"power takes a share of the box from {LEAST_POWER:.2%} to {MOST_POWER:.0%}; got {given}")
    return share


def as_window(given: float | str | tuple[float, float] | None) -> float | tuple[float, float] | None:
    """Return a window that is given as a fraction or as LOW:HIGH. Raises ValueError where it is neither."""
    if not isinstance(given, str):
        return given
    low, colon, high = given.partition(":")
    try:
        return (float(low), float(high)) if colon else float(low)
    except ValueError:
        raise ValueError(
            f"--window takes a fraction or values LOW:HIGH in the parameters' unit; got {given!r}"
        ) from None


def as_settings(given: Mapping[str, Any] | Sequence[str] | None, option: str = "--set") -> dict[str, Any]:
    """Return settings that are given by name, or as name=value each. Raises ValueError where one is not so written."""
    if isinstance(given, Mapping):
        return dict(given)
    found = {}
    for setting in given or ():
        name, equals, value = setting.partition("=")
        if not equals or not name:
            raise ValueError(f"{option} takes name=value; got {setting!r}")
        found[name] = value
    return found


def as_method_settings(
    given: Mapping[str, Mapping[str, Any]] | Sequence[str] | None, methods: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Return settings by method, which may be given as METHOD.NAME=VALUE each.

    Raises ValueError for a method that is none of those that search.
    """
    if isinstance(given, Mapping):
        return {method: dict(settings) for method, settings in given.items()}
    found: dict[str, dict[str, Any]] = {}
    for setting, value in as_settings(given, "--option").items():
        method, dot, name = setting.partition(".")
        if not dot or method not in methods:
            raise ValueError(
                f"--option takes METHOD.NAME=VALUE for one of {', '.join(methods)}; got {setting + '=' + value!r}"
            )
        found.setdefault(method, {})[name] = value
    return found


def as_widths(given: float | Sequence[float] | None) -> list[float]:
    """Return the widths of pages [mm] that a figure is drawn for."""
    return [given] if isinstance(given, int | float) else list(given or ())


def as_path(given: str | Path | None) -> Path | None:
    """Return a folder, None where none is given."""
    return None if given is None else Path(given)
