"""The census: what is cut, what is asked, and how variance and words are shared out."""

from collections import Counter

import numpy as np
import pytest
import torch

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.measures.census import (
    MEASURES,
    CensusDesign,
    bootstrap,
    divide,
    sample_cuts,
    spread,
    survey,
    thin_out,
    word_shares,
)
from gradscape.landscapes.objective import Evaluation, Objective, evaluate
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.space import ParameterSpace

BOX = ParameterSpace.box([f"x{n}" for n in range(5)], -1.0, 3.0)


class Bowl(Objective):
    """A bowl that nobody may ask beyond its box."""

    space = BOX
    asked = 0

    def evaluate(self, x: torch.Tensor, *, grad: bool = True) -> Evaluation:
        assert bool(((x >= BOX.lower) & (x <= BOX.upper)).all())
        self.asked += len(x)
        return Evaluation.from_results(x.square().sum(dim=1), 2 * x if grad else None)


def drawn(dim: int, slices: int, along: str = "pairs") -> CensusDesign:
    return CensusDesign.draw(
        ParameterSpace.box([f"x{n}" for n in range(dim)], -1.0, 3.0), slices, along=along, resolution=8, seed=1
    )


def test_two_cuts_go_through_every_point_and_none_is_drawn_twice() -> None:
    design, again = drawn(5, 18), drawn(5, 18)
    assert (len(design.bases), len(design.cuts)) == (9, 9)
    assert len({cut.dims for cut in design.cuts}) == 9
    assert len(set(design.places)) == 18
    assert [list(map(Counter(numbers).get, range(9))) for numbers in zip(*design.places, strict=True)] == [[2] * 9] * 2
    plane = design.plane(3, 2)
    assert plane.lower.tolist() == [-1.0, -1.0]
    held = [k for k in range(5) if k not in (design.cuts[2].dims or ())]
    assert plane.origin[held].tolist() == design.bases[3][held].tolist()
    assert torch.equal(again.bases, design.bases)
    assert again.cuts == design.cuts


def test_few_pairs_leave_more_points_and_two_parameters_one_slice() -> None:
    three, two = drawn(3, 16), drawn(2, 16)
    assert (len(three.bases), len(three.cuts)) == (8, 3)
    assert len(set(three.places)) == 16
    assert (len(two.bases), len(two.cuts)) == (1, 1)
    assert [len(drawn(5, slices).places) for slices in (1, 2, 3, 4)] == [1, 2, 2, 4]
    with pytest.raises(ValueError, match="needs at least two parameters"):
        drawn(1, 16)
    with pytest.raises(ValueError, match="along pairs or random; got 'rows'"):
        drawn(5, 16, "rows")


def test_random_directions_are_orthonormal_in_widths_of_the_box_and_nothing_is_asked_outside() -> None:
    space = ParameterSpace({f"x{n}": (0.0, 10.0**n, "m") for n in range(4)})
    design = CensusDesign.draw(space, 9, along="random", resolution=8, seed=0)
    for cut in range(3):
        unit = design.plane(0, cut).basis / (space.upper - space.lower)
        torch.testing.assert_close(unit @ unit.T, torch.eye(2, dtype=torch.float64))
    bowl = Bowl()
    planes = CensusDesign.draw(BOX, 9, along="random", resolution=8, seed=0)
    found = survey(bowl, [planes.plane(*place) for place in planes.places], deviation=0.0, seed=0)
    outside = sum(np.isnan(one.loss).sum() for one in found)
    assert 0 < outside < 8 * 64
    assert bowl.asked == sum(one.episodes for one in found)


@pytest.mark.parametrize("along", ["pairs", "random"])
@pytest.mark.parametrize("gradients", [1, 2, 3])
def test_a_slice_holds_the_bits_of_its_points_evaluated_in_a_row(along: str, gradients: int) -> None:
    objective = from_torch(lambda x: (7 * x).sin().prod(dim=1) + x.exp().sum(dim=1), BOX)
    design = CensusDesign.draw(BOX, 4, along=along, resolution=19, seed=0, gradients=gradients)
    plane = design.plane(1, 1)
    (found,), grid = sample_cuts(objective, [plane], gradients=gradients), plane.grid()
    wanted = evaluate(objective, grid.reshape(-1, 5), grad=True)
    slopes = torch.full_like(grid, torch.nan)
    slopes[::gradients, ::gradients] = wanted.grad.reshape(grid.shape)[::gradients, ::gradients]
    assert found["loss"].to_numpy().tobytes() == wanted.loss.numpy().tobytes()
    np.testing.assert_array_equal(found["grad"], slopes)
    assert bool(wanted.loss.isnan().any()) == (along == "random")  # beyond the box
    assert bool(found["grad"].notnull().any())


def test_every_second_sample_is_what_half_the_resolution_would_sample() -> None:
    planes = [Plane.through(BOX, BOX.center, (0, 3), resolution=resolution) for resolution in (9, 5, 8)]
    odd, wanted, even = (sample_cuts(Bowl(), [plane])[0] for plane in planes)
    for name in ("loss", "grad"):
        np.testing.assert_allclose(thin_out(odd)[name], wanted[name])
    np.testing.assert_allclose(thin_out(even)["loss"], even["loss"][::2, ::2])


def test_a_bowls_slices_are_very_smooth_with_good_gradients() -> None:
    design = CensusDesign.draw(BOX, 4, along="pairs", resolution=12, seed=0)
    found = survey(Bowl(), [design.plane(*place) for place in design.places], deviation=0.0, seed=0)
    assert {one.words for one in found} == {("very smooth", "gradients follow")}
    assert all(one.measures[MEASURES.index("cosine")] > 0.99 for one in found)
    assert len({one.measures[MEASURES.index("notable minima")] for one in found}) == 1


@pytest.mark.parametrize(("many", "through"), [(40, 2), (8, 8)])
def test_variance_is_shared_out_as_it_was_put_in(many: int, through: int) -> None:
    """Rows of variance 4, columns of 1, the rest of 0.25, and a noise of 0.25 between the two resolutions."""
    draw = np.random.default_rng(0)
    places = [(row, (row + k) % many) for row in range(many) for k in range(through)]
    parts = []
    for _ in range(300):
        rows, columns = 2 * draw.standard_normal(many), draw.standard_normal(many)
        values = np.array([rows[row] + columns[column] for row, column in places])
        values += 0.5 * draw.standard_normal(len(places))
        halved = values + np.sqrt(0.5) * draw.standard_normal(len(values))
        parts.append(divide(values, halved, {9: float(values[9]) + 1.0}, places))
    assert np.mean([one.base for one in parts]) == pytest.approx(4 / 5.25, abs=0.06)
    assert np.mean([one.cut for one in parts]) == pytest.approx(1 / 5.25, abs=0.06)
    assert all(one.base + one.cut + one.both == pytest.approx(1) for one in parts)
    assert np.median([one.resolution for one in parts]) == pytest.approx(0.25 / 5.25, abs=0.02)
    flat = divide(0.6 + 1e-14 * draw.standard_normal(3), np.ones(3), {}, places[:3])
    assert np.isnan(flat.base)  # of rounding


def test_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    """Words that go with the point: of 8 points there are 8 independent draws, not 64."""
    draw, places = np.random.default_rng(0), [(base, cut) for base in range(8) for cut in range(8)]
    held, drawn = 0, bootstrap(places, seed=0)
    for _ in range(200):
        rugged = draw.random(8) < 0.5
        words = [("rugged",) if rugged[base] else () for base, _ in places]
        share = word_shares(words, places, (False, False))["rugged"]
        held += share.low <= 0.5 <= share.high
    assert held >= 190  # the exact interval is never short
    found = spread(np.arange(64.0), drawn)
    assert found.quantiles[2] == found.median.value == pytest.approx(31.5)
    assert found.median.low < 31.5 < found.median.high


def test_all_slices_and_none_have_an_interval_and_flat_ones_do_not_count() -> None:
    places = [(base, cut) for base in range(4) for cut in range(4)]
    words = [("flat",) if base == 0 else ("rugged",) for base, _ in places]
    shares = word_shares(words, places, (False, False))
    assert (shares["rugged"].value, shares["rugged"].high) == (1.0, 1.0)
    assert shares["rugged"].low < 0.8  # 12 slices of three base points tell less than 12 points
    assert (shares["very smooth"].low, shares["flat"].value) == (0.0, 0.25)
    assert shares["very smooth"].high > 0.2
    assert np.isnan(word_shares(words, places, (True, True))["rugged"].low)  # they are all that there are
    assert np.isnan(word_shares([("flat",)] * 16, places, (False, False))["rugged"].value)
    one = word_shares([("rugged",)] * 4, [(base, 0) for base in range(4)], (False, True))["rugged"]
    assert one.low == pytest.approx(0.398, abs=1e-3)  # Clopper and Pearson's for 4 of 4


def test_cuts_of_which_there_are_no_others_are_not_drawn_again() -> None:
    places = [(base, cut) for base in range(6) for cut in range(3)]
    drawn = bootstrap(places, seed=0, exhausted=(False, True)).reshape(-1, 6, 3)
    assert (drawn == drawn[:, :, :1]).all()
    assert drawn[:, :, 0].std() > 0


def test_the_median_of_a_resample_is_numpys() -> None:
    """Of values of which some are equal, in resamples with many, one or none of them."""
    draw = np.random.default_rng(0)
    for values in (draw.standard_normal(7), draw.integers(3, size=8).astype(float), np.array([2.0])):
        drawn = draw.integers(3, size=(99, len(values)))
        medians = [np.median(np.repeat(values, counts)) for counts in drawn if counts.any()]
        found = spread(values, drawn).median
        assert (found.low, found.high) == pytest.approx(tuple(np.quantile(medians, [0.025, 0.975])), rel=1e-12)
