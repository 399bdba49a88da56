"""The identity of a slice or a run: all settings that decide its numbers; stores never mix different ones."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from .. import __version__
from .plain import plain_json

if TYPE_CHECKING:
    import xarray as xr

    from .plane import Plane
    from .space import ParameterSpace

EVERY = "gradients_every"  # of a slice's identity; not there where its gradients are at every sample
ERROR = "error"  # the attribute of a slice or a run with what the first point that raised said
UNNAMED = "default"  # the fidelity of a simulator that names none
BOUNDS = "bounds"  # of the parameters, lower and upper, by their own values: of a slice's provenance
SCALES = "scales"  # of the parameters in an identity; not there where all are linear
POLICY = "policy"  # in the identity of an environment over the weights of a policy: mlp:32x32
REMEDY = "remedy"  # in the identity of an environment with remedies, as the command line spells them; and with it
EPISODES_PER_POINT = "episodes_per_point"  # how many episodes a point takes: elsewhere one
CUT, BOXED = "cut", "boxed"  # in a slice's identity: how it was cut along directions, and whether inside the box only
FILTERS, TRAINED = "filters", "training"  # kinds of directions of weights, whose bounds are no more than a guess
ABSENT = "none"  # instead of a setting's value
LISTED_SETTINGS = 6  # settings that differ, in the refusal of a store
MODEL_VERSION: Final = "model_version"  # in an identity; and so is
METHOD_VERSION: Final = "method_version"
REPLACED = {"code": MODEL_VERSION, "method_code": METHOD_VERSION}  # digests of source text, in identities of before
VERSIONS, PACKAGE = "versions", "gradscape"  # in a provenance; the package's own was in the identity once


class StoreError(ValueError):
    """A path does not contain the requested store."""


class StoreExistsError(StoreError):
    """A store is not made because its path is taken."""


class StoreMismatchError(StoreError):
    """A store has other settings."""


class DamagedError(StoreError):
    """The content of a file differs from what was written."""

    @classmethod
    def of(cls, path: Path, why: str, todo: str) -> DamagedError:
        """Return the error for a file, with the reason and the advice."""
        return cls(f"{path} is damaged ({why}); {todo}")


def full_identity(identity: Mapping[str, Any], plane: Plane, space: ParameterSpace, *, grad: bool) -> dict[str, Any]:
    """Add the settings of the slice itself to a caller's settings, as plain JSON.

    Raises ValueError where the settings contain a name of the slice's own, or are not plain JSON.
    """
    own = {"plane": plane.record(), **record_parameters(space), "gradients": grad}
    if clash := own.keys() & identity.keys():
        raise ValueError(f"a slice's identity takes {', '.join(sorted(clash))} from the slice; leave them out")
    return plain_json({**identity, **own}, "a slice's identity")


def record_parameters(space: ParameterSpace) -> dict[str, Any]:
    """Return the part of an identity on parameters: their names, and their scales unless all are linear."""
    return {"parameters": list(space.names), **({} if space.is_linear else {SCALES: list(space.scales)})}


def stored_scales(dataset: xr.Dataset) -> tuple[str, ...]:
    """Return the scales of the parameters of a slice or a run, linear by default."""
    from .space import LINEAR

    about = stored_identity(dataset) if "identity" in dataset.attrs else {}
    return tuple(about.get(SCALES, [LINEAR] * dataset.sizes["dim"]))


def current_identity(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored identity in its present form.

    Results from before model versions have the package's version and digests of source text instead. They count as
    version 1. By measurement, every one of them in the gallery with today's losses is version 1.
    """
    new = {name: 1 for old, name in REPLACED.items() if old in stored}
    return {**new, **{name: value for name, value in stored.items() if name not in (*REPLACED, PACKAGE)}}


def current_provenance(stored: Mapping[str, Any], identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored provenance with the package's version, which the identity stored with it contained before."""
    return with_package(stored, str(identity[PACKAGE])) if PACKAGE in identity else dict(stored)


def with_package(provenance: Mapping[str, Any], version: str = __version__) -> dict[str, Any]:
    """Return a provenance whose versions begin with the package's."""
    return {**provenance, VERSIONS: {PACKAGE: version, **provenance.get(VERSIONS, {})}}


def with_stride(identity: Mapping[str, Any], gradients: int) -> dict[str, Any]:
    """Add the stride of gradients to a slice's settings, where that is not one.

    Whether it has gradients at all is recorded in its store.
    """
    return {**identity, EVERY: gradients} if gradients > 1 else dict(identity)


def gradient_stride(identity: Mapping[str, Any]) -> int:
    """Return the stride of the gradients along each axis of a slice with this identity: 1 is every sample."""
    return int(identity.get(EVERY, 1))


def stored_identity(dataset: xr.Dataset) -> dict[str, Any]:
    """Return the settings that decide the numbers of a slice or a run: objective, options, fidelity, device and so on.

    Raises ValueError where the dataset is neither.
    """
    return current_identity(_decode(dataset, "identity"))


def stored_provenance(dataset: xr.Dataset) -> dict[str, Any]:
    """Return how a slice or a run was made: command, date, versions, the loss's unit.

    Raises ValueError where the dataset is neither.
    """
    return current_provenance(_decode(dataset, "provenance"), _decode(dataset, "identity"))


def record_cut(cut: Mapping[str, Any] | None, *, boxed: bool = False) -> dict[str, Any]:
    """Return the part of an identity on the directions of a slice, from `along`.

    It is boxed then (inside the bounds only), except for directions of weights.
    """
    if cut is None:
        return {BOXED: True} if boxed else {}
    boxed = boxed or str(cut["along"]).partition(":")[0] not in (FILTERS, TRAINED)
    return {**({BOXED: True} if boxed else {}), CUT: dict(cut)}


def simulator_parts(identity: Mapping[str, Any]) -> list[str]:
    """Return the simulator's name, its fidelity, unless a function has no named one, and its remedies."""
    said = {key: str(identity[key]) for key in ("objective", "fidelity", REMEDY) if identity.get(key)}
    return [text for key, text in said.items() if (key, text) != ("fidelity", UNNAMED)]


def stored_space(dataset: xr.Dataset) -> ParameterSpace | None:
    """Return the parameters of a slice with their bounds; None where an earlier version did not store them."""
    from .space import ParameterSpace

    bounds = stored_provenance(dataset).get(BOUNDS)
    if bounds is None:
        return None
    names, units = (list(map(str, dataset[name].to_numpy())) for name in ("dim", "unit"))
    lower, upper = bounds
    return ParameterSpace(names, lower, upper, units, stored_scales(dataset))


def errors_of(dataset: xr.Dataset) -> str:
    """Return the number of points of a slice or a run that raised, and the first message; empty where none did."""
    from .objective import Status, describe_errors

    return describe_errors(int((dataset["status"] == Status.ERROR).sum()), str(dataset.attrs.get(ERROR, "")))


def plane_of(dataset: xr.Dataset) -> Plane:
    """Return the plane of a slice; raises ValueError where the dataset is no slice."""
    from .plane import Plane

    return Plane.from_record(stored_identity(dataset)["plane"])


def digest_of(dataset: xr.Dataset) -> str:
    """Return a digest of a slice for its measurements: of its identity and its losses."""
    identity = json.dumps(json.loads(dataset.attrs["identity"]), sort_keys=True).encode()  # as it is stored
    return hashlib.sha256(identity + dataset["loss"].to_numpy().tobytes()).hexdigest()[:12]


def _decode(dataset: xr.Dataset, name: str) -> dict[str, Any]:
    try:
        found = json.loads(dataset.attrs[name])
    except (KeyError, TypeError, ValueError):
        found = None
    if not isinstance(found, dict):
        raise ValueError(
            f"this dataset is no slice or run of gradscape: its attribute {name} is missing or not a JSON object"
        )
    return found


def check_identity(
    path: Path | None, *, wanted: Mapping[str, Any], found: Mapping[str, Any], what: str = "slice"
) -> None:
    """Raise `StoreMismatchError`, naming each setting that differs, unless the two are equal."""
    wanted, found = current_identity(wanted), current_identity(found)
    if wanted == found:
        return
    differ = differing_settings(wanted, found)
    if differ.keys() == {MODEL_VERSION} and MODEL_VERSION in wanted and MODEL_VERSION in found:
        name, theirs, ours = wanted.get("objective", "its"), found[MODEL_VERSION], wanted[MODEL_VERSION]
        made = f"the {what} in {path or 'memory'} was made by {name} model {theirs}; this is model {ours}."
        raise StoreMismatchError(f"{made} Use --out, or --force to replace it.")
    said = [f"{name}: wanted {ours}, found {theirs}" for name, (ours, theirs) in differ.items()][:LISTED_SETTINGS]
    if len(differ) > LISTED_SETTINGS:
        said.append(f"and {len(differ) - LISTED_SETTINGS} more")
    raise StoreMismatchError(
        f"{path or 'the store'} contains a {what} made by other settings ({'; '.join(said)}); write elsewhere with "
        "--out, or replace it with --force"
    )


def differing_settings(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return both values, as Python writes them, of each differing setting, by its name ("options.drag")."""
    one, other = dict(_leaves(ours)), dict(_leaves(theirs))
    return {name: (_show(one, name), _show(other, name)) for name in one | other if one.get(name) != other.get(name)}


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from _leaves(inner, f"{name}[{number}]")
    else:
        yield name, value


def _show(settings: Mapping[str, Any], name: str) -> str:
    return repr(settings[name]) if name in settings else ABSENT
