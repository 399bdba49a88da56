import numpy as np
import pytest
import xarray as xr

from gradscape.landscapes.draw.figures.search import run_figure
from gradscape.landscapes.objective import Status

KINDS = {"flag_values": [0, 1, 2, 3, 4], "flag_meanings": "random population descent acquisition policy"}


def table(loss: list[float], kind: list[int] | None = None, *, budget: int = 20, unit: str = "m") -> xr.Dataset:
    status = np.where(np.isfinite(loss), Status.OK, Status.ESCAPED).astype(np.int8)
    about = {"env": "hill", "method": "cma-es", "fidelity": "draft", "seed": 3, "budget": budget}
    return xr.Dataset(
        {
            "loss": ("evaluation", loss, {"units": unit}),
            "kind": ("evaluation", np.array(kind or [1] * len(loss), np.int8), KINDS),
            "status": ("evaluation", status),
            "episodes": ("evaluation", np.arange(1, len(loss) + 1)),
        },
        attrs=about | {"identity": '{"gradscape": "0"}', "provenance": "{}"},
    )


def drawn(figure, name: str):
    return next((line for line in figure.axes[0].lines if line.get_gid() == name), None)


def test_the_best_so_far_never_rises_and_ignores_failures():
    line = drawn(run_figure(table([np.nan, 5.0, 7.0, np.nan, 3.0, 4.0])), "best")
    np.testing.assert_array_equal(line.get_ydata(), [np.nan, 5, 5, 5, 3, 3])
    assert line.get_label() == "best so far: 3"


def test_every_episode_is_a_point_of_its_kind_or_a_failure():
    figure = run_figure(table([4.0, np.nan, 2.0, 3.0], [1, 1, 2, 1]))
    assert drawn(figure, "population").get_xdata().tolist() == [1, 4]
    assert drawn(figure, "descent").get_xdata().tolist() == [3]
    assert drawn(figure, "failed").get_xdata().tolist() == [2]
    assert drawn(figure, "failed").get_label() == "failed: 1 of 4"
    assert drawn(figure, "policy") is None


@pytest.mark.parametrize(("loss", "scale"), [([0.1, 9.0, 2.0], "log"), ([-0.1, 9.0], "linear"), ([5.0, 9.0], "linear")])
def test_losses_over_decades_get_a_logarithmic_axis(loss, scale):
    assert run_figure(table(loss)).axes[0].get_yscale() == scale


def test_outliers_leave_the_picture_and_are_counted():
    ax = run_figure(table([*np.linspace(1, 3, 300), 1e9])).axes[0]
    assert ax.get_ylim()[1] < 10
    assert any("1 above the picture" in line.get_label() for line in ax.lines)


def test_title_and_axes_say_what_is_shown():
    figure = run_figure(table([4.0, 2.0]))
    assert figure.get_suptitle() == "hill · draft · cma-es · seed 3 · 2 of 20 episodes so far"
    assert figure.axes[0].get_ylabel() == "loss [m]"
    assert figure.axes[0].get_xlabel() == "episodes"


def test_a_run_without_any_success_says_so():
    ax = run_figure(table([np.nan, np.nan])).axes[0]
    assert {line.get_label() for line in ax.lines} >= {"no episode has succeeded", "failed: 2 of 2"}
