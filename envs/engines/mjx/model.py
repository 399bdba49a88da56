"""Models of MuJoCo before they are simulated: read, set, and searched for what parameters vary.

All this is MuJoCo's own. MJX, whose import takes seconds, is for `rollout`, which traces an episode.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.typing import NDArray

from ..jax_functions import JaxFunction as JaxFunction
from ..jax_functions import compiled, computing_in
from ..jax_programs import source_digest

AT_FIRST = ("qpos", "qvel")  # fields of the state that parameters set before the first step
CONTROL = "ctrl"
# What the first axis of a field counts, and so whose names its rows go by.
NAMED = {"body": mujoco.mjtObj.mjOBJ_BODY, "geom": mujoco.mjtObj.mjOBJ_GEOM, "jnt": mujoco.mjtObj.mjOBJ_JOINT}
NAMED |= {"actuator": mujoco.mjtObj.mjOBJ_ACTUATOR, "ctrl": mujoco.mjtObj.mjOBJ_ACTUATOR}
JOINTED = {"qpos": "jnt_qposadr", "qvel": "jnt_dofadr", "dof": "jnt_dofadr"}  # rows of these go by the names of joints
SOLVERS = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}
CODE = (Path(__file__).parents[2], Path(mujoco.__file__).parent / "mjx" / "_src")  # what traces of our scenes are of

Place = tuple[str, tuple[int, ...]]  # a field, and which of its numbers
Act = Callable[[Any, Any, Any], Any]  # act(model, state, controls): the state with these controls


@dataclass(frozen=True)
class Course:
    """Say what an episode is made of.

    `places` are what parameters set, those of controls last; controls are given for `segments` and held for `steps`
    each. The episode has `held` segments: beyond those that are given controls are zero.
    """

    places: tuple[Place, ...]
    segments: int
    held: int
    steps: int
    act: Act = field(compare=False, repr=False)


@dataclass(frozen=True)
class Settings:
    """Say how a model is simulated: step [s], and the solver of its constraints with its iterations, 0 for its own."""

    dt: float
    solver: str
    iterations: int
    ls_iterations: int


class Model:
    """Hold a model as MuJoCo has it."""

    def __init__(self, mjcf: str, settings: Settings, precision: str, *, name: str) -> None:
        """Load a model from a file, or from the text of one. Raises ValueError where MuJoCo cannot read it."""
        self.name, self.precision = name, precision
        self.host = load(mjcf, name)
        self.host.opt.timestep = settings.dt
        self.host.opt.solver = SOLVERS[settings.solver]
        self.host.opt.iterations = settings.iterations or self.host.opt.iterations
        self.host.opt.ls_iterations = settings.ls_iterations or self.host.opt.ls_iterations

    def find(self, field: str, index: int | str | Sequence[int | str]) -> Place:
        """Return the place of a parameter, whose index may be a name.

        Raises ValueError where the model has no such field, no such name, or fewer numbers.
        """
        shape = self._shape(field)
        parts = (index,) if isinstance(index, int | str) else tuple(index)
        numbers = tuple(self._number(field, part) if isinstance(part, str) else part for part in parts)
        if len(numbers) != len(shape) or any(not 0 <= n < size for n, size in zip(numbers, shape, strict=True)):
            raise ValueError(f"{self.name} has {field} of shape {shape}; got index {', '.join(map(str, parts))}")
        return field, numbers

    def _shape(self, field: str) -> tuple[int, ...]:
        if field in (*AT_FIRST, CONTROL):
            return ({"qpos": self.host.nq, "qvel": self.host.nv, CONTROL: self.host.nu}[field],)
        value: Any = getattr(self.host, field, None)
        if not hasattr(value, "shape") or not np.issubdtype(value.dtype, np.floating):
            raise no_numbers(self.name, field)
        return tuple(value.shape)

    def _number(self, field: str, name: str) -> int:
        """Return the row of a field that belongs to a named body, geom, joint or actuator."""
        family = field.partition("_")[0]
        kind = mujoco.mjtObj.mjOBJ_JOINT if family in JOINTED else NAMED.get(family)
        found = -1 if kind is None else mujoco.mj_name2id(self.host, kind, name)
        if found < 0:
            what = f"no {kind.name[6:].lower()} {name!r}" if kind else "no names"
            raise ValueError(f"{self.name} has {what} for {field}; give a number, or an existing name")
        return int(getattr(self.host, JOINTED[family])[found]) if family in JOINTED else found

    def identify(self, course: Course, *others: object) -> str:
        """Return a text that says all that an episode of our own code, with these other settings, is made of.

        That is the model as MuJoCo's compiler left it, whatever files it came from, and the code. Empty where the code
        was changed after it was imported.
        """
        code = source_digest(*CODE)
        whole = np.empty(mujoco.mj_sizeModel(self.host), dtype=np.uint8)
        mujoco.mj_saveModel(self.host, None, whole)
        model = hashlib.sha256(whole.tobytes()).hexdigest()
        return "" if code is None else repr((code, mujoco.__version__, model, self.precision, course, *others))

    def frames(
        self, trace: Callable[[Any], Any], x: NDArray[np.float64], key: str
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return what `Rollout.frames` gives at one point, which `trace` calls where its program is not kept yet."""
        with computing_in(self.precision):
            frames = compiled(trace, x.shape, self.precision, key and f"{key} frames")
            at, turn = frames(jnp.asarray(x, dtype=self.precision))
        return np.asarray(at, dtype=np.float64), np.asarray(turn, dtype=np.float64)

    def geoms(self) -> list[Mapping[str, Any]]:
        """Return shape and size [m] of every geom."""
        kinds = [mujoco.mjtGeom(kind).name[7:].lower() for kind in self.host.geom_type]
        return [{"shape": kind, "size": tuple(size)} for kind, size in zip(kinds, self.host.geom_size, strict=True)]


def no_numbers(name: str, field: str) -> ValueError:
    """Return the error of a parameter that names no field of the model, or one that cannot vary."""
    return ValueError(
        f"{name} has no field {field!r} to vary; MuJoCo's fields are qpos, qvel, ctrl, and those of the model, such "
        "as body_mass, geom_friction and dof_damping"
    )


def load(mjcf: str, name: str) -> Any:
    """Return MuJoCo's model of a file, or of the text of one. Raises ValueError where it cannot be read."""
    mujoco.mj_clearCache(mujoco.mj_getCache())  # of meshes, which takes one edited within a second for the same
    try:
        if "<" in mjcf:
            return mujoco.MjModel.from_xml_string(mjcf)
        if not Path(mjcf).is_file():
            raise ValueError(f"there is no file {mjcf}")
        return mujoco.MjModel.from_xml_path(mjcf)
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read the model of {name}: {' '.join(str(error).split())}") from error
