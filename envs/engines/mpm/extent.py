"""Between which corners particles are, which decides on which nodes a control step runs."""

from functools import cache, partial
from types import SimpleNamespace
from typing import Any, no_type_check

import numpy as np
import warp as wp

from .. import cpp
from ..launches import Launches
from ..runtime import load, precision
from .checkpoints import Allocator

SHARES, LANES = 2048, 256  # of a GPU
WARP = 32  # threads of a GPU that find out together


@cache
@no_type_check
def extent_kernels(name: str) -> SimpleNamespace:
    """Return the kernels `look`, at particles, and `gather` what was found; of each the first has the corners.

    Of threads that are `together`, a warp of a GPU or one, one writes down what all have found.
    """
    types = precision(name)
    real, vec3, module = types.real, types.vec3, cpp.module(f"gradscape.extent.{name}")

    @cpp.func_native(called="least_of_warp")
    def least(x: vec3) -> vec3: ...

    @cpp.func_native(called="greatest_of_warp")
    def greatest(x: vec3) -> vec3: ...

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def look(
        x: wp.array2d[vec3],
        shares: int,
        together: int,
        low: wp.array[vec3],
        high: wp.array[vec3],
        left: wp.array[wp.int32],
    ):
        e, share = wp.tid()
        lowest, highest = vec3(real(wp.inf)), vec3(real(-wp.inf))
        for p in range(share, x.shape[1], shares):
            here = x[e, p]
            lowest, highest = wp.min(lowest, here), wp.max(highest, here)
            if not wp.isfinite(here):  # a minimum passes over what is not a number
                lowest = vec3(real(-wp.inf))
                left[e] = 1
        lowest, highest = least(lowest), greatest(highest)
        if share % together == 0:
            at = (e * shares + share) / together
            low[at] = lowest
            high[at] = highest

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def gather(
        batch: int,
        shares: int,
        low: wp.array[vec3],
        high: wp.array[vec3],
        left: wp.array[wp.int32],
        needed: wp.array[wp.int32],
        found: wp.array2d[real],
    ):
        _, lane = wp.tid()
        lowest, highest = vec3(real(wp.inf)), vec3(real(-wp.inf))
        gone, most = wp.int32(0), wp.int32(0)
        for i in range(lane, batch * shares, found.shape[0]):
            lowest, highest = wp.min(lowest, low[i]), wp.max(highest, high[i])
        for e in range(lane, batch, found.shape[0]):
            gone = wp.max(gone, left[e])
            most = wp.max(most, needed[e])
        for axis in range(3):
            found[lane, axis] = lowest[axis]
            found[lane, 3 + axis] = highest[axis]
        found[lane, 6] = real(gone)
        found[lane, 7] = real(most)

    return SimpleNamespace(look=look, gather=gather)


class Extent:
    """Find the corners of the particles of a batch, and whether one has left its box of nodes.

    Threads take one of `shares` of an environment's particles each, and one of a GPU's warp writes down what all of it
    have found; then `lanes`, few enough to be read back, take all of that. By default both are one on a CPU.
    """

    def __init__(
        self, allocator: Allocator, launches: Launches, *, shares: int | None = None, lanes: int | None = None
    ) -> None:
        model, types, device = allocator.model, allocator.types, allocator.device
        self.launches, self.device = launches, device
        self.kernels = extent_kernels(model.precision)
        load([self.kernels.look], device)
        self.shares, lanes = shares or (1 if device == "cpu" else SHARES), lanes or (1 if device == "cpu" else LANES)
        self.together = 1 if device == "cpu" else WARP
        size = allocator.capacity * self.shares // self.together
        self.low, self.high = (wp.zeros(size, dtype=types.vec3, device=device) for _ in range(2))
        self.found: wp.array = wp.zeros((lanes, 8), dtype=types.real, device=device)
        self.event: Any = None if device == "cpu" else wp.Event(device)
        self.host: wp.array = wp.zeros((lanes, 8), dtype=types.real, device="cpu", pinned=device != "cpu")

    def find(self, x: wp.array, left: wp.array, needed: wp.array, batch: int, *, small: bool) -> None:
        """Begin to find the corners of `x` [environment, particle], if any row has `left`, the most nodes one `needed`.

        A row has where a particle's coordinates are not finite, too: a loss need not tell, if it looks at others only.
        """
        self.launches.run(("extent", batch), None, lambda: self._launch(x, left, needed, batch), small=small)
        if self.device != "cpu":
            wp.record_event(self.event)

    def read(self) -> tuple[np.ndarray, np.ndarray, bool, int]:
        """Return the lowest and highest coordinates [m], not finite where a particle's are not, if one left, and nodes.

        These are the most that a row needed.
        """
        if self.device != "cpu":
            wp.synchronize_event(self.event)
        found = self.host.numpy().astype(np.float64)
        return found[:, :3].min(axis=0), found[:, 3:6].max(axis=0), bool(found[:, 6].any()), int(found[:, 7].max())

    def _launch(self, x: wp.array, left: wp.array, needed: wp.array, batch: int) -> None:
        inputs = [x, self.shares, self.together, self.low, self.high, left]
        self.launches.launch(self.kernels.look, (batch, self.shares), inputs)
        inputs = [batch, self.shares // self.together, self.low, self.high, left, needed, self.found]
        self.launches.launch(self.kernels.gather, (1, self.found.shape[0]), inputs)
        self.launches.call(partial(wp.copy, self.host, self.found))  # which holds nothing that holds the launches
