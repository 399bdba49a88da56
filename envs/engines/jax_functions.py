"""An objective of a JAX function, differentiated in reverse or forward and compiled once for each size of batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...landscapes.adapters import function_name
from ...landscapes.objective import Evaluation, Objective
from ...landscapes.space import ParameterSpace, as_whole
from .functions import ROWS, FunctionObjective

Mode = Literal["reverse", "forward"]
Batch = Literal["vmap", "map"]
Precision = Literal["float64", "float32"]
GROWTH = 4
_TRACED: dict[str, str] = {}  # the precision that JAX has last traced a function in


def from_jax(
    fn: Callable[[Any], Any],
    space: ParameterSpace,
    *,
    name: str | None = None,
    loss_unit: str = "",
    mode: Mode = "reverse",
    batch: Batch = "vmap",
    precision: Precision = "float64",
    rows: int = ROWS,
) -> Objective:
    """Make an objective of a JAX function from one point, an array of shape (dim,), to its loss, of shape ().

    Gradients come by reverse differentiation, or forward, which loops of unknown length need and few parameters
    favour. `batch` says how many points are computed together: `vmap` vectorizes the function, `map` calls it point
    after point, which functions without a batching rule and large simulations need. At most `rows` points are in one
    call, and smaller batches are padded to the next power of four, since the function is compiled for each size. It
    runs on JAX's default device, in `precision`, whatever JAX is configured to. A loss or gradient that is not finite
    is a failed point.

    Raises ValueError where JAX is not installed, and for other modes, batches and precisions; evaluating raises it
    where the function returns no single number, or JAX cannot trace, differentiate or vectorize it.
    """
    for option, value, known in (("mode", mode, Mode), ("batch", batch, Batch), ("precision", precision, Precision)):
        if value not in get_args(known):
            raise ValueError(f"from_jax takes {option} {' or '.join(get_args(known))}; got {value!r}")
    most = as_whole(rows, "from_jax's rows", least=1)
    return JaxObjective(fn, space, name or function_name(fn), loss_unit, precision, most, mode, batch)


@dataclass(eq=False)
class JaxObjective(FunctionObjective):
    """What `from_jax` makes."""

    mode: Mode
    batch: Batch

    def __post_init__(self) -> None:
        _import_jax()
        self._compiled: dict[tuple[bool, int], Callable[[Any], Any]] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what was compiled: another process compiles it anew."""
        return vars(self) | {"_compiled": {}}

    def _evaluate(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Evaluation:
        import jax.numpy as jnp

        size = next(size for size in _sizes(self.preferred_batch) if size >= len(x))
        padded = torch.cat([x, x[-1:].expand(size - len(x), -1)]).numpy()
        with computing_in(self.precision), self._explained():
            found = self._function(grad, size)(jnp.asarray(padded, dtype=self.precision))
        loss, slope = found if grad else (found, None)
        return Evaluation.from_results(_tensor(loss)[: len(x)], None if slope is None else _tensor(slope)[: len(x)])

    def engine_call(self, x: Float[Tensor, "batch dim"], *, grad: bool) -> Callable[[], object]:
        """Return what calls the compiled function alone, on points that JAX holds already, and waits for it.

        The points are as many as a whole number of its batches.
        """
        import jax
        import jax.numpy as jnp

        with computing_in(self.precision):
            function = self._function(grad, self.preferred_batch)
            ready = [jnp.asarray(part.numpy(), dtype=self.precision) for part in torch.split(x, self.preferred_batch)]

        def call() -> object:
            with computing_in(self.precision):
                return jax.block_until_ready([function(part) for part in ready])

        return call

    def _function(self, grad: bool, size: int) -> Callable[[Any], Any]:
        """Return the compiled function of so many points: losses, or losses and gradients."""
        import jax

        if (grad, size) not in self._compiled:
            both = jax.value_and_grad if self.mode == "reverse" else _value_and_tangents
            at: Callable[[Any], Any] = both(self._one) if grad else self._one
            whole = jax.vmap(at) if self.batch == "vmap" else lambda x: jax.lax.map(at, x)
            self._compiled[grad, size] = compiled(whole, (size, self.space.dim), self.precision)
        return self._compiled[grad, size]

    def _one(self, x: Any) -> Any:
        """Return the loss of one point, held against what it must be."""
        import jax.numpy as jnp

        loss = self.fn(x)
        if not hasattr(loss, "shape") or not hasattr(loss, "dtype"):
            raise ValueError(f"{self.name} must return a JAX array; got {type(loss).__name__}")
        if loss.shape != ():
            raise ValueError(f"{self.name} must return one loss for one point, of shape (); got shape {loss.shape}")
        if not jnp.issubdtype(loss.dtype, jnp.floating):
            raise ValueError(f"{self.name} must return a floating-point loss; got {loss.dtype}")
        return loss

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Say what to do about what JAX cannot do."""
        import jax

        try:
            yield
        except NotImplementedError as error:
            raise ValueError(
                f"{self.name} cannot be vectorized: {_line(error)}; pass batch='map' to from_jax"
            ) from error
        except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
            raise ValueError(
                f"{self.name} cannot be traced by JAX: {_line(error)}; compute with jax.numpy and jax.lax, "
                "or pass another function to from_numpy"
            ) from error
        except ValueError as error:
            if "Reverse-mode differentiation" not in str(error):
                raise
            raise ValueError(
                f"{self.name} cannot be differentiated in reverse: {_line(error)}; pass mode='forward' to from_jax"
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
    import jax
    import jax.numpy as jnp

    def both(x: Any) -> Any:
        push = jax.vmap(lambda direction: jax.jvp(fn, (x,), (direction,)), out_axes=(None, 0))
        return push(jnp.eye(len(x), dtype=x.dtype))

    return both


@contextmanager
def computing_in(name: str) -> Iterator[None]:
    """Let JAX compute in a precision, whatever it is configured to."""
    import jax

    with jax.enable_x64(name == "float64"):
        yield


def compiled(fn: Callable[[Any], Any], shape: tuple[int, ...], precision: str) -> Callable[[Any], Any]:
    """Return the compiled function of an array of one shape, in the precision that JAX computes in now.

    XLA's newer emitters of code for CPUs take twice as long to compile a simulator's many small operations, which are
    no faster then.
    """
    import jax

    _forget_other_precision(precision)
    lowered = jax.jit(fn).lower(jax.ShapeDtypeStruct(shape, precision))
    try:
        return lowered.compile({"xla_cpu_use_fusion_emitters": False})
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return lowered.compile()  # another version of XLA


def _forget_other_precision(name: str) -> None:
    """Let JAX forget what it has traced, where that was last for another precision; what is compiled stays.

    It finds traces of functions of NumPy arrays again in the other precision, where they do not fit: compiling
    mjx.step by Runge-Kutta steps failed so.
    """
    import jax

    if _TRACED.get("precision", name) != name:
        jax.clear_caches()
    _TRACED["precision"] = name


def _tensor(values: Any) -> Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float64))


def _line(error: Exception) -> str:
    """Return the first sentence of what JAX says."""
    return str(error).strip().split("\n")[0].rstrip(".")


def _import_jax() -> None:
    try:
        import jax  # noqa: F401
    except ImportError as error:
        raise ValueError(f"from_jax needs JAX, which is not here ({error}): pip install jax") from error
