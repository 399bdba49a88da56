"""A call of Python is the command's: it finds what that left, by its folder's name, and makes the same elsewhere."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import gradscape as gs

from ..command import Run
from ..kinds import numbers

SMALL: dict[str, Any] = {"through": "example:aim", "frames": 2, "resolution": 3, "device": "cpu"}
OPTIONS: dict[str, Any] = {"budget": 12, "seeds": 2, "method_options": {"cma-es": {"population": 5}}}
SAME: dict[str, Callable[..., Any]] = {
    "slice branin --dims 0 1 --resolution 6": lambda **out: gs.slice("branin", ("x0", "x1"), resolution=6, **out),
    "slice bounce --along random:1 --window 0.5 --resolution 2 --device cpu": lambda **out: gs.slice(
        "bounce", along="random:1", window=0.5, resolution=2, device="cpu", **out
    ),
    "sweep bounce --dims 0 1 --over 2 --frames 2 --resolution 3 --through example:aim --device cpu": lambda **out: (
        gs.sweep("bounce", (0, 1), 2, **SMALL, **out)
    ),
    "optimize branin --method cma-es --budget 20 --seed 3 --option population=5": lambda **out: gs.optimize(
        "branin", "cma-es", budget=20, seed=3, method_options={"population": 5}, **out
    ),
    "race branin --methods random,cma-es --budget 12 --seeds 2 --option cma-es.population=5": lambda **out: gs.race(
        "branin", ["random", "cma-es"], **OPTIONS, **out
    ),
    "league branin beale --methods random --budget 6 --seeds 2": lambda **out: gs.league(
        ["branin", "beale"], "random", budget=6, seeds=2, **out
    ),
    "pairs ackley --set dim=3 --samples 2": lambda **out: gs.pairs("ackley", samples=2, options=["dim=3"], **out),
    "hessian branin --through random:1": lambda **out: gs.hessian("branin", "random:1", **out),
}


@pytest.mark.parametrize("command", SAME)
def test_a_call_finds_and_makes_what_the_command_made(run: Run, tmp_path: Path, command: str) -> None:
    folder = tmp_path / run.json(command)["folder"]
    made = numbers(folder)
    SAME[command]()
    assert [path.name for path in (tmp_path / "out").iterdir()] == [folder.name]
    assert numbers(folder) == made != {}
    SAME[command](out=tmp_path / "again")
    assert numbers(tmp_path / "again") == made
