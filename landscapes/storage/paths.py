"""Paths of a slice: slice.zarr once it is finished, slice.filling.zarr beside it until then."""

from __future__ import annotations

from pathlib import Path

SLICE, FILLING = "slice.zarr", ".filling.zarr"


def filling_path(path: Path) -> Path:
    """Return where the tiles of a slice are while it is being filled: slice.filling.zarr beside slice.zarr."""
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


def refuse_missing(path: str | Path, what: str) -> None:
    """Raise StoreError where nothing is at a path that is to hold `what`; whoever opens it says more."""
    from ..identity import StoreError

    if not slice_exists(Path(path)):
        raise StoreError(f"there is no {what} at {path}; give the folder of one")


def is_slice(path: Path) -> bool:
    """Say whether a slice of this format, finished or not, is at `path`."""
    from .arrays import FORMAT, open_group

    try:
        return open_group(place_of(path)).attrs.get("gradscape_slice") == FORMAT
    except Exception:  # whatever else is there is none
        return False


def check_replaceable(store: Path) -> None:
    """Raise ValueError unless a folder is a slice's, its root damaged or not, and everything in it is of that."""
    from ..identity import StoreError
    from .arrays import FILES
    from .files import check_ours, has_lost_root

    if not is_slice(store) and not has_lost_root(store, FILES):
        raise StoreError(f"{store} is no slice store, so it is not replaced; move it away or write elsewhere")
    check_ours(store, FILES, "a slice")


def corner(array: Path, rank: int) -> tuple[int, ...]:
    """Return how many tiles along each of so many axes there are files of, in an array's folder as zarr names them."""
    rows, columns = _numbers(array / "c"), set[int]()
    if rank == 2:
        columns = columns.union(*(_numbers(array / "c" / str(row)) for row in rows))
    return tuple(max(numbers, default=-1) + 1 for numbers in (rows, columns)[:rank])


def _numbers(folder: Path) -> set[int]:
    return {int(file.name) for file in folder.iterdir() if file.name.isdecimal()} if folder.exists() else set()
