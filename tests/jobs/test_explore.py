"""An exploration: pictures that grow finer, descents, what is kept, and errors that are said."""

import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.jobs.explore import SIDE, Exploration, Look, Seen
from gradscape.landscapes.draw.pages.nodes import read_off_nodes
from gradscape.landscapes.objective import Status

BOX = gs.ParameterSpace({"a": (-1, 2, "N"), "b": gs.log(1e-3, 1e3), "c": (0, 4)})


def valley(x: torch.Tensor) -> torch.Tensor:
    a, b, c = x.T
    return (a - 0.5) ** 2 + (b.log10() - 1) ** 2 + (c - 3) ** 2


@pytest.fixture
def exploration(tmp_path: Path) -> Iterator[Exploration]:
    env = gs.from_torch(valley, BOX, name="valley")
    made = Exploration(env, ("a", "b"), "landscape explore my.py:valley --port 0 --dims a b --set k=3", tmp_path)
    yield made
    made.close()


def finished(one: Exploration) -> Seen:
    """Return the last picture of where somebody looks."""
    seen = one.wait(-1)
    while not seen.complete:
        seen = one.wait(seen.number)
    return seen


def test_the_last_picture_is_the_slice_bit_for_bit(exploration: Exploration) -> None:
    seen = finished(exploration)
    wanted = gs.sample(exploration.env, exploration.plane(exploration.look))
    assert seen.slice is not None
    for name in ("loss", "grad"):
        np.testing.assert_array_equal(seen.slice[name], wanted[name])
    assert seen.slice.sizes == {"v": SIDE, "u": SIDE, "dim": 3}


def test_a_growing_picture_draws_what_is_nearest_and_says_what_is_not_sampled(exploration: Exploration) -> None:
    whole = finished(exploration).slice
    assert whole is not None
    part = whole.copy(deep=True)
    part["loss"][:, ::2], part["status"][:, ::2] = np.nan, Status.MISSING
    nodes, refined = read_off_nodes(part, growing=True), read_off_nodes(part)
    assert nodes["cells"] is not None
    assert nodes["looks"] != nodes["status"]
    assert refined["cells"] is None


def test_who_moves_sees_the_plane_through_the_new_point(exploration: Exploration) -> None:
    exploration.turn(Look((2, 0), (0.5, 0.25, 0.5)))
    seen = finished(exploration)
    assert seen.slice is not None
    loss = float(seen.slice["loss"].min())
    assert loss == pytest.approx((np.log10(valley_b := 10 ** (-3 + 0.25 * 6)) - 1) ** 2, abs=0.02), valley_b


@pytest.mark.parametrize("everywhere", [False, True])
def test_a_descent_ends_in_the_minimum_of_what_it_may_move(exploration: Exploration, everywhere: bool) -> None:
    finished(exploration)
    found = exploration.descend([0.1, 0.9, 0.25], everywhere=everywhere)
    assert found.best == pytest.approx(0.0 if everywhere else 4.0, abs=1e-6)
    assert found.end == pytest.approx([0.5, 4 / 6, 0.75 if everywhere else 0.25], abs=1e-3)
    assert found.run.episodes < 60
    assert found.run.label == f"descent 1 over {'all parameters' if everywhere else 'the two shown'}"


def test_a_function_has_no_film_and_says_so(exploration: Exploration) -> None:
    assert exploration.film([0.5, 0.5, 0.5]).said == "valley has no episodes to draw"


def test_what_is_kept_is_a_slice_and_its_command_makes_it_again(exploration: Exploration, tmp_path: Path) -> None:
    exploration.turn(Look((0, 1), (0.5, 0.5, 0.125)))
    kept = exploration.keep()
    words = shlex.split(kept.command)
    assert words[:5] == ["landscape", "slice", "my.py:valley", "--set", "k=3"]
    assert "--port" not in words
    dataset = gs.open_slice(kept.folder).data
    through = Path(words[words.index("--through") + 1])
    assert np.loadtxt(through)[2] == 0.5
    assert words[-2:] == ["--resolution", str(SIDE)]
    assert dataset["loss"].shape == (SIDE, SIDE)
    assert (Path(kept.folder) / "landscape.png").exists()
    exploration.turn(Look((0, 1), (0.1, 0.2, 0.5)))
    assert "--through center" in exploration.keep().command


def test_an_error_of_the_simulator_is_said_and_another_look_goes_on(tmp_path: Path) -> None:
    def broken(x: torch.Tensor) -> torch.Tensor:
        if bool((x[:, 1] > 2).all()):
            raise RuntimeError("diverged at step 7")
        return x.square().sum(dim=1)

    box = gs.ParameterSpace({"a": (-1, 1), "b": (0, 4), "c": (-1, 1)})
    exploration = Exploration(gs.from_torch(broken, box), ("a", "c"), "", tmp_path)
    assert not finished(exploration).error
    exploration.turn(Look((0, 2), (0.5, 0.9, 0.5)))
    assert "diverged at step 7" in finished(exploration).error
    exploration.turn(Look((0, 2), (0.5, 0.1, 0.5)))
    assert not finished(exploration).error
    exploration.close()


@pytest.mark.parametrize(
    ("look", "said"),
    [
        (Look((0, 0), (0.5,) * 3), "explore varies two different parameters"),
        (Look((0, 3), (0.5,) * 3), "two different parameters of 3"),
        (Look((0, 1), (0.5,) * 2), "a point has 3 numbers from 0 to 1"),
        (Look((0, 1), (0.5, 0.5, float("nan"))), "a point has 3 numbers from 0 to 1"),
    ],
)
def test_what_is_no_place_is_refused(exploration: Exploration, look: Look, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        exploration.turn(look)


def test_a_function_of_one_parameter_is_refused(tmp_path: Path) -> None:
    one = gs.from_torch(lambda x: x[:, 0], gs.ParameterSpace({"a": (0, 1)}))
    with pytest.raises(ValueError, match="takes an environment with at least two parameters"):
        Exploration(one, (0,), "", tmp_path)
