"""Sizes beyond the machine: each verb refuses them in a line, before it allocates what they take."""

import resource
import tracemalloc
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, get_args

import pytest

from gradscape.cli import verbs
from gradscape.envs.registry import make
from gradscape.jobs import plan
from gradscape.landscapes.capacity import TooLargeError
from gradscape.optim.memory import SearchSize, require_method
from gradscape.optim.registry import methods, optimizer_class

from .processes import Ended, alone, landscape

pytestmark = pytest.mark.e2e

HUGE = 10**15
ROOM = 2 << 30  # bytes that a command may take beyond what it is loaded with
COUNTS = {"seed", "top", "workers"}  # whole numbers that allocate nothing
OF_A_GRID = [  # nor does one that is held to the points of a grid
    (("slice",), "budget"),
    (("census",), "gradients"),
    (("plan",), "gradients"),
]
SUBJECTS = {"ENV": "ackley", "SLICE": "cut", "RUN": "run", "[SLICE|ENV]": "cut", "ENV|FIGURES.toml": "branin"}
OF_A_RACE = [(("plan",), "seeds"), (("plan",), "budget")]  # those of a plan that are not of a slice
NEEDED = {"--dims": "0 1", "--over": "smoothing", "--method": "random", "--axis": "x", "--plane": "pca"}


def sizes() -> list[list[str]]:
    """Return a command for every option that is a whole number without an end, and that alone is huge."""
    found = []
    for words, command in verbs().items():
        path = tuple(words.split())
        needed = [word for one in command.params for word in _said(one, path)]
        for one in command.params:
            kind = one.type_descriptor.annotation
            held = one.max is not None or one.name in COUNTS or (path, one.name) in OF_A_GRID
            if int in (kind, *get_args(kind)) and not held:
                of_a_race = (path, one.name) in OF_A_RACE
                about = [*path, needed[0], "--methods", "random"] if of_a_race else [*path, *needed]
                found.append([*about, one.opts[0], str(HUGE)])
    return found


def is_answered(said: list[str]) -> bool:
    """Return whether a command only foretells: a slice of any size, while a race is rehearsed in this machine."""
    return said[0] == "plan" and "--methods" not in said


def _said(parameter: Any, path: tuple[str, ...]) -> list[str]:
    """Return what has to be said of a parameter; a study of fidelities needs a scene with several."""
    name = parameter.opts[0]
    if name.startswith("-"):
        return [name, *NEEDED[name].split()] if name in NEEDED else []
    subject = SUBJECTS.get(parameter.metavar, "")
    return ["bounce" if path == ("study",) else subject] if subject else []


def limited(*arguments: str) -> None:
    """Run the command with little room, so that what it allocates for a size ends it."""
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + ROOM, taken + ROOM))
    landscape(*arguments)


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a slice and a run."""
    folder, cut = tmp_path_factory.mktemp("desk"), "slice branin --dims 0 1 --resolution 4 --out cut"
    for said in (cut, "optimize branin --method random --budget 5 --out run"):
        assert alone(partial(landscape, *said.split()), folder).returncode == 0
    return folder


def refused(done: Ended) -> bool:
    return done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "would fit" in done.stderr


@pytest.mark.parametrize("said", [said for said in sizes() if not is_answered(said)], ids=" ".join)
def test_a_size_beyond_the_machine_is_refused_in_a_line(desk: Path, said: list[str]) -> None:
    done = alone(partial(limited, *said), desk)
    assert refused(done), done.stderr
    assert str(HUGE) in done.stderr


@pytest.mark.parametrize("said", [said for said in sizes() if is_answered(said)], ids=" ".join)
def test_a_plan_answers_at_any_size(desk: Path, said: list[str]) -> None:
    done = alone(partial(small_rehearsal, *said), desk)
    assert done.returncode == 0, done.stderr
    assert f"{said[-2].strip('-')} {HUGE} takes" in done.stdout


def small_rehearsal(*arguments: str) -> None:
    plan.MOST_POINTS, plan.MOST_FRAMES = 8, plan.MORE
    landscape(*arguments)


@pytest.mark.parametrize("dim", ["1000000", "0", "-1"])
def test_a_dimension_that_cannot_be_is_refused(desk: Path, dim: str) -> None:
    done = alone(partial(limited, "slice", "ackley", "--dims", "0", "--set", f"dim={dim}"), desk)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        f"landscape: ackley option dim takes a whole number above 0, at most 100000; got '{dim}'"
    ]


@pytest.mark.parametrize("name", methods())
def test_every_method_says_what_it_takes_and_is_refused_where_that_is_too_much(name: str) -> None:
    options = optimizer_class(name).Options()
    require_method(optimizer_class(name), options, SearchSize(100, budget=1000))
    with pytest.raises(TooLargeError, match=f"{name}: number of parameters 1000000000000"):
        require_method(optimizer_class(name), options, SearchSize(10**12))


def huge_options() -> list[tuple[str, str]]:
    """Return the options of methods that are whole numbers and decide how much is held."""
    found, search = [], SearchSize(2, budget=10**9)
    for name in methods():
        known = asdict(optimizer_class(name).Options())
        more = [one for one, value in known.items() if type(value) is int]
        found += [(name, one) for one in more if optimizer_class(name).memory({**known, one: HUGE}, search) > 1e12]
    return found


@pytest.mark.parametrize(("name", "option"), huge_options())
def test_an_option_that_takes_too_much_is_refused_by_name(name: str, option: str) -> None:
    options = optimizer_class(name).Options()
    object.__setattr__(options, option, HUGE)  # whatever else it may be refused for
    with pytest.raises(TooLargeError, match=f"{name} option {option} {HUGE} takes .* would fit"):
        require_method(optimizer_class(name), options, SearchSize(2, budget=10**9))


def test_a_method_is_refused_before_it_is_made(desk: Path) -> None:
    done = alone(partial(limited, *["optimize", "ackley", "--set", "dim=100000", "--method", "cma-es"]), desk)
    assert refused(done), done.stderr


@pytest.mark.parametrize(("name", "dim"), [("cma-es", 300), ("bo-leap", 300)])
def test_matrices_take_no_more_than_is_foretold(name: str, dim: int) -> None:
    env = make("ackley", dim=dim)
    kind = optimizer_class(name)
    optimizer = kind.on(env)
    tracemalloc.start()
    optimizer = kind.on(env)
    proposal = optimizer.ask()
    optimizer.tell(proposal.x, env.evaluate(proposal.x, grad=proposal.grad))
    optimizer.state()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < kind.memory(asdict(optimizer.options), SearchSize(dim)) + 2e6


def test_a_race_leaves_out_the_methods_that_do_not_fit(desk: Path) -> None:
    said = "race ackley --set dim=100000 --seeds 1 --budget 1000000 --out race"
    done = alone(partial(limited, *said.split()), desk)
    assert "without cma-es: cma-es: number of parameters 100000 takes" in done.stderr
    assert done.returncode == 2
    assert "budget 1000000 takes" in done.stderr
