"""The best point that is known of a scene from the gallery's league."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from ..landscapes.convert import from_json
from ..landscapes.plain import plain_json
from ..landscapes.storage.records import read_json, reading
from ..optim.league import SceneStandings

if TYPE_CHECKING:
    from torch import Tensor

    from ..envs.base import Environment


def best_of_league(env: Environment) -> tuple[Tensor, float] | None:
    """Return the best point that the gallery's league found in an environment of the same options, and its loss.

    It is None where there is none, or one of another fidelity's number of parameters. Raises DamagedError where the
    file is not what was written.
    """
    path = league_file(env.name)
    if not path.is_file():
        return None
    with reading(path, "delete it, and `landscape gallery compute --part league` makes it anew"):
        found = from_json(SceneStandings, read_json(path))
    if found.best is None or not has_options(found.identity, env) or len(found.best.x) != env.space.dim:
        return None
    return torch.tensor(found.best.x, dtype=torch.float64), found.best.loss


def has_options(identity: Mapping[str, Any], env: Environment) -> bool:
    """Say whether what has this identity was made with the environment's options."""
    return bool(identity.get("options") == plain_json(asdict(env.options), "options"))


def league_file(env: str) -> Path:
    """Return where the gallery keeps the race in an environment."""
    return Path(str(resources.files("gradscape.gallery"))) / "data" / "league" / f"{env}.json"
