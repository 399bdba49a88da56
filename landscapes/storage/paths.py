"""Paths of a slice: slice.zarr.zip when it is finished, slice.filling next to it until then.

Earlier versions left a finished slice as a folder, slice.zarr, which can also be read. Each of the three names denotes
the slice, wherever it is now.
"""

from __future__ import annotations

from pathlib import Path

from ..identity import StoreError
from .files import check_ours, foreign_files, lost_root
from .records import read_json

SLICE, FOLDER, ARCHIVE, FILLING = "slice.zarr", ".zarr", ".zip", ".filling"


def filling_path(path: Path) -> Path:
    """Return the path of the tiles of a slice while it is being filled: slice.filling next to slice.zarr.zip."""
    return path.parent / (folder_path(path).name.removesuffix(FOLDER) + FILLING)


def folder_path(path: Path) -> Path:
    """Return the path of a finished slice of earlier versions, slice.zarr, given any of its names."""
    name = path.name.removesuffix(ARCHIVE)
    return path.parent / (name.removesuffix(FILLING) + FOLDER if name.endswith(FILLING) else name)


def archive_path(path: Path) -> Path:
    """Return the single file of a finished slice, slice.zarr.zip, given any of its names."""
    return path.parent / (folder_path(path).name + ARCHIVE)


def slice_places(path: Path) -> tuple[Path, Path, Path]:
    """Return all possible paths of a slice, given any of its names: finished first."""
    return archive_path(path), folder_path(path), filling_path(path)


def finished_path(path: Path) -> Path:
    """Return the present or future path of a finished slice, given any of its names."""
    archive, folder = archive_path(path), folder_path(path)
    return folder if folder.exists() and not archive.exists() else archive


def place_of(path: Path) -> Path:
    """Return the present path of a slice, given any of its names."""
    finished = finished_path(path)
    return finished if finished.exists() else filling_path(path)


def slice_exists(path: Path) -> bool:
    """Return whether anything is at the path of a slice or of its tiles."""
    return place_of(path).exists()


def slice_path(path: Path) -> Path:
    """Return the path of a finished slice, given that or its folder from `landscape slice`."""
    return finished_path(path / SLICE if slice_exists(path / SLICE) else path)


def is_finished(path: Path) -> bool:
    """Return whether a slice, given by its path or by its folder, is finished, rather than one file per tile."""
    return slice_path(path).exists()


def refuse_missing(path: str | Path, what: str) -> None:
    """Raise StoreError where nothing is at the path of `what`; opening it reports other errors."""
    if not slice_exists(Path(path)):
        raise StoreError(f"there is no {what} at {path}; give the folder of one")


def is_slice(path: Path) -> bool:
    """Return whether a slice of this format, finished or not, is at `path`."""
    from .arrays import FORMAT, HEADER, MARK, read_layout

    place = place_of(path)
    try:
        about = read_json(place / HEADER) if place.name.endswith(FILLING) else read_layout(place)["attributes"]
        return bool(about.get(MARK) == FORMAT)
    except Exception:  # whatever else is there is none
        return False


def has_lost_root(place: Path) -> bool:
    """Whether a slice has lost its identification, and everything else in it belongs to a slice."""
    from .arrays import FILES, FILLING_FILES, HEADER, is_torn

    if place.is_file():
        return is_torn(place)
    if not place.name.endswith(FILLING):
        return lost_root(place, FILES)
    try:
        read_json(place / HEADER)
    except (OSError, TypeError, ValueError):
        return place.is_dir() and any(place.iterdir()) and not any(foreign_files(place, FILLING_FILES))
    return False


def check_replaceable(store: Path) -> None:
    """Raise ValueError unless a path is a slice, its root damaged or not, with no other files in it."""
    from .arrays import FILES, FILLING_FILES

    if not is_slice(store) and not has_lost_root(store):
        raise StoreError(f"{store} is not a slice store and is not replaced; move it away or choose another folder")
    if store.is_dir():
        check_ours(store, FILLING_FILES if store.name.endswith(FILLING) else FILES, "a slice")
