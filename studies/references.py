"""The reference of a scene at the points of a study: evaluated once, and kept for every study of the same points.

What is kept is named after all that decides it: what the environment says of itself, the points, and the machine, whose
seconds are kept, too. A few of its points are evaluated again before it is taken; where they differ, so are the others.
"""

from __future__ import annotations

import platform
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.identity import MODEL_VERSION, StoreMismatchError
from ..landscapes.objective import Evaluation, Objective
from ..landscapes.plain import digest
from ..landscapes.storage.checkpoint import Checkpoint
from ..landscapes.storage.files import moved_by
from ..landscapes.verification import StoredPoints, verify
from .own_folder import own_folder
from .samples import Evaluate, Follow, Parts, evaluate_parts

FOLDER = "references"


def evaluate_reference(
    objective: Objective, x: Float[Tensor, "point dim"], follow: Follow, *, by: Evaluate = evaluate_parts
) -> Parts:
    """Return what a reference returns at points with what an episode took: what is kept of it, or what it is now.

    Nothing is kept of a function, of which nothing says when it changes. Raises UnwritableError where nothing can be
    kept.
    """
    if not objective.identity().get(MODEL_VERSION):
        return by(objective, x, follow)
    store, name = _place(objective, x)
    if (kept := store.load(name)) is not None and (found := _verified(objective, x, kept, store.folder / name)):
        follow(len(x))
        return found, float(kept["seconds"])
    found, seconds = by(objective, x, follow)
    arrays = {part: getattr(found, part).numpy() for part in ("loss", "grad", "status")}
    with moved_by("XDG_DATA_HOME", "what was measured"):
        store.save(name, **arrays, error=np.array(found.error), seconds=np.array(seconds))
    return found, seconds


def is_kept(objective: Objective, x: Float[Tensor, "point dim"]) -> bool:
    """Say whether what a reference returns at points is kept."""
    store, name = _place(objective, x)
    return name in store.names()


def _place(objective: Objective, x: Tensor) -> tuple[Checkpoint, str]:
    """Return what holds all references, and the name of one there."""
    of = digest([objective.identity(), x.tolist(), _machine(objective)])
    return Checkpoint(own_folder() / FOLDER), f"{objective.name}-{objective.device}-{of}"


def _machine(objective: Objective) -> list[object]:
    """Return what else decides how long an episode takes."""
    if objective.device == "cpu":
        return [platform.node(), objective.threads]
    from ..envs.engines.runtime import device_names

    return list(device_names())


def _verified(objective: Objective, x: Tensor, kept: Mapping[str, Any], path: Path) -> Evaluation | None:
    """Return what is kept of a reference, None with a warning where it says other numbers now."""
    loss, grad, status = (torch.from_numpy(kept[part]) for part in ("loss", "grad", "status"))
    found = Evaluation(loss, grad, status, str(kept["error"]))
    try:
        verify(objective, [StoredPoints(path, "reference", x, found, True)], todo="it is evaluated again")
    except StoreMismatchError as error:
        warnings.warn(str(error), RuntimeWarning, stacklevel=2)
        return None
    return found
