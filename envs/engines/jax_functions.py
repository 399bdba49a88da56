"""Functions of JAX, differentiated in reverse or forward and compiled once for each size of batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.objective import SimulatorError
from ..user_functions import Compute, Function
from .jax_origins import jax_origin
from .jax_programs import compile_lowered, keep_compiled, traced

keep_compiled()

GROWTH = 4
_TRACED: dict[str, str] = {}  # the precision that JAX has last traced a function in


def has_cuda() -> bool:
    """Return whether JAX computes on a CUDA device by default."""
    return bool(jax.default_backend() != "cpu")


class JaxCompute(Compute):
    """Call functions of JAX, in its default device unless another one is named; keyword arguments are static."""

    def __init__(
        self, mode: str, batch: str, call: Function, settings: Mapping[str, Any], precision: str, device: str
    ) -> None:
        fn = _with_settings(call.fn, settings)
        self.function = JaxFunction(fn, call.space.dim, call.name, precision, call.rows, mode, batch)
        self.device = jax.devices("cpu" if device == "cpu" else None)[0]

    def __call__(self, x: Float[Tensor, "batch dim"], grad: bool) -> tuple[Tensor, Tensor | None, str]:
        """Return losses, gradients if asked for, and the type of numbers that losses come in."""
        with jax.default_device(self.device):
            return self.function(x, grad)

    def nan_origin(self, x: Float[Tensor, "one dim"]) -> str:
        """Return which primitive makes the gradient at a point not finite, and where it is called."""
        own = self.function
        with computing_in(own.precision), jax.default_device(self.device):
            return jax_origin(own.fn, jnp.asarray(x[0].numpy(), dtype=own.precision), own.mode)


def _with_settings(fn: Callable[..., Any], settings: Mapping[str, Any]) -> Callable[[Any], Any]:
    """Return a function with keyword arguments, of which a number as `key` becomes a key of JAX."""
    fixed = dict(settings)

    def of_point(x: Any) -> Any:
        if "key" in fixed:
            return fn(x, **{**fixed, "key": jax.random.key(fixed["key"])})
        return fn(x, **fixed)

    return of_point


@dataclass(eq=False)
class JaxFunction:
    """A JAX function of one point, compiled for batches of several sizes, losses alone and with gradients.

    At most `rows` points are in one call, and smaller batches are padded to the next power of four. `mode` is reverse
    or forward differentiation, `batch` is vmap or map. A `key` identifies everything that `fn` depends on. Its trace is
    stored under the key, and other processes do not call `fn`.
    """

    fn: Callable[[Any], Any]
    dim: int
    name: str
    precision: str
    rows: int
    mode: str = "reverse"
    batch: str = "vmap"
    key: str = ""

    def __post_init__(self) -> None:
        self._compiled: dict[tuple[bool, int], Callable[[Any], Any]] = {}
        self._type = ""

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what was compiled: another process compiles it again."""
        return vars(self) | {"_compiled": {}}

    def __call__(self, x: Float[Tensor, "batch dim"], grad: bool) -> tuple[Tensor, Tensor | None, str]:
        """Return losses, gradients if asked for, and the type of numbers that losses come in."""
        parts = [self._part(part, grad) for part in torch.split(x, self.rows)]
        losses, slopes = zip(*parts, strict=True)
        return torch.cat(losses), torch.cat(slopes) if grad else None, self._type

    def _part(self, x: Float[Tensor, "batch dim"], grad: bool) -> tuple[Tensor, Tensor | None]:
        size = next(size for size in _sizes(self.rows) if size >= len(x))
        padded = torch.cat([x, x[-1:].expand(size - len(x), -1)]).numpy()
        with computing_in(self.precision), self._explained():
            found = self._function(grad, size)(jnp.asarray(padded, dtype=self.precision))
        loss, slope = found if grad else (found, None)
        self._type = str(loss.dtype)
        return _tensor(loss)[: len(x)], None if slope is None else _tensor(slope)[: len(x)]

    def engine_call(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Callable[[], object]:
        """Return what calls the compiled function alone, on points that JAX holds already, and waits for it.

        The points are as many as a whole number of its batches.
        """
        with computing_in(self.precision):
            function = self._function(grad, self.rows)
            ready = [jnp.asarray(part.numpy(), dtype=self.precision) for part in torch.split(x, self.rows)]

        def call() -> object:
            with computing_in(self.precision):
                return jax.block_until_ready([function(part) for part in ready])

        return call

    def _function(self, grad: bool, size: int) -> Callable[[Any], Any]:
        """Return the compiled function of so many points: losses, or losses and gradients."""
        if (grad, size) not in self._compiled:
            self._compiled[grad, size] = self._compile(grad, (size, self.dim))
        return self._compiled[grad, size]

    def _compile(self, grad: bool, shape: tuple[int, int]) -> Callable[[Any], Any]:
        both = jax.value_and_grad if self.mode == "reverse" else _value_and_tangents
        at: Callable[[Any], Any] = both(self._one) if grad else self._one
        whole = jax.vmap(at) if self.batch == "vmap" else lambda x: jax.lax.map(at, x)
        key = f"{self.key} {self.mode} {self.batch} {grad}" if self.key else ""
        return compiled(whole, shape, self.precision, key)

    def _one(self, x: Any) -> Any:
        """Return the loss of one point, held against what it must be."""
        loss = self.fn(x)
        if isinstance(loss, tuple):
            raise SimulatorError(
                f"{self.name} must return only its loss, because JAX differentiates it; got {len(loss)} values, so "
                "return the first one"
            )
        if not isinstance(loss, jax.Array):
            raise SimulatorError(f"{self.name} must return a JAX array; got {type(loss).__name__}")
        if loss.shape != ():
            raise SimulatorError(
                f"{self.name} must return one loss for one point, of shape (); got shape {loss.shape}. It takes one "
                "point, of shape (dim,), and not a batch: from_jax vectorizes it"
            )
        if not jnp.issubdtype(loss.dtype, jnp.floating):
            raise SimulatorError(f"{self.name} must return a floating-point loss; got {loss.dtype}")
        return loss

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Say what to do about what JAX cannot do."""
        try:
            yield
        except NotImplementedError as error:
            raise SimulatorError(
                f"{self.name} cannot be vectorized: {_line(error)}; pass batch='map' to from_jax"
            ) from error
        except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
            raise SimulatorError(
                f"{self.name} cannot be traced by JAX: {_line(error)}; compute with jax.numpy and jax.lax, "
                "or pass another function to from_numpy"
            ) from error
        except (IndexError, TypeError, ValueError) as error:  # while it is traced, which does not depend on the point
            if isinstance(error, SimulatorError):
                raise
            if "Reverse-mode differentiation" in str(error):
                raise SimulatorError(
                    f"{self.name} cannot be differentiated in reverse: {_line(error)}; pass mode='forward' to from_jax"
                ) from error
            raise SimulatorError(
                f"{self.name} cannot be traced: {_line(error)}. It has to take one point, of shape ({self.dim},), and "
                "return its loss; from_jax vectorizes it"
            ) from error


def _sizes(rows: int) -> Iterator[int]:
    """Return the sizes of batches that are compiled for: powers of four up to `rows`, which is the last."""
    size = 1
    while size < rows:
        yield size
        size *= GROWTH
    yield rows


def _value_and_tangents(fn: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return the function of a point that gives loss and gradient by forward differentiation."""

    def both(x: Any) -> Any:
        push = jax.vmap(lambda direction: jax.jvp(fn, (x,), (direction,)), out_axes=(None, 0))
        return push(jnp.eye(len(x), dtype=x.dtype))

    return both


@contextmanager
def computing_in(name: str) -> Iterator[None]:
    """Let JAX compute in a precision, whatever it is configured to."""
    with jax.enable_x64(name == "float64"):
        yield


def compiled(fn: Callable[[Any], Any], shape: tuple[int, ...], precision: str, key: str = "") -> Callable[[Any], Any]:
    """Return the compiled function of an array of one shape, in the precision that JAX computes in now.

    A function already traced under a `key`, by this process or another one, is not traced again.
    """
    _forget_other_precision(precision)
    program = traced(fn, shape, precision, key) if key else fn
    return compile_lowered(jax.jit(program).lower(jax.ShapeDtypeStruct(shape, precision)))


def _forget_other_precision(name: str) -> None:
    """Let JAX forget what it has traced, where that was last for another precision; what is compiled stays.

    It finds traces of functions of NumPy arrays again in the other precision, where they do not fit: compiling
    mjx.step by Runge-Kutta steps failed so.
    """
    if _TRACED.get("precision", name) != name:
        jax.clear_caches()
    _TRACED["precision"] = name


def _tensor(values: Any) -> Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float64))


def _line(error: Exception) -> str:
    """Return the first sentence of what JAX says."""
    return str(error).strip().split("\n")[0].rstrip(".")
