"""At the corners of every box, and as far beyond as numbers go, an environment answers with a status or refuses."""

import pytest

from gradscape.envs.registry import entries

from ..envs.corners import OUTWARD, faults, small


@pytest.mark.nightly
@pytest.mark.parametrize("name", sorted(entries()))
def test_whatever_is_called_ok_at_corners_and_far_beyond_is_finite_and_was_simulated(name: str) -> None:
    assert list(faults(small(name), outward=OUTWARD, max_corners=16)) == []
