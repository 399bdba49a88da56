"""Which nodes' episodes the gallery shows."""

import numpy as np
import torch

from gradscape.envs.adapters import from_numpy
from gradscape.gallery.parts import choose_nodes
from gradscape.gallery.records import Node
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace

SPACE = ParameterSpace.box(["x", "y"], -1.0, 1.0)


def shown(function, dims=(0, 1), at=(0.0, 0.0), resolution=9) -> list[Node]:  # type: ignore[no-untyped-def]
    through = torch.tensor(at).double()
    plane = Plane.through(SPACE, through, dims, resolution=resolution)
    return choose_nodes(sample(from_numpy(function, SPACE), plane, gradients=0), through)


def test_nodes_are_the_extremes_the_median_and_the_slices_own_point() -> None:
    def tilted(x: np.ndarray) -> np.ndarray:
        return np.where(x[:, 1] > 0.9, np.nan, x[:, 0] + 10 * x[:, 1])

    nodes = shown(tilted, at=(0.5, -0.5))
    found = {node.why: (node.row, node.column, node.loss) for node in nodes}
    assert found["lowest loss"] == (0, 0, -11.0)
    assert found["highest loss"] == (7, 8, 8.5)  # the row above failed
    assert found["through the slice's point"] == (2, 6, -4.5)
    values = sorted(u + 10 * v for u in np.linspace(-1, 1, 9) for v in np.linspace(-1, 0.75, 8))
    assert found["median loss"][2] == values[36]
    assert {node.status for node in nodes} == {"OK"}


def test_a_point_that_failed_is_shown_as_failed_and_no_node_twice() -> None:
    nodes = shown(lambda x: np.full(len(x), np.nan), resolution=5)
    assert [(node.row, node.column, node.loss, node.status) for node in nodes] == [(2, 2, None, "NONFINITE")]


def test_a_lines_nodes_are_in_row_0() -> None:
    nodes = shown(lambda x: x[:, 1], dims=(1,), at=(0.0, 0.6), resolution=5)
    assert {(node.row, node.column, node.why) for node in nodes} == {
        (0, 0, "lowest loss"), (0, 4, "highest loss"), (0, 2, "median loss"), (0, 3, "through the slice's point"),
    }  # fmt: skip
