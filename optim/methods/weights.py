"""The weights of a Stable-Baselines3 model, and what its optimisers have gathered about them, as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor


def read_weights(model: Any) -> dict[str, Any]:
    """Return the weights of a model's networks and what its optimisers have gathered about them, as arrays."""
    return {name: _arrays(_inner(part)) for name, part in _parts(model).items()}


def put_weights(model: Any, weights: Mapping[str, Any]) -> None:
    """Put what `read_weights` returned into a model that was made by the same options."""
    for name, part in _parts(model).items():
        if isinstance(part, Tensor):
            part.data.copy_(torch.from_numpy(weights[name]))
        elif isinstance(part, torch.optim.Optimizer):
            gathered = {int(number): _tensors(of) for number, of in weights[name].items()}
            part.load_state_dict({**part.state_dict(), "state": gathered})
        else:
            part.load_state_dict(_tensors(weights[name]))


def _parts(model: Any) -> dict[str, Any]:
    """Return the networks, optimisers and single tensors of a model by SB3's names of them."""
    names, tensors = model._get_torch_save_params()
    return {name: attrgetter(name)(model) for name in (*names, *tensors)}


def _inner(part: Any) -> Any:
    if isinstance(part, Tensor):
        return part
    return part.state_dict()["state"] if isinstance(part, torch.optim.Optimizer) else part.state_dict()


def _arrays(value: Any) -> Any:
    """Return tensors, and mappings of them, as arrays under names."""
    if isinstance(value, Mapping):
        return {str(name): _arrays(inner) for name, inner in value.items()}
    return value.detach().numpy()


def _tensors(arrays: Mapping[str, Any]) -> dict[str, Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}
