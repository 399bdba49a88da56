"""Name a point of an environment's parameter space in a few words."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..landscapes.training import SUFFIXES, read_checkpoint
from .base import Environment

FORMS = (
    "center, random:SEED, example:NAME, best, best:RUN, a file with its parameters (.json, .npy, text), a checkpoint "
    "(.pt, .pth, .npz, .zip), or a row of a table, TABLE.csv:ROW"
)


def point(environment: Environment, text: str) -> Float[Tensor, " dim"]:
    """Return the point for a text: center, random:SEED, example:NAME or a file of the parameters' values.

    Raises ValueError where there is no such example or file, or the file does not contain the scene's parameters.
    """
    kind, _, value = text.partition(":")
    if text == "center":
        return environment.space.center
    if kind == "random" and value.isdecimal():
        return environment.space.uniform(1, seed=int(value))[0]
    if kind == "example":
        return environment.example(value)
    path = Path(text)
    if not path.is_file():
        raise ValueError(f"{environment.name} takes as its point {FORMS}; got {text!r}, which is none of these")
    if path.suffix.lower() in SUFFIXES:
        return read_checkpoint(path, environment.space, environment.name)
    return _read(environment, path)


def _read(environment: Environment, path: Path) -> Float[Tensor, " dim"]:
    try:
        if path.suffix == ".json":
            values = np.asarray(json.loads(path.read_text()), dtype=float)
        else:
            values = np.loadtxt(path, delimiter="," if "," in path.read_text() else None, ndmin=1)
        flat = torch.from_numpy(np.asarray(values, dtype=np.float64).ravel())
    except (ValueError, TypeError, OSError, EOFError) as error:
        raise ValueError(f"{path} is not a list of numbers: {' '.join(str(error).split())}") from None
    if len(flat) != environment.space.dim or not bool(flat.isfinite().all()):
        raise ValueError(
            f"{environment.name} takes {environment.space.dim} finite parameters; {path} has {len(flat)} numbers"
        )
    return environment.space.from_values(flat)
