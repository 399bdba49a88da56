"""Draw random command lines from a seed that make results of every kind, the same ones in every checkout.

What they ask for is written here and taken from nowhere in the package, so that a package whose modules were renamed
gets the same command lines.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

OWN = """
import torch

from gradscape import Environment, Evaluation, Fidelity, ParameterSpace


class Bowl(Environment):
    name, space = "bowl", ParameterSpace.box(["a", "b", "c"], -1.0, 2.0)
    fidelities = {"exact": Fidelity("exact", 0.0, "float64")}

    def _evaluate(self, x, *, grad):
        return Evaluation((x**2).sum(dim=1), 2 * x if grad else None, torch.ones(len(x), dtype=torch.int64))
"""
SHARES = {  # of a hundred
    "run": 25, "slice": 45, "sweep": 10, "report": 12, "race": 2, "check": 2, "tradeoff": 2, "pairs": 2,
}  # fmt: skip
DRAWN = 8  # every so many results are drawn in earnest


@dataclass(frozen=True)
class Command:
    """A command line and the folder that it makes; `needs` are folders it reads.

    `env` is the scene with its options; `drawn` lets pictures be drawn, `stop` names what the command is interrupted
    at once it is on disk.
    """

    name: str
    verb: str
    words: tuple[str, ...]
    env: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    drawn: bool = False
    stop: str = ""

    def option(self, name: str, default: str = "") -> str:
        """Return the value of an option, or a default where the command line has none."""
        return self.words[self.words.index(name) + 1] if name in self.words else default

    @property
    def plane(self) -> bool:
        """Whether this makes a slice of two parameters, over which runs can be laid."""
        return self.words[0] == "slice" and not self.words[self.words.index("--dims") + 2].startswith("--")


@dataclass(frozen=True)
class Scene:
    """What may be asked of an environment: some of its parameters, its options, and how much of it is quick.

    `names` are parameters by name, `window` is an extent in their units that suits any of them.
    """

    dim: int
    window: str
    names: tuple[str, ...] = ()
    fidelities: tuple[str, ...] = ("draft",)
    examples: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    resolution: int = 6
    budget: int = 40


def _function(dim: int, window: str) -> Scene:
    return Scene(dim, window, tuple(f"x{number}" for number in range(dim)), ("exact",))


TWICE = ("draft", "draft", "standard")
SCENES = {
    "ackley": _function(4, "-2:3"),
    "beale": _function(2, "-1:4"),
    "branin": _function(2, "0:9.5"),
    "griewank": _function(5, "-20:31"),
    "levy": _function(3, "-3:2.5"),
    "rastrigin": _function(3, "-1.5:1"),
    "rosenbrock": _function(6, "-2:2"),
    "six-hump-camel": _function(2, "-1:1"),
    "styblinski-tang": _function(4, "-5:4"),
    "bounce": Scene(3, "-3:7", ("velocity x", "velocity z"), TWICE, ("aim",), ("ke=20000", "mu=0.5", "horizon=0.5")),
    "pinball-2": Scene(2, "-0.4:0.9", ("collider 1 angle",), TWICE, ("aim",), ("restitution=0.8", "contacts=step")),
    "pinball-16": Scene(16, "-0.5:0.5", ("collider 7 angle",), TWICE, ("aim",), ("friction=0", "goal_x=6")),
    "cartpole": Scene(400, "-0.5:0.9", ("t3 torque 2",), TWICE, ("upright",), ("target_y=2", "horizon=0.5")),
    "swing-velocity": Scene(3, "-1:1.5", ("velocity y",), ("draft",), ("target",), ("loss=mesh",), 5, 20),
    "swing-stiffness": Scene(16, "3:9", (), ("draft",), ("target",), ("horizon=0.4",), 4, 20),
    "flip": Scene(15, "-0.05:0.05", ("pan tilt, segment 2",), ("draft",), ("flip",), ("horizon=0.5",), 4, 16),
    "fluid": Scene(10, "-1:1", ("ladle y speed, segment 2",), ("draft",), ("scoop",), ("viscosity=8",), 3, 8),
    "pinch": Scene(15, "-1:0.5", ("tool 1 y, segment 3",), ("draft",), ("demonstration",), ("horizon=0.4",), 2, 6),
    "own.py:Bowl": Scene(3, "-0.5:1.5", ("a", "c"), ("exact",)),
}
FUNCTIONS = tuple(name for name, scene in SCENES.items() if scene.fidelities == ("exact",) and name != "own.py:Bowl")
ANY_DIM = ("ackley", "griewank", "levy", "rastrigin", "rosenbrock", "styblinski-tang")
CHEAP = (*FUNCTIONS, "bounce", "pinball-2", "pinball-16")
SLICED = {
    **dict.fromkeys(FUNCTIONS, 3), "bounce": 10, "pinball-2": 6, "pinball-16": 5, "cartpole": 5, "swing-velocity": 3,
    "swing-stiffness": 2, "flip": 2, "fluid": 3, "pinch": 2, "own.py:Bowl": 3,
}  # fmt: skip
SEARCHED = {
    **dict.fromkeys(FUNCTIONS, 1), "bounce": 5, "pinball-2": 4, "pinball-16": 2, "cartpole": 3, "swing-velocity": 1,
    "flip": 1, "fluid": 1, "pinch": 1,
}  # fmt: skip
SWEPT = {"ackley": 2, "levy": 2, "bounce": 3, "pinball-16": 2, "cartpole": 1, "swing-velocity": 1}
DEAR = ("swing-stiffness", "flip", "fluid", "pinch")  # whose reports take minutes
METHODS = {  # with options of each
    "random": (),
    "cma-es": ("sigma=0.2", "population=5"),
    "descents": ("step=0.5", "steps=7", "shrink=0.7"),
    "bo": ("initial=4", "kernel=matern", "coefficient=2"),
    "bo-descents": ("initial=5", "steps=4"),
    "bo-leap": ("initial=4", "population=6", "sigma=0.5"),
    "ppo": ("epochs=3", "learning_rate=0.01"),
    "sac": ("warmup=4", "learning_rate=0.01"),
}
POLICIES = ("ppo", "sac")  # which learn from every decision of an episode, of which cartpole has a hundred
HALF = (  # each with what is on disk when it is interrupted
    ("slice", "bounce --dims 0 1 --resolution 48 --fidelity draft --device cpu", "slice.filling.zarr/loss/c"),
    ("slice", "ackley --set dim=3 --dims 0 2 --resolution 96 --device cpu", "slice.filling.zarr/loss/c"),
    ("slice", "pinball-2 --dims 0 1 --resolution 40 --no-gradients --fidelity draft --device cpu",
     "slice.filling.zarr/loss/c"),
    ("slice", "own.py:Bowl --dims 0 1 --resolution 96 --device cpu", "slice.filling.zarr/loss/c"),
    ("bounce", "--axis y --resolution 4096 --fidelity draft --device cpu", "slice.filling.zarr/loss/c"),
    ("optimize", "ackley --set dim=3 --method cma-es --budget 6000 --device cpu", "run.zarr/loss/c"),
    ("optimize", "bounce --method descents --budget 400 --fidelity draft --device cpu", "run.zarr/loss/c"),
    ("sweep", "levy --set dim=3 --dims 0 1 --over 2 --frames 3 --resolution 4 --device cpu", "frames/000.zarr"),
    ("race", "levy --methods random,descents --seeds 2 --budget 12 --device cpu", "random-0/run.zarr/loss/c"),
    ("pairs", "bounce --samples 96 --fidelity draft --device cpu", "pieces/*.npz"),
    ("tradeoff", "bounce --points 2 --variants precision --device cpu", "pieces/*.npz"),
)  # fmt: skip


def commands(count: int, seed: int) -> list[Command]:
    """Return so many command lines of all kinds, each after those that it needs."""
    counts = {verb: round(count * share / 100) for verb, share in SHARES.items()}
    counts["slice"] += count - sum(counts.values())
    found: list[Command] = []
    for verb, draw in (
        ("run", _runs), ("slice", _slices), ("sweep", _sweeps), ("report", _reports), ("race", _races),
        ("check", _checks), ("tradeoff", _tradeoffs), ("pairs", _pairs),
    ):  # fmt: skip
        found += draw(random.Random(f"{seed}-{verb}"), counts[verb], found)
    return [_numbered(number, command) for number, command in enumerate(found)]


def unfinished() -> list[Command]:
    """Return command lines that are to be interrupted when something is on disk."""
    return [
        Command(name := f"half-{number}-{verb}", verb, (verb, *words.split(), "--out", name), stop=stop)
        for number, (verb, words, stop) in enumerate(HALF)
    ]


def _numbered(number: int, command: Command) -> Command:
    out = () if command.verb == "check" else ("--out", command.name)  # a check leaves nothing
    drawn = number % DRAWN == 0 and command.verb != "tradeoff"  # which would then also be timed in earnest
    return Command(command.name, command.verb, (*command.words, *out), command.env, command.needs, drawn)


def _spread(chance: random.Random, weights: Mapping[str, int], count: int) -> list[str]:
    """Return so many names in random order, each about as often as it weighs, and at least once if there is room."""
    whole = [name for name, weight in weights.items() for _ in range(weight)]
    turns = [whole[int(turn * len(whole) / count)] for turn in range(count)] if count else []
    chance.shuffle(turns)
    return turns


def _scene(chance: random.Random, name: str) -> tuple[str, ...]:
    """Return a scene with options of its, or without."""
    if name in ANY_DIM:
        return (name, "--set", f"dim={SCENES[name].dim}")
    options = SCENES[name].options
    return (name, "--set", chance.choice(options)) if options and chance.random() < 0.4 else (name,)


def _accuracy(chance: random.Random, name: str) -> tuple[str, ...]:
    fidelity = chance.choice(SCENES[name].fidelities)
    return ("--fidelity", fidelity, "--device", "cpu")


def _dims(chance: random.Random, name: str, count: int, without: Sequence[int] = ()) -> list[str]:
    """Return parameters, mostly by number and sometimes the first by name."""
    scene = SCENES[name]
    numbers = [str(one) for one in chance.sample([n for n in range(min(scene.dim, 40)) if n not in without], count)]
    if scene.names and not without and chance.random() < 0.3:
        numbers[0] = scene.names[-1]
        if count == 2:
            numbers[1] = "0" if scene.dim > 1 else "1"
    return numbers


def _runs(chance: random.Random, count: int, _: Sequence[Command]) -> list[Command]:
    found = []
    methods = [list(METHODS)[number % len(METHODS)] for number in range(count)]
    scenes = _spread(chance, SEARCHED, count)
    for number, (method, name) in enumerate(zip(methods, scenes, strict=True)):
        if method in POLICIES and name == "cartpole":
            name = "bounce"
        least, most = 21 if method == "ppo" else 6, 12 if (method, name) == ("bo", "cartpole") else SCENES[name].budget
        budget = chance.randint(least, max(least, most))
        env = (name,) if method in POLICIES and name not in ANY_DIM else _scene(chance, name)
        words = ("optimize", *env, "--method", method, "--budget", str(budget), "--seed", str(chance.randint(0, 99)))
        options = METHODS[method]
        option = ("--option", chance.choice(options)) if options and chance.random() < 0.6 else ()
        words = (*words, *_accuracy(chance, name), *option)
        found.append(Command(f"run-{number:02}-{name}-{method}", "run", words, env))
    return found


def _slices(chance: random.Random, count: int, runs: Sequence[Command]) -> list[Command]:
    found = []
    for number, name in enumerate(_spread(chance, SLICED, count)):
        scene, label = SCENES[name], f"slice-{number:02}-{name.partition('.')[0]}"
        searched = [run.env for run in runs if run.env[0] == name]  # over such a slice a run can be laid
        env = chance.choice(searched) if searched and chance.random() < 0.7 else _scene(chance, name)
        resolution = str(chance.randint(min(3, scene.resolution), scene.resolution))
        through, needs = _point(chance, scene, env, runs)
        extent = chance.choice([(), (), ("--extent", f"{chance.uniform(0.1, 0.9):.3g}"), ("--extent", scene.window)])
        accuracy = _accuracy(chance, name)
        if name == "bounce" and chance.random() < 0.4:
            words = ("bounce", *env[1:], "--axis", chance.choice("xyz"), "--resolution", str(chance.randint(3, 40)))
        else:
            dims = _dims(chance, name, chance.choice([1, 2, 2]))
            words = ("slice", *env, "--dims", *dims, "--resolution", resolution)
            extent += ("--no-gradients",) if name in CHEAP and chance.random() < 0.2 else ()
        found.append(Command(label, "slice", (*words, *through, *extent, *accuracy), env, needs))
    return found


def _point(
    chance: random.Random, scene: Scene, env: tuple[str, ...], runs: Sequence[Command]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return through which point a slice goes, and the run it is taken from."""
    matching = [run.name for run in runs if run.env == env]
    if matching and chance.random() < 0.2:
        run = chance.choice(matching)
        return ("--through", f"best:{run}"), (run,)
    words = ["center", f"random:{chance.randint(0, 999)}", *(f"example:{one}" for one in scene.examples)]
    text = chance.choice(words)
    return (() if text == "center" else ("--through", text)), ()


def _sweeps(chance: random.Random, count: int, _: Sequence[Command]) -> list[Command]:
    found = []
    for number, name in enumerate(_spread(chance, SWEPT, count)):
        env = (name, "--set", f"dim={SCENES[name].dim}") if name in ANY_DIM else (name,)
        over = chance.choice(["2", "2", "smoothing", *(() if name in ANY_DIM else ("horizon",))])
        dims = _dims(chance, name, 2, without=(2,))
        words = ("sweep", *env, "--dims", *dims, "--over", over, "--frames", str(chance.randint(2, 3)),
                 "--resolution", str(chance.randint(2, 4)), *_accuracy(chance, name))  # fmt: skip
        extent = ("--extent", f"{chance.uniform(0.2, 0.8):.3g}") if chance.random() < 0.3 else ()
        grad = ("--no-gradients",) if chance.random() < 0.2 else ()
        found.append(Command(f"sweep-{number:02}-{name}", "sweep", (*words, *extent, *grad), env))
    return found


def reportable(command: Command) -> bool:
    """Say whether a slice has what a report needs: gradients, and three samples along each axis."""
    enough = command.verb == "slice" and int(command.option("--resolution")) >= 3
    return enough and "--no-gradients" not in command.words and command.env[0] not in DEAR


def _reports(chance: random.Random, count: int, made: Sequence[Command]) -> list[Command]:
    able = [command for command in made if reportable(command)]
    found = []
    for number, of in enumerate(chance.sample(able, min(count, len(able)))):
        source = ("--env", of.env[0]) if of.env[0].startswith("own.py") else ()
        points = ("--points", str(chance.randint(2, 3)), "--seed", str(chance.randint(0, 9)))
        words = ("report", of.name, *source, *points, "--device", "cpu")
        found.append(Command(f"report-{number:02}-{of.name}", "report", words, of.env, (of.name,)))
    return found


def _races(chance: random.Random, count: int, _: Sequence[Command]) -> list[Command]:
    found = []
    for number in range(count):
        name = ("bounce", "six-hump-camel", "pinball-2")[number % 3]
        methods = ",".join(chance.sample(["random", "cma-es", "descents", "bo-descents"], 2))
        size = ("--seeds", "2", "--budget", str(chance.randint(8, 14)))
        words = ("race", name, "--methods", methods, *size, *_accuracy(chance, name))
        found.append(Command(f"race-{number}-{name}", "race", words, (name,)))
    return found


def _checks(chance: random.Random, count: int, _: Sequence[Command]) -> list[Command]:
    names = ("branin", "pinball-2", "bounce")
    found = []
    for number in range(count):
        name = names[number % len(names)]
        words = ("check", name, "--points", "2", "--seed", str(chance.randint(0, 9)), "--device", "cpu", "--json")
        found.append(Command(f"check-{number}-{name}", "check", words, (name,)))
    return found


def _tradeoffs(chance: random.Random, count: int, _: Sequence[Command]) -> list[Command]:
    found = []
    for number in range(count):
        name, setting = (("bounce", "precision"), ("pinball-2", "dt"))[number % 2]
        seed = ("--seed", str(chance.randint(0, 9)))
        words = (
            "tradeoff",
            name,
            "--points",
            str(chance.randint(2, 5)),
            "--variants",
            setting,
            *seed,
            "--device",
            "cpu",
        )
        found.append(Command(f"tradeoff-{number}-{name}", "tradeoff", words, (name,)))
    return found


def _pairs(chance: random.Random, count: int, _: Sequence[Command]) -> list[Command]:
    found = []
    for number in range(count):
        env = (("ackley", "--set", "dim=4"), ("bounce",))[number % 2]
        words = ("pairs", *env, "--samples", str(chance.randint(2, 4)), "--seed", str(chance.randint(0, 9)))
        found.append(Command(f"pairs-{number}-{env[0]}", "pairs", (*words, "--device", "cpu"), env))
    return found
