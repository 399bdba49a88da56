"""Paths of a slice: slice.zarr once it is finished, slice.filling next to it until then."""

from __future__ import annotations

from pathlib import Path

from ..identity import StoreError
from .files import check_ours, foreign_files, lost_root
from .records import read_json

SLICE, FILLING = "slice.zarr", ".filling"


def filling_path(path: Path) -> Path:
    """Return where the tiles of a slice are while it is being filled: slice.filling next to slice.zarr."""
    return path.with_name(path.name.removesuffix(".zarr") + FILLING)


def finished_path(path: Path) -> Path:
    """Return where a slice will be once it is finished, given that place or the one of its tiles."""
    return path.with_name(path.name.removesuffix(FILLING) + ".zarr") if path.name.endswith(FILLING) else path


def place_of(path: Path) -> Path:
    """Return where a slice is now."""
    return path if path.exists() else filling_path(path)


def slice_exists(path: Path) -> bool:
    """Say whether anything is in the place of a slice or of its tiles."""
    return place_of(path).exists()


def slice_path(path: Path) -> Path:
    """Return the path of a slice once it is finished, given that or the folder that `landscape slice` left it in."""
    return path / SLICE if slice_exists(path / SLICE) else finished_path(path)


def is_finished(path: Path) -> bool:
    """Say whether a slice, given by its path or by its folder, is finished, and not a file for each of its tiles."""
    return slice_path(path).exists()


def refuse_missing(path: str | Path, what: str) -> None:
    """Raise StoreError where nothing is at a path that is to hold `what`; whoever opens it says more."""
    if not slice_exists(Path(path)):
        raise StoreError(f"there is no {what} at {path}; give the folder of one")


def is_slice(path: Path) -> bool:
    """Say whether a slice of this format, finished or not, is at `path`."""
    from .arrays import FORMAT, HEADER, MARK, open_group

    place = place_of(path)
    try:
        about = read_json(place / HEADER) if place.name.endswith(FILLING) else open_group(place).attrs
        return about.get(MARK) == FORMAT
    except Exception:  # whatever else is there is none
        return False


def has_lost_root(place: Path) -> bool:
    """Whether a slice has lost the file that says what it is, and everything else in its folder is of a slice."""
    from .arrays import FILES, FILLING_FILES, HEADER

    if not place.name.endswith(FILLING):
        return lost_root(place, FILES)
    try:
        read_json(place / HEADER)
    except (OSError, TypeError, ValueError):
        return place.is_dir() and any(place.iterdir()) and not any(foreign_files(place, FILLING_FILES))
    return False


def check_replaceable(store: Path) -> None:
    """Raise ValueError unless a folder is a slice's, its root damaged or not, and everything in it is of that."""
    from .arrays import FILES, FILLING_FILES

    if not is_slice(store) and not has_lost_root(store):
        raise StoreError(f"{store} is no slice store, so it is not replaced; move it away or write elsewhere")
    check_ours(store, FILLING_FILES if store.name.endswith(FILLING) else FILES, "a slice")
