"""In which order particles lie: by cell, so that neighbours in memory are neighbours on the grid.

A scatter can then add up the particles of one cell before it adds them to the grid, and a gather finds what it reads in
the cache. Particles stay with their body, so that each body remains one piece of every array.
"""

from functools import cache, partial
from itertools import chain
from types import SimpleNamespace
from typing import Any, no_type_check

import numpy as np
import torch
import warp as wp

from .. import cpp
from ..launches import Launches
from ..runtime import Ints, fill_struct, load, precision, to_torch
from .model import Model, place_grid
from .stencil import lattice, layout, particles


@cache
@no_type_check
def order_struct(name: str) -> Any:
    """Return the struct of what `Order` holds."""
    Reals = precision(name).rows[0]

    @partial(wp.struct, module=f"gradscape.order.{name}")
    class Rows:
        """The fields of Order, [environment, particle]."""

        place: Ints
        name: Ints
        mass: Reals
        volume: Reals

    return Rows


@cache
@no_type_check
def sorting_kernels(name: str, key: Any) -> SimpleNamespace:
    """Return the kernels `label`, with keys of a type, `take, give`, and `take_state, give_state` by a state's type."""
    types, lies = precision(name), layout(name)
    real, mat33, Vectors = types.real, types.mat33, types.rows[1]
    Lattice, Particles, Rows = lattice(name), particles(name), order_struct(name)
    module = cpp.module(f"gradscape.order.{name}.{key.__name__}")
    read_matrix, write_matrix = lies.read_matrix, lies.write_matrix

    @wp.kernel(module=module, enable_backward=False)
    def label(
        grid: Lattice,
        bodies: int,
        body: wp.array[wp.int32],
        x: Vectors,
        keys: wp.array[key],
        places: wp.array[wp.int32],
    ):
        """Give each particle a key by environment, body and cell."""
        e, p = wp.tid()
        s = (x[e, p] - grid.origin) * grid.inv_dx
        i = wp.clamp(int(s[0] - real(0.5)), 0, grid.nx - 1)
        j = wp.clamp(int(s[1] - real(0.5)), 0, grid.ny - 1)
        k = wp.clamp(int(s[2] - real(0.5)), 0, grid.nz - 1)
        group = key(e * bodies + body[p])
        at = e * x.shape[1] + p
        keys[at] = group * key(grid.nx * grid.ny * grid.nz) + key((i * grid.ny + j) * grid.nz + k)
        places[at] = p

    @wp.kernel(module=module, enable_backward=False)
    def take(places: wp.array[wp.int32], before: Rows, old: Particles, order: Rows, after: Particles):
        e, p = wp.tid()
        q = places[e * old.x.shape[1] + p]
        order.place[e, p] = q
        order.name[e, p] = before.name[e, q]
        order.mass[e, p] = before.mass[e, q]
        order.volume[e, p] = before.volume[e, q]
        after.x[e, p] = old.x[e, q]
        after.v[e, p] = old.v[e, q]
        write_matrix(after.C, e, p, read_matrix(old.C, e, q))

    @wp.kernel(module=module, enable_backward=False)
    def give(place: Ints, after: Particles, old: Particles):
        e, p = wp.tid()
        q = place[e, p]
        old.x[e, q] = after.x[e, p]
        old.v[e, q] = after.v[e, p]
        write_matrix(old.C, e, q, read_matrix(after.C, e, p))

    states = {
        real: _state_kernels(real, cpp.module(f"{module}.number"), lies.read_number, lies.write_number),
        mat33: _state_kernels(mat33, cpp.module(f"{module}.matrix"), read_matrix, write_matrix),
    }
    return SimpleNamespace(label=label, take=take, give=give, states=states)


@no_type_check
def _state_kernels(kind: Any, module: str, read: Any, write: Any) -> tuple[Any, Any]:
    @wp.kernel(module=module, enable_backward=False)
    def take_state(first: int, place: Ints, before: wp.array2d[kind], after: wp.array2d[kind]):
        e, p = wp.tid()
        write(after, e, p, read(before, e, place[e, first + p] - first))

    @wp.kernel(module=module, enable_backward=False)
    def give_state(first: int, place: Ints, after: wp.array2d[kind], before: wp.array2d[kind]):
        e, p = wp.tid()
        write(before, e, place[e, first + p] - first, read(after, e, p))

    return take_state, give_state


class Order:
    """The order of one control step, at first the model's: arrays [environment, particle].

    `place` says where each particle was in the control step before, `name` which of the model's it is; `mass` [kg] and
    `volume` [m^3] lie in this order.
    """

    def __init__(self, model: Model, capacity: int, device: str) -> None:
        def rows(values: np.ndarray, dtype: Any) -> wp.array:
            return wp.array(np.tile(values, (capacity, 1)), dtype=dtype, device=device)

        real, numbers = precision(model.precision).real, np.arange(model.particles, dtype=np.int32)
        self.place, self.name = rows(numbers, wp.int32), rows(numbers, wp.int32)
        self.mass, self.volume = rows(model.mass, real), rows(model.volume, real)
        self.struct = fill_struct(order_struct(model.precision), vars(self))

    def to_model(self, x: torch.Tensor) -> torch.Tensor:
        """Return what lies in this order, shape (batch, particle, *), in the model's."""
        return torch.empty_like(x).scatter_(1, self._names(x), x)

    def from_model(self, x: torch.Tensor) -> torch.Tensor:
        """Return what lies in the model's order, shape (batch, particle, *), in this one."""
        return x.gather(1, self._names(x))

    def _names(self, x: torch.Tensor) -> torch.Tensor:
        name = to_torch(self.name)[: len(x)].long()
        return name.view(*name.shape, *[1] * (x.ndim - 2)).expand_as(x)


class Sorter:
    """Sort the particles of up to `capacity` environments between control steps, and bring adjoints back."""

    def __init__(self, model: Model, capacity: int, device: str, launches: Launches) -> None:
        self.model, self.launches, self.lattice = model, launches, place_grid(model)
        sizes = [len(body.x) for body in model.bodies]
        self.body: wp.array = wp.array(np.repeat(np.arange(len(sizes), dtype=np.int32), sizes), device=device)
        room = 2 * capacity * model.particles
        self.bits = int(capacity * len(sizes) * model.cells).bit_length()
        key = wp.int32 if self.bits < 32 else wp.int64
        self.keys, self.places = (wp.zeros(room, dtype=kind, device=device) for kind in (key, wp.int32))
        self.kernels = sorting_kernels(model.precision, key)
        states = (self.kernels.states[group.material.state(model.precision)] for group in model.groups)
        load([self.kernels.label, *chain.from_iterable(states)], device)
        self.first = np.cumsum([0, *(len(group.x) for group in model.groups)])[:-1].tolist()

    def sort(self, old: Any, new: Any, before: Order, order: Order, batch: int) -> None:
        """Launch what fills `order` and the frame `new` from the frame `old`, which lies in the order `before`."""
        launch, count = self.launches.launch, self.model.particles
        inputs = [self.lattice, len(self.model.bodies), self.body, old.x, self.keys, self.places]
        launch(self.kernels.label, (batch, count), inputs)
        # What is stored must not hold this: a cycle would keep a GPU's memory until it is collected.
        self.launches.call(partial(wp.utils.radix_sort_pairs, self.keys, self.places, batch * count, 0, self.bits))
        inputs = [self.places, before.struct, old.particles, order.struct, new.particles]
        launch(self.kernels.take, (batch, count), inputs)
        for first, source, S in zip(self.first, old.S, new.S, strict=True):
            launch(self.kernels.states[S.dtype][0], (batch, S.shape[1]), [first, order.place, source, S])

    def unsort(self, new: Any, old: Any, order: Order, batch: int) -> None:
        """Launch what fills the frame `old`, in the order of the step before, from the frame `new`, in `order`."""
        inputs = [order.place, new.particles, old.particles]
        self.launches.launch(self.kernels.give, (batch, self.model.particles), inputs)
        for first, S, target in zip(self.first, new.S, old.S, strict=True):
            self.launches.launch(self.kernels.states[S.dtype][1], (batch, S.shape[1]), [first, order.place, S, target])
