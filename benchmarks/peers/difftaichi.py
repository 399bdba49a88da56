"""DiffTaichi's `diffmpm3d` as released: its file is imported, its globals are set, its functions are called."""

import argparse
import hashlib
import importlib.util
import sys
import tempfile
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np

from .protocol import Simulation, run
from .scenes import CUBE, Array, Cube

COMMIT = "12e9ab43161d1e0d41177d442c4d4c4e987b4bb1"
URL = f"https://raw.githubusercontent.com/taichi-dev/difftaichi/{COMMIT}/examples/diffmpm3d.py"
SHA256 = "d693b89cdaa0252c35fe53aac90fcb3d7e81ada824426af9565e0561444490c1"
DIFFERS = (
    "Walls and floor stick while something runs into them; ours slip.",
    "All nodes of the grid are computed, and all particles of all substeps are kept, forward too.",
    "The gradient is Taichi's automatic one; p2g and the grid are computed again on the way back.",
    "Each substep also computes four sine waves for one actuator that no particle has.",
    "Mass and volume of a particle are 1; only their ratio matters.",
    "The file is older than its Taichi: names that Taichi has dropped since (ext_arr, a(i) for a[i], atomic_add) are "
    "given back by this script, and the file itself is unchanged. Its floor's friction Taichi no longer compiles.",
)


def build(scene: Cube, asked: argparse.Namespace) -> Simulation:
    """Return DiffTaichi's simulation of a scene."""
    import taichi as ti

    module = load(ti, Path(asked.source) if asked.source else fetch(), asked.device)
    set_scene(module, scene)

    first, last, slope = transfers(ti, module, scene)
    places, end = scene.x.astype(np.float32), np.empty((scene.particles, 3), dtype=np.float32)

    def loss(parameters: Array) -> float:
        first(places, scene.velocities(parameters).astype(np.float32))
        module.forward(scene.substeps + 1)
        last(end)
        return -float(end[:, 0].astype(np.float64).mean())

    def gradient(parameters: Array) -> Array:
        loss(parameters)
        ti.ad.clear_all_gradients()
        module.loss.grad[None] = 1
        module.backward()
        adjoint = np.empty_like(end)
        slope(adjoint)
        return scene.pull_back(adjoint.astype(np.float64))

    return Simulation(
        version=f"difftaichi {COMMIT[:8]}, Taichi {'.'.join(map(str, ti.__version__))}",
        material="neo-Hookean",
        grid=f"{scene.nodes}^3",
        loss=loss,
        gradient=gradient,
        differs=DIFFERS,
    )


def fetch() -> Path:
    """Return the file of the pinned commit, from the network."""
    path = Path(tempfile.mkdtemp()) / "diffmpm3d.py"
    with urllib.request.urlopen(URL, timeout=60) as answer:
        path.write_bytes(answer.read())
    return path


def check(path: Path) -> None:
    """Raise ValueError where a file is not the pinned one."""
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != SHA256:
        raise ValueError(f"diffmpm3d.py has the SHA-256 {SHA256} at commit {COMMIT[:8]}; {path} has {found}")


def load(ti: Any, path: Path, device: str) -> Any:
    """Return the module of the file, whose Taichi runs on the device. Raises ValueError for another version of it."""
    check(path)
    restore_names(ti)
    start = ti.init

    def begin(**options: Any) -> None:
        del options["flatten_if"]
        start(**{**options, "arch": ti.cuda if device == "cuda" else ti.cpu, "random_seed": 0})

    ti.init = begin
    sys.modules.setdefault("matplotlib", type(sys)("matplotlib"))  # it draws nothing here
    sys.modules.setdefault("matplotlib.pyplot", type(sys)("matplotlib.pyplot"))
    spec = importlib.util.spec_from_file_location("diffmpm3d", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def restore_names(ti: Any) -> None:
    """Give Taichi back what it has dropped since the file was written."""
    from taichi.lang import impl
    from taichi.lang.expr import Expr
    from taichi.lang.matrix import Matrix

    def entry(value: Any, *place: int) -> Any:
        builder = impl.get_runtime().compiling_callable.ast_builder()
        return impl.subscript(builder, value, *place)

    ti.ext_arr = ti.types.ndarray
    for kind in (Expr, Matrix):
        kind.__call__ = entry
        kind.atomic_add = ti.atomic_add


def set_scene(module: Any, scene: Cube) -> None:
    """Set the file's globals to the scene, and its particles where they begin."""
    module.n_grid, module.dx, module.inv_dx = scene.nodes, scene.dx, scene.nodes
    module.dt, module.gravity, module.bound = scene.dt, scene.gravity, scene.floor
    module.coeff = -1.0  # the floor sticks: what rubs there is not compiled any more
    module.E = module.mu = scene.mu
    module.la = scene.lam
    module.steps = module.max_steps = scene.substeps + 1
    cube = module.Scene()
    cube.new_actuator()
    cube.n_particles = cube.n_solid_particles = scene.particles
    cube.finalize()
    module.allocate_fields()
    module.actuator_id.fill(-1)
    module.particle_type.fill(1)


def transfers(ti: Any, module: Any, scene: Cube) -> tuple[Any, Any, Any]:
    """Return what sets the first places and velocities, what reads the last places, and the adjoint of the first v."""
    x, v, C, F = module.x, module.v, module.C, module.F
    count, end = scene.particles, scene.substeps
    rows = ti.types.ndarray(dtype=ti.f32, ndim=2)

    @ti.kernel
    def first(places: rows, velocities: rows):
        for p in range(count):
            for k in ti.static(range(3)):
                x[0, p][k] = places[p, k]
                v[0, p][k] = velocities[p, k]
            C[0, p] = ti.Matrix.zero(ti.f32, 3, 3)
            F[0, p] = ti.Matrix.identity(ti.f32, 3)

    @ti.kernel
    def last(places: rows):
        for p in range(count):
            for k in ti.static(range(3)):
                places[p, k] = x[end, p][k]

    @ti.kernel
    def slope(adjoint: rows):
        for p in range(count):
            for k in ti.static(range(3)):
                adjoint[p, k] = v.grad[0, p][k]

    return first, last, slope


if __name__ == "__main__":
    run(CUBE, build)
