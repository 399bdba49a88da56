import numpy as np
import torch
from scipy.stats import kstest

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.base import Kind
from gradscape.optim.methods.random import RandomSearch
from gradscape.optim.search import search

SPACE = ParameterSpace(("a", "b"), torch.tensor([-3.0, 10.0]), torch.tensor([1.0, 30.0]), ("m", "s"))
FLAT = from_torch(lambda x: 0 * x.sum(dim=1), SPACE, name="flat")


def test_points_are_uniform_in_the_box_whatever_their_losses() -> None:
    table = search(FLAT, RandomSearch(SPACE, seed=1), budget=2000).dataset()
    u = SPACE.to_unit(torch.from_numpy(table["x"].values)).numpy()
    for axis in u.T:
        assert kstest(axis, "uniform").pvalue > 0.01
    assert abs(np.corrcoef(u.T)[0, 1]) < 0.05
    assert (table["kind"] == Kind.RANDOM).all()
