"""Films and scenes of a sweep, and the smoothing of a slice."""

import io
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray
from imageio_ffmpeg import get_ffmpeg_exe
from matplotlib.collections import QuadMesh
from matplotlib.quiver import Quiver
from rerun.chunk import RrdReader

from gradscape.landscapes.draw.figures.sweep import Scales, Sweep, frame_figure, save_films
from gradscape.landscapes.draw.film import picture, save_film
from gradscape.landscapes.draw.recordings.runs import save_sweep
from gradscape.landscapes.objective import Evaluation, Objective, Status
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.smoothing import smooth
from gradscape.landscapes.space import ParameterSpace

SPACE = ParameterSpace.box(("a", "b", "c"), -1.0, 1.0, "m")
VALUES = (-1.0, -0.25, 0.5, 1.25)


class Bowl(Objective):
    """Move its minimum along a with c, grow with it, and fail in a corner."""

    space = SPACE
    name = "bowl"
    beyond_box = True  # where c is 1.25

    def evaluate(self, x, *, grad=True):
        away = torch.stack([x[:, 0] - x[:, 2], x[:, 1]], dim=1)
        loss = 1 + x[:, 2] + away.square().sum(dim=1)
        loss[(x[:, :2] > 0.6).all(dim=1)] = torch.nan
        slope = torch.cat([2 * away, 1 - 2 * away[:, :1]], dim=1)
        return Evaluation.from_results(loss, slope if grad else None)


def plane(value: float) -> Plane:
    return Plane.through(SPACE, torch.tensor([0.0, 0.0, value]), ("a", "b"), resolution=9)


SWEEP = Sweep("c [m]", VALUES, [sample(Bowl(), plane(value)) for value in VALUES])


def frames(path: Path) -> np.ndarray:
    """Decode a film, shape (frames, height, width, 3)."""
    command = [get_ffmpeg_exe(), "-v", "error", "-i", str(path), "-fps_mode", "passthrough", "-f", "image2pipe"]
    raw = subprocess.run([*command, "-c:v", "ppm", "-"], capture_output=True, check=True).stdout
    found, stream = [], io.BytesIO(raw)
    while stream.readline():
        width, height = map(int, stream.readline().split())
        stream.readline()
        found.append(np.frombuffer(stream.read(width * height * 3), np.uint8).reshape(height, width, 3))
    return np.stack(found)


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("films")
    save_films(SWEEP, folder / "sweep.mp4", folder / "sweep.gif")
    return folder / "sweep.mp4", folder / "sweep.gif"


def test_all_frames_have_the_scales_of_all_slices_together() -> None:
    scales = Scales.of(SWEEP)
    losses = np.stack([one["loss"].to_numpy() for one in SWEEP.slices])
    for number in range(len(VALUES)):
        _, loss, slope = frame_figure(SWEEP, number, scales).axes[:3]
        (mesh,) = (one for one in loss.collections if isinstance(one, QuadMesh))
        (arrows,) = (one for one in slope.collections if isinstance(one, Quiver))
        assert (mesh.norm.vmin, mesh.norm.vmax) == (np.nanmin(losses), np.nanmax(losses))
        np.testing.assert_array_equal(mesh.get_array(), np.ma.masked_invalid(losses[number]))
        assert arrows.norm is scales.slope.norm


def test_nothing_moves_from_frame_to_frame_but_the_mark_at_the_value() -> None:
    like = frame_figure(SWEEP, 1, Scales.of(SWEEP))
    figures = [like, *(frame_figure(SWEEP, number, Scales.of(SWEEP), like=like) for number in (0, 2))]
    for figure in figures:
        figure.canvas.draw()
    first, *later = ([(*ax.get_position().bounds, *ax.bbox.bounds) for ax in figure.axes] for figure in figures)
    for places in later:
        np.testing.assert_allclose(places, first)
    (bar,) = (ax for ax in figures[2].axes if ax.get_gid() == "range")
    assert (bar.get_xlim(), bar.lines[-1].get_xdata()) == ((-1.0, 1.25), [0.5])
    assert [text.get_text() for text in bar.texts] == ["−1.00 m", "1.25 m", "c = 0.50 m"]


@pytest.mark.slow
def test_each_frame_of_both_films_is_the_picture_of_its_slice(films: tuple[Path, Path]) -> None:
    scales = Scales.of(SWEEP)
    like = frame_figure(SWEEP, 0, scales)
    wanted = [picture(frame_figure(SWEEP, k, scales, like=like), dpi=120).astype(float) for k in range(len(VALUES))]
    for film in films:
        shown = frames(film).astype(float)
        assert len(shown) == len(VALUES)
        step = wanted[0].shape[1] / shown.shape[2]
        rows, columns = (np.arange(size) * step for size in shown.shape[1:3])
        small = [one[np.ix_(rows.astype(int), columns.astype(int))] for one in wanted]
        apart = [[np.abs(one - other).mean() for other in small] for one in shown]
        assert np.argmin(apart, axis=1).tolist() == list(range(len(VALUES)))


def test_a_film_that_cannot_be_written_says_why_and_leaves_nothing(tmp_path: Path) -> None:
    odd = np.zeros((1, 1, 3), np.uint8)
    with pytest.raises(OSError, match="ffmpeg could not write"):
        save_film([odd], tmp_path / "a.mp4", tmp_path / "a.gif", count=1, rate=2)
    assert not list(tmp_path.iterdir())


def test_the_scene_has_a_surface_for_each_value_on_a_timeline_of_that_name(tmp_path: Path) -> None:
    save_sweep(SWEEP, tmp_path / "sweep.rrd")
    rows = {"/landscape/surface": [], "/landscape/value": [], "/lowest": []}
    for chunk in RrdReader(tmp_path / "sweep.rrd").stream().to_chunks():
        if chunk.entity_path in rows:
            table = chunk.to_record_batch().to_pydict()
            assert not {"log_time", "log_tick"} & set(table)
            rows[chunk.entity_path] += [dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)]
    for path, held in rows.items():
        assert [row["c"] for row in held] == [0, 1, 2, 3], path
    low = [row["Scalars:scalars"][0] for row in rows["/lowest"]]
    np.testing.assert_allclose(low, [float(one["loss"].min()) for one in SWEEP.slices])
    assert rows["/landscape/value"][1]["Points3D:labels"] == ["c = −0.25 m"]
    vertices = [np.array(row["Mesh3D:vertex_positions"]) for row in rows["/landscape/surface"]]
    loss = SWEEP.slices[2]["loss"].to_numpy()
    tops = vertices[2][: 4 * np.isfinite(loss).sum()].reshape(-1, 4, 3)  # come first, a sample after the other
    bottom = np.flatnonzero(np.isfinite(loss).ravel())[np.argmin(tops[:, 0, 2])]
    assert bottom == np.nanargmin(loss)
    assert vertices[0].shape != vertices[3].shape or not np.allclose(vertices[0], vertices[3])


def test_smoothing_keeps_a_constant_and_averages_no_value_that_is_not_there() -> None:
    dataset = SWEEP.slices[1]
    constant = dataset.assign(loss=dataset["loss"].copy(data=np.where(np.isfinite(dataset["loss"]), 3.0, np.nan)))
    np.testing.assert_allclose(smooth(constant, 0.2)["loss"], constant["loss"], rtol=1e-14)
    soft = smooth(dataset, 0.1)
    assert (np.isnan(soft["loss"]) == (dataset["status"] != Status.OK)).all()
    assert float(dataset["loss"].min()) < float(soft["loss"].min())
    assert float(soft["loss"].max()) < float(dataset["loss"].max())
    assert "grad" not in soft
    xarray.testing.assert_equal(smooth(dataset, 0.0)["loss"], dataset["loss"])


def test_smoothing_is_a_gaussian_of_that_share_of_each_side() -> None:
    wide = Plane.through(SPACE, SPACE.center, ("a", "b"), resolution=(41, 61), window=((-1.0, -3.0), (1.0, 3.0)))
    dataset = sample(Bowl(), wide, gradients=0)
    u, v = np.meshgrid(dataset["u"], dataset["v"])
    ok = np.full(u.shape, Status.OK, dataset["status"].dtype)
    dataset = dataset.assign(loss=dataset["loss"].copy(data=u**2 + v**2), status=dataset["status"].copy(data=ok))
    middle = smooth(dataset, 0.05)["loss"].sel(u=0.0, v=0.0, method="nearest")
    assert float(middle) == pytest.approx((0.05 * 2) ** 2 + (0.05 * 6) ** 2, rel=1e-6)  # of variances


def test_smoothing_refuses_a_negative_width() -> None:
    with pytest.raises(ValueError, match="width of at least 0; got -1"):
        smooth(SWEEP.slices[0], -1.0)
