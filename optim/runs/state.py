"""What an optimiser goes on from, as data: numbers, strings, arrays, lists and mappings of them; nothing that runs."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

ARRAY = "__array__"  # stands in the outline for the number of an array


def encode(state: Any) -> bytes:
    """Return a state as the bytes of an `.npz` file: its arrays by number, and as `outline` the rest, which is JSON.

    Raises TypeError where something in it is no number, string, array, list or mapping.
    """
    arrays: list[NDArray[Any]] = []

    def stand_in(value: object) -> Any:
        if isinstance(value, np.ndarray) and value.dtype != object:
            arrays.append(value)
            return {ARRAY: len(arrays) - 1}
        if isinstance(value, np.generic):
            return value.item()
        raise TypeError(f"a state holds numbers, strings and arrays; got a {type(value).__name__}")

    outline = json.dumps(state, default=stand_in).encode()
    kept = io.BytesIO()
    numbered = {str(number): array for number, array in enumerate(arrays)}
    np.savez(kept, outline=np.frombuffer(outline, np.uint8), **numbered)  # type: ignore[arg-type]
    return kept.getvalue()


def decode(kept: bytes) -> Any:
    """Return the state that `encode` wrote; tuples come back as lists."""
    with np.load(io.BytesIO(kept), allow_pickle=False) as arrays:

        def put_back(found: dict[str, Any]) -> Any:
            return arrays[str(found[ARRAY])] if ARRAY in found else found

        return json.loads(arrays["outline"].tobytes(), object_hook=put_back)
