"""An episode as one works with it in a notebook."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from gradscape.landscapes.episode import Episode, Part

AT = torch.tensor([[[0.0, 0.1, 0.0]], [[1.0, 0.3, 0.0]], [[2.0, 0.1, 0.5]]])
EPISODE = Episode(torch.tensor([0.0, 0.5, 1.0]), {"ball": AT}, parts=(Part("sphere", "rubber", AT, (0.1,)),))


@pytest.mark.drawn
def test_an_episode_shows_its_key_frames_in_a_notebook_without_pyplot() -> None:
    picture = EPISODE.show(keys=2)
    assert picture._repr_png_().startswith(b"\x89PNG")
    assert [ax.get_xlabel() for ax in picture.axes] == ["0 s", "1 s"]
    assert plt.get_fignums() == []


def test_an_episode_without_a_view_is_seen_whole_and_without_parts_says_so() -> None:
    with pytest.raises(ValueError, match="give Episode its `parts`"):
        Episode(EPISODE.time, EPISODE.points).show()
    view, every = EPISODE.viewpoint(), AT.reshape(-1, 3).numpy()
    assert (np.array(view.lower) < every.min(axis=0)).all()
    assert (np.array(view.upper) > every.max(axis=0)).all()
