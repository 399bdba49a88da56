"""Somebody else's simulator: a class in a file, registered by a program, short of what a scene of ours has."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.envs import registry
from gradscape.landscapes.identity import stored_identity

from .command import Run

pytestmark = pytest.mark.e2e

# It has neither name nor fidelities nor docstring, imports a neighbour, and refuses what lies beyond its bounds.
ARM = '''
from dataclasses import dataclass
import torch
import gradscape as gs
from joints_of_the_arm import STIFFNESS

@dataclass(frozen=True)
class Stiffness:
    stiffness: float = STIFFNESS

class TwoLinkArm(gs.Environment):
    Options = Stiffness
    space = gs.ParameterSpace({"shoulder": (-1, 1, "rad"), "elbow": (0, 2, "rad"), "load": (0.1, 0.9, "kg")})
    loss_unit = "J"

    def _evaluate(self, x, *, grad):
        if not bool(((x >= self.space.lower) & (x <= self.space.upper)).all()):
            raise RuntimeError("the arm's joints do not go there")
        loss = self.options.stiffness * (x[:, 0] ** 2 + (x[:, 1] - 1) ** 2) + x[:, 2]
        slope = torch.stack([2 * x[:, 0], 2 * (x[:, 1] - 1), torch.ones(len(x))], dim=1)
        slope[:, :2] *= self.options.stiffness
        return gs.Evaluation.from_results(loss, slope if grad else None)

class Arm(TwoLinkArm):
    """An arm.

    With words.
    """

NOTHING = 3
'''


@pytest.fixture(autouse=True)
def unimported() -> Iterator[None]:
    """Forget the module that lies beside a class's file."""
    yield
    sys.modules.pop("joints_of_the_arm", None)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "arm.py").write_text(ARM)
    (tmp_path / "joints_of_the_arm.py").write_text("STIFFNESS = 1.0")
    return tmp_path


def test_a_class_in_a_file_is_sliced_measured_searched_and_shown(run: Run, folder: Path) -> None:
    run.ok("slice arm.py:TwoLinkArm --dims elbow 0 --resolution 9 --out cut", cwd=folder)
    dataset = gs.open_slice(folder / "cut").data
    assert stored_identity(dataset)["objective"] == "two-link-arm"
    assert dataset["loss"].attrs["units"] == "J"
    run.ok("optimize arm.py:TwoLinkArm --method descents --budget 9 --out run", cwd=folder)
    for command in (
        ["report", "cut", "--env", "arm.py:TwoLinkArm", "--points-per-axis", "6", "--out", "told"],
        ["overlay", "cut", "run", "--env", "arm.py:TwoLinkArm", "--through", "best", "--out", "over"],
        ["check", "arm.py:TwoLinkArm", "--power", "20%"],
        ["plan", "slice", "arm.py:TwoLinkArm", "--dims", "0", "1", "--resolution", "4"],
        ["race", "arm.py:TwoLinkArm", "--methods", "random", "--seeds", "1", "--budget", "3", "--out", "raced"],
        ["pairs", "arm.py:TwoLinkArm", "--samples", "2", "--out", "paired"],
    ):
        registry.entries().pop("two-link-arm", None)  # as in another process
        run.ok(*command, cwd=folder)
    registry.entries().pop("two-link-arm")
    run.refuse("report cut --out elsewhere", cwd=folder, said="give --env FILE.py:NAME, or env= in Python")


def test_a_class_in_a_file_says_what_there_is_to_say(run: Run, folder: Path) -> None:
    bare, worded = (run("envs", f"arm.py:{name}", cwd=folder).stdout for name in ("TwoLinkArm", "Arm"))
    for said in (bare, worded):
        for part in ("3 parameters", "elbow", "rad", "fidelity", "stiffness=a number (default 1.0)"):
            assert part in said
        assert "Stiffness(" not in said
        assert "differentiable scene" not in said  # what the base class says of all
    assert "No description" in bare
    assert "An arm.\n\nWith words." in worded
    listed = run("envs", cwd=folder).stdout
    assert "?" not in listed
    row = next(line for line in listed.splitlines() if line.startswith("│ arm "))
    assert [cell.strip() for cell in row.split("│")[1:3]] == ["arm", "3"]
    assert "An arm." in row


@pytest.mark.parametrize("words", [["--dims", "1"], ["--dims", "elbow"]])
@pytest.mark.parametrize("last", [True, False])
def test_a_line_has_one_dimension(run: Run, folder: Path, words: list[str], last: bool) -> None:
    env = ["arm.py:TwoLinkArm"]
    command = ["slice", *words, *env] if last else ["slice", *env, *words]
    found = run.json(*command, "--resolution", "5", "--out", "line", cwd=folder)
    assert found["dims"] == ["elbow"]
    line = gs.open_slice(folder / "line").data
    np.testing.assert_allclose(line["loss"], (line["u"] - 1) ** 2 + 0.5)
    assert (folder / "line/landscape.png").exists()
    again = run(*command, "--resolution", "5", "--out", "line", cwd=folder)
    assert "all 5 episodes with gradients are done already" in again.stderr


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("arm.py:Leg", "arm.py has no Leg; it has TwoLinkArm, Arm"),
        ("arm.py:NOTHING", "arm.py:NOTHING: int is no simulator"),
        ("leg.py:Leg", "there is no file leg.py"),
        ("broken.py:Arm", "broken.py cannot be imported: ZeroDivisionError"),
        ("leaves.py:Arm", "leaves.py called sys.exit(3) while it was imported; move that call under"),
        ("fluid.py:Mine", "fluid.py:Mine and gradscape.envs.mpm.fluid:Fluid are both called 'fluid'"),
    ],
)
def test_a_file_without_the_class_is_refused_by_name(run: Run, folder: Path, name: str, said: str) -> None:
    (folder / "broken.py").write_text("Arm = 1 / 0")
    (folder / "leaves.py").write_text("import sys\nArm = sys.exit(3)")
    (folder / "fluid.py").write_text(
        ARM.replace("TwoLinkArm", "Mine").replace("loss_unit", 'name = "fluid"\n    loss_unit')
    )
    done = run("slice", name, "--dims", "0", cwd=folder)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert said in done.stderr


class Spring(gs.Environment):
    """A spring."""

    space = gs.ParameterSpace({"pull": (0, 1, "m")})

    def _evaluate(self, x, *, grad):  # type: ignore[no-untyped-def]
        return gs.Evaluation.from_results(x[:, 0] ** 2, 2 * x if grad else None)


def test_a_program_registers_a_class_and_the_command_finds_it(run: Run) -> None:
    assert gs.register(Spring) is Spring
    assert isinstance(gs.make("spring"), Spring)
    run.ok("slice spring --dims 0 --resolution 4 --out cut")
    run.ok("report cut --points-per-axis 2 --out told")
    gs.register(Spring)  # again, as a cell of a notebook does
    with pytest.raises(ValueError, match="an environment called 'fluid' already exists"):
        gs.register(type("Fluid", (Spring,), {"name": "fluid"}))
    with pytest.raises(ValueError, match="takes an environment, or a class derived from Environment"):
        gs.register("spring")  # type: ignore[type-var]


def short_of(**what: object) -> gs.Environment:
    made: type[gs.Environment] = type("Short", (Spring,), what)
    return made()


@pytest.mark.parametrize(
    ("what", "said"),
    [
        (
            {"_evaluate": lambda self, x, *, grad: x[:, 0]},
            "must return an Evaluation; got Tensor; make one with Evaluation.from_results",
        ),
        ({"_evaluate": lambda self, x, *, grad: None}, "must return an Evaluation; got NoneType"),
        (
            {"_evaluate": lambda self, x, *, grad: gs.Evaluation.from_results(x[:, 0], None)},
            r"must return gradients with grad=True; got none",
        ),
        ({"space": None}, "has no parameters; give the class a ParameterSpace as `space`"),
    ],
)
def test_what_a_class_lacks_is_said(what: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=f"^short.*{said}"):
        short_of(**what).evaluate(torch.zeros(2, 1))


def test_what_is_sampled_of_an_environment_keeps_its_unit_fidelity_and_options(tmp_path: Path) -> None:
    env = gs.make("bounce", fidelity="draft", device="cpu", ke=2e4)
    dataset = gs.sample(env, gs.Plane.through(env.space, env.space.center, [0, 1], resolution=3))
    identity = stored_identity(dataset)
    assert (identity["objective"], identity["fidelity"], identity["options"]["ke"]) == ("bounce", "draft", 2e4)
    assert dataset["loss"].attrs["units"] == "m²"
    dataset.to_zarr(tmp_path / "mine.zarr", consolidated=False)
    again = gs.open_slice(tmp_path / "mine.zarr").data
    assert again.attrs == dataset.attrs
    np.testing.assert_array_equal(again["grad"], dataset["grad"])
    function = gs.from_torch(lambda x: x[:, 0], env.space, name="first", loss_unit="m")
    named = gs.sample(function, gs.Plane.through(env.space, env.space.center, [0], resolution=3))
    assert (named.attrs["title"], named["loss"].attrs["units"]) == ("first over velocity x", "m")
