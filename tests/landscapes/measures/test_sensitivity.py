"""Pairs of parameters: indices against closed forms, and the pair that matters found among others."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from gradscape.envs.adapters import from_numpy, from_torch
from gradscape.landscapes.measures.sensitivity import Design, Responses, default_samples, explore, rank
from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.checkpoint import Checkpoint


def found_in(
    fn: Callable[[Tensor], Tensor], dim: int, folder: Path, *, samples: int = 64, half: float = 1.0
) -> Responses:
    space = ParameterSpace.box([f"x{k}" for k in range(dim)], -half, half)
    return explored(from_torch(fn, space), folder, samples=samples)


def explored(objective: Objective, folder: Path, *, samples: int) -> Responses:
    design = Design.sobol(objective.space, samples, seed=0)
    checkpoint = Checkpoint.open(folder, {"samples": samples}, what="pairs")
    return explore(objective, design, checkpoint)


def test_ishigamis_indices_are_the_closed_ones(tmp_path: Path) -> None:
    """Ishigami & Homma 1990, a = 7, b = 0.1: totals 0.558, 0.442, 0.244, and x0 and x2 act together (0.244)."""

    def ishigami(x: Tensor) -> Tensor:
        return x[:, 0].sin() + 7 * x[:, 1].sin() ** 2 + 0.1 * x[:, 2] ** 4 * x[:, 0].sin()

    found = found_in(ishigami, 3, tmp_path, samples=1024, half=math.pi)
    np.testing.assert_allclose(found.total(), [0.558, 0.442, 0.244], atol=0.05)
    interaction = dict(zip(found.pairs, found.interaction(), strict=True))
    assert interaction[0, 2] == pytest.approx(0.244, abs=0.05)
    assert interaction[0, 1] < 1e-9
    assert interaction[1, 2] < 1e-9


def test_the_pair_that_matters_is_first(tmp_path: Path) -> None:
    """A product of x1 and x4 over a faint bowl of all."""
    found = found_in(lambda x: 3 * x[:, 1] * x[:, 4] + 0.05 * x.square().sum(dim=1), 6, tmp_path)
    rows = rank(found)
    by_interaction = max(rows, key=lambda row: row.interaction)
    assert rows[0].dims == by_interaction.dims == (1, 4)
    assert by_interaction.interaction == pytest.approx(1, abs=0.2)
    assert {row.dims for row in rows} == {(i, j) for i in range(6) for j in range(i + 1, 6)}


def test_the_rugged_pair_is_found_where_others_are_more_sensitive(tmp_path: Path) -> None:
    """Rastrigin's ripples along x1 and x3, slopes along the others; gradients of ripples mislead at a visible scale."""

    def ripples(x: Tensor) -> Tensor:
        return 3 * x[:, [0, 2, 4]].sum(dim=1) - (20 * math.pi * x[:, [1, 3]]).cos().sum(dim=1)

    found = found_in(ripples, 5, tmp_path)
    rows = rank(found)
    assert max(rows, key=lambda row: row.ruggedness).dims == (1, 3)
    assert max(rows, key=lambda row: row.disagreement).dims == (1, 3)
    assert max(rows, key=lambda row: row.sensitivity).dims in ((0, 2), (0, 4), (2, 4))
    smooth = [axis for axis in (0, 2, 4) if found.ruggedness()[axis] > 1e-9]
    assert not smooth


def test_disagreement_is_none_on_a_line_and_whole_where_gradients_are_zero_or_opposite(tmp_path: Path) -> None:
    slope = np.array([1.0, 2.0, 3.0])

    def wrong(x: Any) -> Any:
        return x @ slope, np.tile(slope * [1, 0, -1], (len(x), 1))

    found = explored(from_numpy(wrong, ParameterSpace.box("abc", -1.0, 1.0)), tmp_path, samples=4)
    apart, size = found.slopes()
    np.testing.assert_allclose(apart / size, [0, 1, 1], atol=1e-9)


def test_many_parameters_are_affordable() -> None:
    """Episodes grow with the parameters, not with their square, and base points are fewer."""
    for dim, samples in ((2, 16), (15, 16), (45, 7), (90, 4), (400, 4)):
        assert default_samples(dim) == samples
        design = Design.sobol(ParameterSpace.box([str(k) for k in range(dim)], 0, 1), 4, seed=0)
        assert design.episodes == 4 * (1 + 5 * dim + min(dim, 8) * (min(dim, 8) - 1) // 2)


def test_lines_stay_within_the_box_and_hold_their_base_point() -> None:
    design = Design.sobol(ParameterSpace.box("abc", 0, 1), 64, seed=0)
    places = design.base[:, :, None] + design.offsets
    assert places.min() >= 0
    assert places.max() <= 1
    whole = np.sort(np.concatenate([places, design.base[:, :, None]], axis=2), axis=2)
    np.testing.assert_allclose(np.diff(whole, axis=2), 0.025, atol=1e-12)
    inner = (design.base > 0.05) & (design.base < 0.95)
    np.testing.assert_allclose(design.offsets[inner], np.tile([-0.05, -0.025, 0.025, 0.05], (inner.sum(), 1)))


class Counted(Objective):
    """A bowl that counts its episodes, may be stopped after some of them, and fails at a corner if asked."""

    preferred_batch = 8
    space = ParameterSpace.box("abc", -1.0, 1.0)

    def __init__(self, stop: float = math.inf, corner: float = math.inf) -> None:
        self.count, self.stop, self.corner = 0, stop, corner

    def evaluate(self, x: Tensor, *, grad: bool = True) -> Evaluation:
        if self.count >= self.stop:
            raise KeyboardInterrupt
        self.count += len(x)
        raw = from_torch(lambda x: (x * x.new_tensor([1.0, 2.0, 3.0])).square().sum(dim=1), self.space).evaluate(
            x, grad=grad
        )
        return Evaluation.from_results(raw.loss.masked_fill(x[:, 0] > self.corner, torch.nan), raw.grad)


def test_a_stopped_study_goes_on_to_the_same_result(tmp_path: Path) -> None:
    whole, first, second = Counted(), Counted(stop=60), Counted()
    expected = rank(explored(whole, tmp_path / "whole", samples=6))
    with pytest.raises(KeyboardInterrupt):
        explored(first, tmp_path / "stopped", samples=6)
    assert rank(explored(second, tmp_path / "stopped", samples=6)) == expected
    assert whole.count == Design.sobol(Counted.space, 6, seed=0).episodes
    assert 0 < whole.count - second.count <= first.count


def test_failed_episodes_are_counted_and_left_out(tmp_path: Path) -> None:
    found = explored(Counted(corner=0.8), tmp_path, samples=16)
    assert found.failed > 0
    assert np.isfinite(found.total()).all()
    assert all(np.isfinite(row.ruggedness) for row in rank(found))
