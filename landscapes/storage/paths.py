"""Paths of a slice: slice.zarr.zip once it is finished, slice.filling next to it until then.

Earlier versions left a finished slice as a folder, slice.zarr, which is read as well. Each of the three names stands
for the slice, wherever it is now.
"""

from __future__ import annotations

from pathlib import Path

from ..identity import StoreError
from .files import check_ours, foreign_files, lost_root
from .records import read_json

SLICE, FOLDER, ARCHIVE, FILLING = "slice.zarr", ".zarr", ".zip", ".filling"


def filling_path(path: Path) -> Path:
    """Return where the tiles of a slice are while it is being filled: slice.filling next to slice.zarr.zip."""
    return path.parent / (folder_path(path).name.removesuffix(FOLDER) + FILLING)


def folder_path(path: Path) -> Path:
    """Return where earlier versions left a finished slice, slice.zarr, given any of its names."""
    name = path.name.removesuffix(ARCHIVE)
    return path.parent / (name.removesuffix(FILLING) + FOLDER if name.endswith(FILLING) else name)


def archive_path(path: Path) -> Path:
    """Return the one file that a slice is once it is finished, slice.zarr.zip, given any of its names."""
    return path.parent / (folder_path(path).name + ARCHIVE)


def slice_places(path: Path) -> tuple[Path, Path, Path]:
    """Return all places that may hold a slice, given any of its names: finished first."""
    return archive_path(path), folder_path(path), filling_path(path)


def finished_path(path: Path) -> Path:
    """Return where a slice is or will be once it is finished, given any of its names."""
    archive, folder = archive_path(path), folder_path(path)
    return folder if folder.exists() and not archive.exists() else archive


def place_of(path: Path) -> Path:
    """Return where a slice is now, given any of its names."""
    finished = finished_path(path)
    return finished if finished.exists() else filling_path(path)


def slice_exists(path: Path) -> bool:
    """Say whether anything is in the place of a slice or of its tiles."""
    return place_of(path).exists()


def slice_path(path: Path) -> Path:
    """Return the path of a slice once it is finished, given that or the folder that `landscape slice` left it in."""
    return finished_path(path / SLICE if slice_exists(path / SLICE) else path)


def is_finished(path: Path) -> bool:
    """Say whether a slice, given by its path or by its folder, is finished, and not a file for each of its tiles."""
    return slice_path(path).exists()


def refuse_missing(path: str | Path, what: str) -> None:
    """Raise StoreError where nothing is at a path that is to hold `what`; whoever opens it says more."""
    if not slice_exists(Path(path)):
        raise StoreError(f"there is no {what} at {path}; give the folder of one")


def is_slice(path: Path) -> bool:
    """Say whether a slice of this format, finished or not, is at `path`."""
    from .arrays import FORMAT, HEADER, MARK, read_layout

    place = place_of(path)
    try:
        about = read_json(place / HEADER) if place.name.endswith(FILLING) else read_layout(place)["attributes"]
        return bool(about.get(MARK) == FORMAT)
    except Exception:  # whatever else is there is none
        return False


def has_lost_root(place: Path) -> bool:
    """Whether a slice does not say what it is any more, and everything else of it is of a slice."""
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
    """Raise ValueError unless what is there is a slice, its root damaged or not, and everything in it is of that."""
    from .arrays import FILES, FILLING_FILES

    if not is_slice(store) and not has_lost_root(store):
        raise StoreError(f"{store} is no slice store, so it is not replaced; move it away or write elsewhere")
    if store.is_dir():
        check_ours(store, FILLING_FILES if store.name.endswith(FILLING) else FILES, "a slice")
