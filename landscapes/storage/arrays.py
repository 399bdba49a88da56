"""The arrays of a slice and their attributes, by the CF conventions."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from ..capacity import BLOCK, Need, require
from ..identity import BOUNDS, PACKAGE, VERSIONS, with_package
from ..objective import Status
from ..plane import Plane
from ..space import LOG10, ParameterSpace
from .checksums import SUMS, lay_out_sums, text_sum, write_sums
from .layout import CODECS, COMPACT_CODECS, analysis_chunks, consolidate, create_array, flags
from .ownership import store_files
from .tiles import coarse_to_fine, tile_side

FORMAT = 2
AXES = ("u", "v")
CF = "CF-1.11"
INTERPOLATED = "interpolated"  # the array of a refined slice that has what was not sampled
FILES = store_files(("loss", "grad", "status", INTERPOLATED, SUMS, *AXES, "dim", "unit"))  # of a slice on disk
DRAWN = 150  # bytes that a picture takes for each sample
COORDINATES = {"coordinates": "unit"}  # tells xarray that it is no variable


def axes_of(plane: Plane, parameters: list[str], units: list[str], *, ascending: bool) -> dict[str, NDArray[Any]]:
    """Return the coordinates of a slice in stored order: ascending, or coarse to fine while tiles are being filled."""
    found: dict[str, NDArray[Any]] = {}
    for name, axis in zip(AXES, plane.axes(), strict=False):
        values = axis.numpy()
        found[name] = values if ascending else values[coarse_to_fine(len(values), tile_side(len(values)))]
    return found | {"dim": np.array(parameters, dtype=object), "unit": np.array(units, dtype=object)}


def need_of(shape: tuple[int, ...], dim: int, *, grad: bool) -> Need:
    """Return an upper bound of what sampling a slice takes: memory beside what the process holds, and disk.

    In memory there are four copies of the arrays when it is finished and sorted, and what a picture takes. On the disk
    there are the files of the tiles, and for a moment the finished slice beside them.
    """
    points, depth = math.prod(shape), dim if grad else 0
    tiles = math.prod(-(-side // tile_side(side)) for side in shape)
    array = points * (9 + 8 * depth)
    return Need(4.0 * (8 * points + array) + DRAWN * points, 2.0 * array + tiles * (2 + grad) * BLOCK)


def refuse_too_large(plane: Plane, path: Path | None, *, grad: bool) -> None:
    """Refuse a slice that is larger than this machine, in memory alone where there is no path.

    Raises TooLargeError.
    """
    most = max(plane.resolution)

    def need(side: int) -> Need:
        return need_of(tuple(-(-points * side // most) for points in plane.resolution), plane.dim, grad=grad)

    require("resolution", most, need, path)


def lay_out(
    group: zarr.Group,
    plane: Plane,
    space: ParameterSpace,
    identity: Mapping[str, Any],
    provenance: Mapping[str, Any],
    *,
    grad: bool,
) -> None:
    """Make the empty arrays of a slice that is to be filled tile by tile."""
    axes = axes_of(plane, list(space.names), list(space.units), ascending=False)
    names = AXES[: plane.rank][::-1]
    shape = tuple(len(axes[name]) for name in names)
    side = tuple(tile_side(points) for points in shape)
    bounds = [space.to_values(bound).tolist() for bound in (space.lower, space.upper)]
    group.attrs.update({**_about(identity, {**with_package(provenance), BOUNDS: bounds}), **COORDINATES})
    unit = str(provenance.get("loss_unit", ""))
    create_array(group, "loss", shape, side, names, "float64", long_name="loss", **({"units": unit} if unit else {}))
    if grad:
        said = "gradient of the loss by each parameter, in the loss's unit per the parameter's"
        deep = (*shape, space.dim), (*side, space.dim), (*names, "dim")
        create_array(group, "grad", *deep, "float64", long_name=said)
    create_array(group, "status", shape, side, names, "int8", long_name="how the evaluation ended", **flags(Status))
    tiles = tuple(math.ceil(points / one) for points, one in zip(shape, side, strict=True))
    lay_out_sums(group, tiles, (1,) * len(tiles), names)
    for number, name in enumerate(AXES[: plane.rank]):
        _keep(group, name, axes[name], (name,), _axis(plane, number))
    _keep(group, "dim", axes["dim"], ("dim",), {"long_name": "parameter"})
    about = {"long_name": "unit of the parameter", "checksum": text_sum(axes["unit"])}  # nothing else says them
    _keep(group, "unit", axes["unit"], ("dim",), about)


def write_finished(path: Path, dataset: xr.Dataset) -> None:
    """Write a slice that is complete to a new folder: ascending, in chunks as analysis wants them."""
    group = zarr.create_group(path, zarr_format=3)
    group.attrs.update({**dataset.attrs, **COORDINATES})
    samples = dataset["loss"].shape
    for name, values in dataset.variables.items():
        dims = tuple(map(str, values.dims))
        if values.dtype.kind in "fi" and dims != (name,):
            chunks = analysis_chunks(samples, *values.shape[len(samples) :])
            array = create_array(
                group, str(name), values.shape, chunks, dims, values.dtype.name, codecs=COMPACT_CODECS, **values.attrs
            )
            array[...] = values.to_numpy()
        else:
            _keep(group, str(name), values.to_numpy(), dims, values.attrs)
    write_sums(group, dataset.drop_vars(INTERPOLATED, errors="ignore"))
    consolidate(path)


def attributes_of(node: zarr.Group | zarr.Array[Any]) -> dict[str, Any]:
    """Return the attributes of a group or an array, without the hints that xarray removes as it reads."""
    return {str(name): value for name, value in node.attrs.items() if name not in COORDINATES}


def parameters_of(dataset: xr.Dataset) -> list[tuple[str, str]]:
    """Return the name and the unit of every parameter of a slice."""
    names, units = (map(str, dataset[name].to_numpy()) for name in ("dim", "unit"))
    return list(zip(names, units, strict=True))


def _axis(plane: Plane, number: int) -> dict[str, str]:
    about = {"label": plane.labels[number], "long_name": plane.names[number]}
    about |= {"scale": LOG10} if plane.scales[number] == LOG10 else {}
    return about | ({"units": plane.units[number]} if plane.units[number] else {})


def _keep(
    group: zarr.Group, name: str, values: NDArray[Any], dims: tuple[str, ...], attributes: Mapping[str, Any]
) -> None:
    """Write a small array whole."""
    number = values.dtype.kind in "fi"
    kind, codecs = (values.dtype.name, COMPACT_CODECS) if number else ("string", CODECS)
    array = create_array(group, name, values.shape, values.shape, dims, kind, codecs=codecs, **attributes)
    array[...] = values if number else values.astype(object)


def _about(identity: Mapping[str, Any], provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a slice: what it is, in words, and its identity and provenance as JSON."""
    over = " and ".join(label.partition(" [")[0] for label in identity["plane"]["labels"])
    made = " ".join(str(provenance[name]) for name in ("created", "command") if provenance.get(name))
    return {
        "gradscape_slice": FORMAT,
        "Conventions": CF,
        "title": f"{identity.get('objective', 'loss')} over {over}",
        "source": f"{PACKAGE} {provenance[VERSIONS][PACKAGE]}",
        **({"history": made} if made else {}),
        "identity": json.dumps(identity),
        "provenance": json.dumps(provenance),
    }
