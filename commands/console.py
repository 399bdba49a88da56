"""What verbs that have no file of their own yet share: a slice to fill on the way, a fidelity to choose."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .terminal import Console

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..envs.base import Environment, Fidelity
    from ..landscapes.plane import Plane


def fill(
    console: Console,
    env: Environment,
    plane: Plane,
    *,
    out: Path | None = None,
    root: Path = Path("out"),
    boxed: bool = False,
    grad: bool = True,
    force: bool = False,
    prints: Sequence[float] = (),
    executor: Executor | None = None,
) -> tuple[Path, dict[str, Any]]:
    """Sample a slice into `out`, by default a folder named after it under `root`."""
    from ..api.progress import Bars
    from ..jobs.slice import SliceJob

    command = shlex.join(["landscape", *sys.argv[1:]])
    how: dict[str, Any] = {"grad": grad, "force": force, "executor": executor, "prints": prints, "boxed": boxed}
    job = SliceJob.of(env, plane, command=command, out=out, root=root, **how)
    summary = job.run(Bars(console))
    console.print(summary.outcome() + f"\n{job.folder}: {', '.join(summary.files)}", markup=False)
    return job.folder, asdict(summary)


def chosen_fidelity(
    console: Console, name: str, tolerance: str | None, *, fidelity: str | None, **how: Any
) -> str | Fidelity | None:
    """Return the fidelity that was named, or the one that a tolerance chooses."""
    from ..api.progress import Bars
    from ..jobs.scene import SceneSpec

    return SceneSpec(name, fidelity, tolerance, **how).resolve(Bars(console)).fidelity
