"""Sizes beyond the machine: each verb refuses them in a line, before it allocates what they take."""

import io
import json
import os
import resource
import tracemalloc
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import get_args

import pytest

from gradscape.cli import main, verbs
from gradscape.envs.registry import make
from gradscape.landscapes.capacity import TooLargeError
from gradscape.optim.memory import SearchSize
from gradscape.optim.registry import methods, optimizer_class

from .command import leave_blank
from .processes import FORK

pytestmark = pytest.mark.e2e

HUGE = 10**15
ROOM = 6 << 30  # bytes that a command may take beyond what it is loaded with
COUNTS = {"--seed", "--top", "--workers", "--port", "--jobs"}  # whole numbers that allocate nothing
OF_A_GRID = {("slice", "--budget"), ("census", "--gradients")}  # nor does one that is held to the points of a grid
OF_A_GRID |= {("slice", "--gradients"), ("sweep", "--gradients"), ("study", "--grid")}
SUBJECTS = {"env": "ackley", "SLICE": "cut", "RUNS": "run", "WHAT": "cut", "KIND": "extremes"}
NEEDED = {"--dims": "0 1", "--over": "smoothing", "--method": "random", "--axis": "x", "--plane": "pca"}


DIMS = ("1000000", "0", "-1")
LARGE = "optimize ackley --set dim=100000 --method cma-es"
RACE = "race ackley --set dim=100000 --seeds 1 --budget 1000000 --out race"
WRONG = [*(["slice", "ackley", "--dims", "0", "--set", f"dim={dim}"] for dim in DIMS), LARGE.split(), RACE.split()]


@cache
def sizes() -> list[list[str]]:
    """Return a command for every option that is a whole number without an end, and that alone is huge."""
    found = []
    for words, verb in verbs().items():
        needed = [word for one in verb.options for word in _said(one.names[0], words)]
        for name in (one.names[0] for one in verb.options if int in (one.type, *get_args(one.type))):
            if name not in COUNTS and (words, name) not in OF_A_GRID:
                found.append([*words.split(), *needed, name, str(HUGE)])
    return [*found, ["plan", *found[0]]]


def _said(name: str, words: str) -> list[str]:
    """Return what has to be said of an argument or an option; a study of extremes needs a scene with steps."""
    if name.startswith("-"):
        return [name, *NEEDED[name].split()] if name in NEEDED else []
    return ["bounce" if (words, name) == ("study", "env") else SUBJECTS[name]] if name in SUBJECTS else []


def walk(folder: Path) -> None:
    """Run all commands one after the other with little room, and write down what each said."""
    patch = pytest.MonkeyPatch()
    leave_blank(patch.setattr)
    os.chdir(folder)
    for line in (
        "slice branin --dims 0 1 --resolution 4 --out cut",
        "optimize branin --method random --budget 5 --out run",
    ):
        say(line.split())
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + ROOM, taken + ROOM))
    Path("said.json").write_text(json.dumps([say(words) for words in (*sizes(), *WRONG)]))


def say(words: list[str]) -> tuple[int, str]:
    """Run a command in this process; return its exit code and what it said on standard error."""
    out = io.StringIO()
    with redirect_stderr(out), redirect_stdout(io.StringIO()):
        try:
            main(words)
        except SystemExit as left:
            return int(left.code or 0), out.getvalue()
    return 0, out.getvalue()


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str]]:
    """Return what a process with little room said of each command."""
    folder = tmp_path_factory.mktemp("sizes")
    process = FORK.Process(target=walk, args=(folder,))
    process.start()
    process.join()
    found = json.loads((folder / "said.json").read_text())
    return {" ".join(words): tuple(one) for words, one in zip((*sizes(), *WRONG), found, strict=True)}


def test_sizes_beyond_the_machine_are_refused_in_a_line(said: dict[str, tuple[int, str]]) -> None:
    assert len(sizes()) > 20
    for line in map(" ".join, sizes()):
        code, text = said[line]
        assert (code, text.count("\n")) == (2, 1), (line, text)
        assert "would fit" in text, line
        assert str(HUGE) in text, line


def test_dimensions_and_methods_that_cannot_be_are_refused(said: dict[str, tuple[int, str]]) -> None:
    for dim in DIMS:
        assert said[f"slice ackley --dims 0 --set dim={dim}"] == (
            2, f"landscape: ackley option dim takes a whole number above 0, at most 100000; got '{dim}'\n"
        )  # fmt: skip
    code, text = said[LARGE]
    assert (code, text.count("\n"), "would fit" in text) == (2, 1, True)  # before it is made
    code, text = said[RACE]
    assert code == 2
    assert "cma-es cannot run here: cma-es: number of parameters 100000 needs" in text
    assert "budget 1000000 needs" in text


@pytest.mark.parametrize("name", methods())
def test_every_method_says_what_it_takes_and_is_refused_where_that_is_too_much(name: str) -> None:
    options = optimizer_class(name).Options()
    optimizer_class(name).require_memory(options, SearchSize(100, budget=1000))
    with pytest.raises(TooLargeError, match=f"{name}: number of parameters 1000000000000"):
        optimizer_class(name).require_memory(options, SearchSize(10**12))


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
    with pytest.raises(TooLargeError, match=f"{name} option {option} {HUGE} needs about .* would fit"):
        optimizer_class(name).require_memory(options, SearchSize(2, budget=10**9))


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
