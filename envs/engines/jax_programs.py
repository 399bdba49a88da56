"""Programs of JAX that later processes reuse: those compiled by XLA, and for MuJoCo scenes those traced by JAX.

JAX caches compiled programs under the program itself, the device and both versions. To look one up, it first has to
trace the function, which takes seconds for a long simulator. So a traced program is also cached, as StableHLO, under a
key from its caller, which must contain everything that the function depends on.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import os
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from platformdirs import user_cache_path

from ...landscapes.storage.files import replacing
from . import IMPORTED_AT, installed_version

LIMITS = (  # JAX's setting, its default, and ours
    ("jax_compilation_cache_max_size", -1, 1 << 29),  # bytes; JAX deletes what was not used for longest
    ("jax_persistent_cache_min_compile_time_secs", 1.0, 0.1),  # [s]; a function of a user's often takes less than 1 s
)
MAX_TRACED = 256  # files of traced programs, of about 0.2 MB
UNREADABLE = "Error reading persistent compilation cache entry"

Program = Callable[[Any], Any]  # of one array: an array, or a tuple of several


def user_folder() -> Path:
    """Return the default folder of cached programs."""
    return user_cache_path("gradscape") / "jax-programs"


def keep_compiled() -> None:
    """Let JAX cache compiled programs in the user's cache, unless it has another folder.

    JAX respects `JAX_COMPILATION_CACHE_DIR`, and with `JAX_ENABLE_COMPILATION_CACHE=0` it caches nothing.
    """
    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(user_folder()))
        for name, usual, ours in LIMITS:
            if jax.config.values[name] == usual:
                jax.config.update(name, ours)


def compile_lowered(lowered: Any) -> Program:
    """Return a lowered function compiled.

    XLA's newer emitters of code for CPUs take twice as long to compile a simulator's many small operations, which are
    no faster then.
    """
    try:
        return _compile(lowered, {"xla_cpu_use_fusion_emitters": False})
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return _compile(lowered, {})  # another version of XLA


def _compile(lowered: Any, options: dict[str, Any]) -> Program:
    """Compile with options. What was kept and cannot be read is deleted, as JAX would never write it again."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", UNREADABLE)
        with contextlib.suppress(UserWarning):
            return lowered.compile(options)  # type: ignore[no-any-return]
    if (folder := jax.config.values["jax_compilation_cache_dir"]) == str(user_folder()):
        name = lowered.compiler_ir().operation.attributes["sym_name"].value
        for path in Path(folder).glob(f"{glob.escape(name)}-*-cache"):
            path.unlink(missing_ok=True)
    return lowered.compile(options)  # type: ignore[no-any-return]


# ---- Traced programs


def traced(fn: Program, shape: tuple[int, ...], precision: str, key: str) -> Program:
    """Return a function of an array of one shape as a program stored under a key, traced if necessary.

    The key contains everything that `fn` depends on; the precision, JAX's settings and its versions are added. Where
    nothing can be stored, `fn` itself is returned.
    """
    if (folder := _folder()) is None:
        return fn
    path = folder / f"{_digest(key, shape, precision)}.stablehlo"
    argument = jax.ShapeDtypeStruct(shape, precision)
    found = _read(path, argument)
    if found is None:
        try:
            program = replace(export.export(jax.jit(fn))(argument), fun_name="traced")
        except (ValueError, NotImplementedError):
            return fn  # it holds what JAX does not export; tracing says what else may be wrong
        found = program, _name(program)
        if program.module_kept_var_idx == (0,) and not (program.ordered_effects or program.unordered_effects):
            _write(path, *found)
    program, name = found

    def run(x: Any) -> Any:
        return program.call(x)

    run.__name__ = name
    return run


@cache
def source_digest(*folders: Path) -> str | None:
    """Return a digest of the Python files in folders; None where one was changed after this process began."""
    found = hashlib.sha256()
    for path in sorted(path for folder in folders for path in folder.rglob("*.py")):
        said = path.stat()
        if max(said.st_mtime, said.st_ctime) > IMPORTED_AT:
            return None  # what was imported may be what it held before
        found.update(f"{path.name} {said.st_size} ".encode() + path.read_bytes())
    return found.hexdigest()


def _folder() -> Path | None:
    """Return where traced programs are kept, next to those that JAX compiled; None where none are to be."""
    place = jax.config.values["jax_compilation_cache_dir"]
    if not place or "://" in place or not jax.config.values["jax_enable_compilation_cache"]:
        return None
    return Path(place) / "traced"


def _digest(key: str, shape: tuple[int, ...], precision: str) -> str:
    settings = sorted((name, repr(value)) for name, value in jax.config.values.items() if "cache" not in name)
    versions = [installed_version(package) for package in ("jax", "jaxlib")]
    whole = repr((key, shape, precision, jax.default_backend(), versions, settings))
    return hashlib.sha256(whole.encode()).hexdigest()[:32]


def _name(program: export.Exported) -> str:
    """Return what JAX files a program under: a digest of its operations, not of the lines of code that made them.

    The same operations of other code are not compiled again.
    """
    operations = re.sub(r"^#loc.*\n| loc\(.*?\)", "", program.mlir_module(), flags=re.MULTILINE)
    return hashlib.sha256(operations.encode()).hexdigest()[:32]


def _write(path: Path, program: export.Exported, name: str) -> None:
    """Keep a program where that is possible, and delete those that were not used for longest."""
    outputs = [(one.shape, str(one.dtype)) for one in program.out_avals]
    content = json.dumps([name, outputs]).encode() + b"\n" + program.mlir_module_serialized
    with contextlib.suppress(OSError):
        with replacing(path) as partial:
            partial.write_bytes(hashlib.sha256(content).digest() + content)
        for old in sorted(path.parent.glob("*.stablehlo"), key=lambda one: one.stat().st_mtime)[:-MAX_TRACED]:
            old.unlink(missing_ok=True)


def _read(path: Path, argument: jax.ShapeDtypeStruct) -> tuple[export.Exported, str] | None:
    """Return the program of a file, and its name; None where there is none, or where it is damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, content = content[:32], content[32:]
    if hashlib.sha256(content).digest() != digest:
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    said, _, module = content.partition(b"\n")
    name, outputs = json.loads(said)

    def alike(x: Any) -> Any:
        found = tuple(jnp.full(shape, x.sum(), dtype) for shape, dtype in outputs)
        return found if len(found) > 1 else found[0]

    return replace(export.export(jax.jit(alike))(argument), fun_name="traced", mlir_module_serialized=module), name
