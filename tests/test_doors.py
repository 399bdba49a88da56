"""Whatever is a simulator goes through every public function and every verb, or is told what it lacks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import gradscape as gs
from gradscape.cli import verbs
from gradscape.envs.registry import as_environment, entries

from .command import Run, leave_blank

pytestmark = pytest.mark.e2e

SIMULATORS = """
import jax.numpy as jnp
import warp as wp

import gradscape as gs
from gradscape.cli import verbs

space = gs.ParameterSpace({"x": (-1, 2, "m"), "y": (-1, 2, "m")})
of_torch = gs.from_torch(lambda x: (x**2).sum(1), space, name="of-torch")
of_jax = gs.from_jax(lambda p: jnp.sum(p**2), space, name="of-jax")
of_numpy = gs.from_numpy(lambda x: (x**2).sum(1), space, differences=1e-4)


@wp.kernel
def square(x: wp.array2d(dtype=wp.float32), loss: wp.array(dtype=wp.float32)):
    i = wp.tid()
    loss[i] = x[i, 0] * x[i, 0] + x[i, 1] * x[i, 1]


def launch(x):
    loss = wp.zeros(len(x), dtype=wp.float32, requires_grad=True)
    wp.launch(square, dim=len(x), inputs=[x], outputs=[loss])
    return loss


of_warp = gs.from_warp(launch, space, name="of-warp", device="cpu")


class Bowl(gs.Environment):
    space = space

    def _evaluate(self, x, *, grad):
        return gs.Evaluation.from_results((x**2).sum(1), 2 * x if grad else None)


bowl = Bowl()


class Own:
    space = space

    def evaluate(self, x, *, grad=True):
        return gs.Evaluation.from_results((x**2).sum(1), 2 * x if grad else None)


own = Own()
"""
NAMES = ("of_torch", "of_jax", "of_numpy", "of_warp", "Bowl", "bowl", "own")
WALKED = ("of_jax", "Own")  # by all functions and verbs; others by the functions that evaluate, keep and send them
SHORT = ("as_environment", "make", "check", "slice", "sample", "optimize", "advise")
LACKING = {  # what some verbs need of a simulator
    "replay": "has no episode to draw; give its class a method `episode`",
    "study": "has one fidelity, default, so there is nothing",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("doors")
    (found / "doors.py").write_text(SIMULATORS)
    return found


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Work in the folder of the simulators, and draw blank pictures."""
    monkeypatch.chdir(folder)
    leave_blank(monkeypatch.setattr)
    monkeypatch.setattr("gradscape.jobs.explore_page.Explorer.wait", lambda explorer: explorer.close())
    yield folder
    entries.cache_clear()


def functions(f: Any, name: str) -> dict[str, Callable[[], Any]]:
    """Return a call of every public function that takes a simulator, by the function's name."""
    small: dict[str, Any] = {"budget": 6, "seeds": 2}
    return {
        "as_environment": lambda: gs.as_environment(f),
        "make": lambda: gs.make(f),
        "check": lambda: gs.check(f, power="20%"),
        "explore": lambda: gs.explore(f, browser=False).close(),
        "slice": lambda: gs.slice(f, resolution=6, out=f"{name}/slice"),
        "sample": lambda: gs.sample(f, gs.open_slice(f"{name}/slice").plane),
        "open_slice": lambda: gs.open_slice(f"{name}/slice", env=f).report(points=2),
        "report": lambda: gs.report(f"{name}/slice", env=f, points_per_axis=2, out=f"{name}/report"),
        "sweep": lambda: gs.sweep(f, (0, 1), "smoothing", frames=2, resolution=4, out=f"{name}/sweep"),
        "advise": lambda: gs.advise(f, budget=200),
        "optimize": lambda: gs.optimize(f, "random", budget=6, out=f"{name}/run"),
        "open_run": lambda: gs.open_run(f"{name}/run"),
        "race": lambda: gs.race(f, ["random", "cma-es"], **small, out=f"{name}/race"),
        "league": lambda: gs.league([f], ["random", "cma-es"], **small, out=f"{name}/league"),
        "overlay": lambda: gs.overlay(
            gs.open_slice(f"{name}/slice", env=f), f"{name}/run", through="best", out=f"{name}/overlay"
        ),
        "compare": lambda: gs.compare(f"{name}/slice", f, out=f"{name}/compare"),
        "pairs": lambda: gs.pairs(f, samples=2, out=f"{name}/pairs"),
        "hessian": lambda: gs.hessian(f, [0.5, 1.0], out=f"{name}/hessian"),
        "remedy": lambda: gs.remedy(f, remedies="smooth:2%:first:4", starts=6, budget=16, out=f"{name}/remedy"),
        "census": lambda: gs.census(f, slices=2, resolution=6, out=f"{name}/census"),
        "study": lambda: gs.study("fidelity", f, points=4, out=f"{name}/study"),
        "replay": lambda: gs.replay(f, out=f"{name}/replay"),
        "surface": lambda: gs.surface(f"{name}/slice", out=f"{name}/surface"),
        "export": lambda: gs.export(f"{name}/slice"),
        "plan": lambda: gs.plan(gs.slice, f, resolution=6),
    }


def commands(f: str, name: str) -> dict[str, str]:
    """Return a command of every verb that takes a simulator, or what others made of one, by the verb."""
    return {
        "envs": f"envs {f}",
        "explore": f"explore {f} --no-browser",
        "slice": f"slice {f} --resolution 6 --out {name}/s",
        "report": f"report {name}/s --env {f} --points-per-axis 2 --out {name}/r",
        "check": f"check {f} --power 20%",
        "sweep": f"sweep {f} --dims 0 1 --over smoothing --frames 2 --resolution 4 --out {name}/w",
        "advise": f"advise {f} --budget 200",
        "optimize": f"optimize {f} --method random --budget 6 --out {name}/o",
        "race": f"race {f} --methods random,cma-es --budget 6 --seeds 2 --out {name}/a",
        "league": f"league {f} --methods random,cma-es --budget 6 --seeds 2 --out {name}/l",
        "overlay": f"overlay {name}/s {name}/o --env {f} --through best --out {name}/v",
        "compare": f"compare {name}/s {f} --out {name}/c",
        "surface": f"surface {name}/s --out {name}/u",
        "export": f"export {name}/s",
        "plan": f"plan slice {f} --dims 0 1 --resolution 6",
        "pairs": f"pairs {f} --samples 2 --out {name}/p",
        "hessian": f"hessian {f} --through random:1 --out {name}/h",
        "remedy": f"remedy {f} --remedies clip:9 --starts 6 --budget 16 --out {name}/m",
        "census": f"census {f} --slices 2 --resolution 6 --out {name}/n",
        "replay": f"replay {f}",
        "study": f"study fidelity {f} --points 4 --out {name}/t",
    }


OTHER_FUNCTIONS = {"bench", "bounce", "card", "list_envs", "log", "register", "slices"}  # of no simulator that is given
OTHER_FUNCTIONS |= {"average", "clip", "rescale", "shorten", "smooth", "soften"}  # which test_remedies.py tries
OTHER_VERBS = {"bench", "bounce", "card", "info", "methods", "view"}  # so are these; bench times, which takes long


@pytest.mark.parametrize("name", NAMES)
def test_every_function_takes_it_or_says_what_it_lacks(name: str, here: Path) -> None:
    """One is an environment as soon as it is given, so that most functions need not meet all of them."""
    for verb, call in functions(vars(_module(here))[name], f"function-{name}").items():
        if name not in WALKED and verb not in SHORT:
            continue
        if verb in LACKING:
            with pytest.raises(ValueError, match=LACKING[verb]):
                call()
        else:
            call()


@pytest.mark.parametrize("name", WALKED)
def test_every_verb_takes_it_or_says_what_it_lacks(name: str, here: Path, run: Run) -> None:
    for verb, words in commands(f"doors.py:{name}", f"verb-{name}").items():
        said = run(words, cwd=here)
        lacks = LACKING.get(verb, "")
        assert said.returncode == (2 if lacks else 0), (words, said)
        assert lacks in said.stderr


PENDULUM = """
import jax
import jax.numpy as jnp

import gradscape as gs
from gradscape.cli import verbs


def swing(p, damping=0.1, dt=0.1, steps=10):
    def step(state, _):
        angle, rate = state
        rate = rate + dt * (-9.81 * jnp.sin(angle) - damping * rate + p[1])
        return (angle + dt * rate, rate), None

    (angle, _), _ = jax.lax.scan(step, (p[0], 0.0), None, length=steps)
    return angle**2


pendulum = gs.from_jax(
    swing,
    gs.ParameterSpace({"angle": (-2, 2, "rad"), "torque": (-1, 1, "N m")}),
    loss_unit="rad^2",
    fidelities={"draft": {"dt": 0.05, "steps": 20}, "reference": {"dt": 0.01, "steps": 100}},
    horizon="steps",
)
"""


def test_a_pendulum_with_fidelities_and_a_horizon_is_studied_like_a_scene(
    here: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gradscape.studies.samples.REPETITION", 0.0)
    (here / "pendulum.py").write_text(PENDULUM)
    f = "pendulum.py:pendulum"
    for words in (
        f"check {f} --power 20%",
        f"slice {f} --resolution 6 --fidelity reference --set damping=0.2 --out p/slice",
        f"study fidelity {f} --points 4 --settings dt --out p/fidelity",
        f"study convergence {f} --points 4 --settings dt --out p/convergence",
        f"sweep {f} --dims 0 1 --over horizon --frames 2 --resolution 4 --out p/sweep",
        f"census {f} --slices 2 --resolution 6 --out p/census",
        f"race {f} --methods random,l-bfgs-b --budget 12 --seeds 2 --out p/race",
        f"study extremes {f} --points 4 --settings damping --pairs none --precisions float64 --out p/extremes",
    ):
        run.ok(words, cwd=here)
    errors = gs.study(
        "fidelity", vars(_module(here, "pendulum.py"))["pendulum"], points=4, settings=("dt",), out="p/fidelity"
    )
    median = errors.table()["median"]
    assert median["draft-dt-x0.5"] < median["draft"] < median["draft-dt-x2"]  # of the same time, by whole steps
    assert median["reference"] == 0


def test_the_walk_leaves_out_no_function_and_no_verb() -> None:
    public = {one for one in gs.__all__ if callable(getattr(gs, one)) and not isinstance(getattr(gs, one), type)}
    makers = {one for one in public if one.startswith("from_")}
    assert public - makers - OTHER_FUNCTIONS == set(functions(None, ""))
    known = {one for one in verbs() if not one.startswith("gallery")}
    assert known - OTHER_VERBS == set(commands("", ""))


def test_functions_of_a_file_have_its_names(here: Path) -> None:
    assert as_environment("doors.py:of_torch").name == "of-torch"
    assert as_environment("doors.py:of_numpy").name == "of_numpy"


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("doors.py:nothing", r"has no nothing; it has of_torch, of_jax, of_numpy, of_warp, Bowl, bowl, Own, own"),
        ("doors.py:launch", "launch is a function without a parameter space"),
        ("doors.py:space", "ParameterSpace is no simulator: it has no space and no evaluate"),
        ("elsewhere.py:f", "there is no file elsewhere.py, so f cannot be loaded"),
    ],
)
def test_what_is_no_simulator_is_refused_in_words(what: str, said: str, here: Path) -> None:
    with pytest.raises(ValueError, match=said):
        as_environment(what)


def _module(folder: Path, name: str = "doors.py") -> Any:
    from gradscape.envs.registry import import_named

    return import_named(str(folder / name))
