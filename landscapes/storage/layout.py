"""What the arrays of every zarr store have in common."""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any, Literal

import zarr
from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec

FILL = {"float64": float("nan"), "int8": 0, "int64": 0, "string": ""}
CODECS = [ZstdCodec(level=3, checksum=True)]
COMPACT_CODECS = [BloscCodec(cname="zstd", clevel=9, shuffle="shuffle"), Crc32cCodec()]
_QUIET = threading.Lock()  # threads share what warnings are shown
SIDE, VALUES = 256, 1 << 20  # of a chunk of a finished slice: samples along an axis and values in all, at most


def open_group(path: Path, mode: Literal["r", "r+"] = "r") -> zarr.Group:
    """Open a store of zarr's format 3 alone: format 2 has a codec (pickle) that runs what it reads."""
    return zarr.open_group(path, mode=mode, zarr_format=3, use_consolidated=False)


def create_array(
    group: zarr.Group,
    name: str,
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    dims: tuple[str, ...],
    dtype: str,
    codecs: Sequence[Any] = CODECS,
    **attributes: Any,
) -> zarr.Array[Any]:
    """Make an empty array of named dimensions whose torn or altered chunks do not decode."""
    return group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        fill_value=FILL[dtype],
        dimension_names=dims,
        compressors=list(codecs),
        config={"write_empty_chunks": True},  # a chunk of NaN is a result too
        attributes=attributes,
    )


def analysis_chunks(samples: Sequence[int], *deep: int) -> tuple[int, ...]:
    """Return the chunk of an array over so many samples along each axis, which may have another dimension after them.

    A chunk holds a whole map where that is not large, and of as many components of the gradient as make 8 MB.
    """
    sides = tuple(min(count, SIDE) for count in samples)
    return (*sides, *(min(size, max(1, VALUES // math.prod(sides))) for size in deep))


def flags(kind: type[IntEnum]) -> dict[str, Any]:
    """Return the attributes (CF conventions) that say what the codes of an int8 array mean."""
    return {"flag_values": [int(k) for k in kind], "flag_meanings": " ".join(k.name.lower() for k in kind)}


def consolidate(path: Path) -> None:
    """Gather a store's layout in one file, so that plain xarray.open_zarr reads it."""
    with _QUIET, warnings.catch_warnings():  # not in zarr's specification yet
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(str(path))
