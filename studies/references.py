"""The reference of a scene at the points of a study: evaluated once, and stored for every study of the same points.

The file name contains everything that decides it: the environment's identity, the points, and the machine, because
seconds are stored, too. A few of its points are evaluated again before it is used; if they differ, so are the others.
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
    """Return a reference's results at points with the cost of an episode, stored or new.

    Nothing is stored for a function, because its changes cannot be detected. Raises UnwritableError where nothing can
    be stored.
    """
    if not objective.identity().get(MODEL_VERSION):
        return by(objective, x, follow)
    store, name = _place(objective, x)
    if (kept := store.load(name)) is not None and (found := _verified(objective, x, kept, store.folder / name)):
        follow(len(x))
        return found, float(kept["seconds"])
    found, seconds = by(objective, x, follow)
    arrays = {part: getattr(found, part).numpy() for part in ("loss", "grad", "status")}
    with moved_by("XDG_DATA_HOME", "the measurements"):
        store.save(name, **arrays, error=np.array(found.error), seconds=np.array(seconds))
    return found, seconds


def is_kept(objective: Objective, x: Float[Tensor, "point dim"]) -> bool:
    """Return whether a reference's results at points are stored."""
    store, name = _place(objective, x)
    return name in store.names()


def _place(objective: Objective, x: Tensor) -> tuple[Checkpoint, str]:
    """Return the folder of all references, and the name of one there."""
    of = digest([objective.identity(), x.tolist(), _machine(objective)])
    return Checkpoint(own_folder() / FOLDER), f"{objective.name}-{objective.device}-{of}"


def _machine(objective: Objective) -> list[object]:
    """Return further settings that decide the time of an episode."""
    if objective.device == "cpu":
        return [platform.node(), objective.threads]
    from ..envs.engines.runtime import device_names

    return list(device_names())


def _verified(objective: Objective, x: Tensor, kept: Mapping[str, Any], path: Path) -> Evaluation | None:
    """Return the stored results of a reference, None with a warning where its numbers differ now."""
    loss, grad, status = (torch.from_numpy(kept[part]) for part in ("loss", "grad", "status"))
    found = Evaluation(loss, grad, status, str(kept["error"]))
    try:
        verify(objective, [StoredPoints(path, "reference", x, found, True)], todo="it is evaluated again")
    except StoreMismatchError as error:
        warnings.warn(str(error), RuntimeWarning, stacklevel=2)
        return None
    return found
