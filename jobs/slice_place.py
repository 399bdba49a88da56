"""Where a slice belongs that is given no folder, and the plane of one that was begun there."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..landscapes.identity import with_stride
from ..landscapes.objective import Objective
from ..landscapes.plain import plain_name
from ..landscapes.plane import Plane
from ..landscapes.sampling.refine import Refinement
from ..landscapes.storage.paths import is_slice
from ..landscapes.storage.store import SliceStore
from .folder import ROOT, SLICE, folder_named

STORE = SLICE.store
MOST = 40  # letters of a folder's name that say along what a slice was cut


def default_folder(
    identity: dict[str, Any],
    resolution: tuple[int, ...],
    plane: Plane | None,
    grad: bool,
    root: Path,
    refinement: Refinement | None,
) -> Path:
    """Return a folder of its own for every different slice, the same for the same one.

    That of a cut along directions, which may differ by rounding, does not depend on the `plane`.
    """
    where: Any = resolution
    if "cut" in identity or plane is None:
        axes = [plain_name(identity["cut"]["along"])[:MOST]]
    else:
        aligned = all(len(row.nonzero()) == 1 for row in plane.basis)
        axes = [str(int(row.nonzero()[0])) for row in plane.basis] if aligned else ["plane"]
        where = plane.record()
    points = "x".join(map(str, resolution))
    fidelity = [identity["fidelity"]] if "fidelity" in identity else []
    parts = [identity["objective"], *axes, *fidelity, points]
    refined = [asdict(refinement)] if refinement else []
    return folder_named([*parts, *["refined" for _ in refined]], [identity, where, grad, *refined], root)


def kept_plane(
    objective: Objective,
    cut: Mapping[str, Any],
    resolution: tuple[int, ...],
    *,
    out: Path | None = None,
    root: Path = ROOT,
    gradients: int = 1,
    refinement: Refinement | None = None,
) -> Plane | None:
    """Return the plane of a slice that was begun with the same cut along directions, None where there is none.

    It goes on along these: others may come out a little different each time, on a GPU, and some take many episodes.
    """
    identity = with_stride(identity_of(objective), gradients) | {"boxed": True, "cut": dict(cut)}
    path = (out or default_folder(identity, resolution, None, gradients > 0, root, refinement)) / STORE
    if not is_slice(path):
        return None
    kept = SliceStore.open(path).identity
    same = all(kept.get(name) == json.loads(json.dumps(value)) for name, value in identity.items())
    found = Plane.from_record(kept["plane"])
    return found if same and found.resolution == resolution else None


def identity_of(objective: Objective) -> dict[str, Any]:
    """Return what decides an objective's numbers, as far as it says: an environment all, any other its name."""
    return objective.identity()
