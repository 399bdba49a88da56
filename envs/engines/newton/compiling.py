"""Import Newton, and compile of its kernels few more than run.

Warp compiles a module when the first of its kernels is launched: all that are in it with their adjoints, of which a
scene runs one in ten.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import newton
import warp as wp

SOLVERS, ADJACENCY = "newton._src.solvers.", "newton._src.utils.mesh"  # modules of kernels


def split_solvers() -> None:
    """Give each kernel of a solver that is imported a module of its own, with the options of the one it was in."""
    for name in [name for name in sys.modules if name.startswith(SOLVERS)]:
        whole = wp.get_module(name)
        for kernel in [kernel for kernel in whole.kernels.values() if kernel.module is whole]:
            kernel.module = wp.get_module(f"{name}.{kernel.key}")
            kernel.module.options = dict(whole.options)
            kernel.module.register_kernel(kernel)


def finalize(builder: Any) -> Any:
    """Make a model that rays are not to be cast through.

    Trees of boxes, which are for that alone, are left out; of what counts neighbours there are no adjoints to compile.
    """
    builder.validate_inertia_detailed = True  # by NumPy, not by a kernel
    with skipped(newton.Model, "bvh_build_shapes"), skipped(newton.Model, "bvh_build_particles"), forward(ADJACENCY):
        return builder.finalize(device="cpu", requires_grad=True)


@contextmanager
def skipped(owner: type, name: str) -> Iterator[None]:
    """Let a method do nothing in this thread; one such block at a time."""
    here, method = threading.get_ident(), getattr(owner, name)

    def elsewhere(*args: Any, **how: Any) -> Any:
        return None if threading.get_ident() == here else method(*args, **how)

    setattr(owner, name, elsewhere)
    try:
        yield
    finally:
        setattr(owner, name, method)


@contextmanager
def forward(module: str) -> Iterator[None]:
    """Compile a module's kernels without adjoints."""
    wp.set_module_options({"enable_backward": False}, module=module)
    try:
        yield
    finally:
        wp.set_module_options({"enable_backward": True}, module=module)
