"""Pictures of episodes: they show what happens, where it happens."""

import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from matplotlib.image import imread

from gradscape.envs.base import Environment
from gradscape.envs.mpm.fluid import TANK_HEIGHT, TANK_WIDTH
from gradscape.envs.outlines import rotate_about, skin, triangles
from gradscape.envs.registry import BUILTIN, make
from gradscape.landscapes.draw.figures.contact import Caption, episode_figure, save_sheet
from gradscape.landscapes.draw.render import solids
from gradscape.landscapes.draw.render.replay import (
    Shot,
    add_title,
    axes,
    frames,
    missed_surface,
    outside,
    save_replay,
    tracked_parts,
)
from gradscape.landscapes.draw.render.solids import lump, mesh
from gradscape.landscapes.episode import Episode, Part, View

pytestmark = pytest.mark.slow

SCENES = [entry.name for entry in BUILTIN if "functions" not in entry.target]
SMALL = 120  # height of a test's pictures [pixel]


@cache
def scene(name: str, *, horizon: float = 1.0) -> tuple[Environment, Episode]:
    env = make(name, device="cpu", horizon=horizon)  # at its cheapest fidelity
    x = env.example(next(iter(env.examples))) if env.examples else env.space.center
    return env, env.episode(x)


def still(part: Part, low: float = -1.0, high: float = 1.0) -> Episode:
    return Episode(torch.zeros(1), {}, {}, (part,), View((low,) * 3, (high,) * 3, eye=(0.0, 0.0, 1.0), ground=None))


def tinted(picture: np.ndarray, color: str) -> np.ndarray:
    """Return which pixels are more of one hue than of the others."""
    red, green, blue = picture.astype(float).transpose(2, 0, 1)
    return {"orange": (red > 1.3 * green) & (green > 1.2 * blue), "blue": (blue > 1.15 * red) & (blue > green)}[color]


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_says_what_it_looks_like_and_is_drawn(name: str) -> None:
    _, episode = scene(name, horizon=0.2)
    assert episode.view is not None
    assert all(len(part.at) == len(episode.time) for part in episode.parts)
    (picture,) = frames(episode, [len(episode.time) - 1], height=SMALL)
    assert picture.shape[0] == SMALL
    assert (picture.min(axis=2) < 200).mean() > 0.01, "blank"
    assert (picture[SMALL // 4 : -SMALL // 4].min(axis=2) < 200).any(), "nothing in the middle"


def test_a_ball_that_has_left_the_picture_is_named_as_long_as_it_is_away() -> None:
    ball = Part("sphere", "rubber", torch.tensor([[[x, 0.0, 0.0]] for x in (0.0, 1.1, 2.0, 0.5)]), (0.1,))
    view = View((-1.0,) * 3, (1.0,) * 3, eye=(0.0, 0.0, 1.0), ground=None)
    episode = Episode(torch.arange(4.0), {}, {}, (ball, replace(ball, material="target")), view)
    shot = Shot.of(view, SMALL)
    assert [outside(tracked_parts(episode.parts), shot, frame) for frame in range(4)] == [[], [], ["ball"], []]
    seen = [picture[: SMALL // 5] for picture in frames(episode, range(4), height=SMALL)]
    assert [bool((one.min(axis=2) < 200).any()) for one in seen] == [False, False, True, False]


def test_the_scooped_cube_rises_and_the_syrup_stays_in_the_tank() -> None:
    _, episode = scene("fluid")
    first, last = frames(episode, [0, len(episode.time) - 1], height=200)
    heights = [np.flatnonzero(tinted(picture, "orange").any(axis=1)).mean() for picture in (first, last)]
    assert heights[1] < heights[0] - 20  # rows count downwards
    view = episode.view
    right, _, _ = axes(view)
    half = TANK_WIDTH / 2
    reach = max(abs(np.array([x, 0, z]) @ right) for x in (-half, half) for z in (-half, half))
    rows, columns = np.nonzero(tinted(first, "blue"))
    scale = 200 / np.ptp(_corners(view) @ axes(view)[1])
    assert len(rows) > 2000
    assert np.abs(columns - first.shape[1] / 2).max() < 1.1 * scale * reach
    assert view.upper[1] > TANK_HEIGHT


def pixel(view: View, point: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the column and row of a point through a pinhole that sees the view's box whole, with 6 % to spare."""
    right, up, eye = axes(view)
    corners, center = _corners(view), (np.array(view.lower) + view.upper) / 2
    tangent = np.tan(np.radians(solids.ANGLE) / 2)
    half = max(np.ptp(corners @ up), np.ptp(corners @ right) * shape[0] / shape[1]) / 2
    distance = 1.06 * half / tangent + np.ptp(corners @ eye) / 2 - (point - center) @ eye
    scale = shape[0] / 2 / (distance * tangent)
    return np.array([shape[1] / 2 + scale * (point - center) @ right, shape[0] / 2 - scale * (point - center) @ up])


@pytest.mark.parametrize("name", ["bounce", "pinball-2", "cartpole"])
def test_a_ball_is_seen_where_the_episode_has_it(name: str) -> None:
    _, episode = scene(name)
    (ball,) = [part for part in episode.parts if (part.shape, part.material) == ("sphere", "rubber")]
    chosen = np.linspace(0, len(episode.time) - 1, 4).round().astype(int).tolist()
    view = episode.view
    for frame, picture in zip(chosen, frames(replace(episode, parts=(ball,)), chosen, height=300), strict=True):
        red, green, _ = picture.astype(float).transpose(2, 0, 1)
        rows, columns = np.nonzero(red > 1.8 * green)
        middle = np.array([(columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2])
        wanted = pixel(view, ball.at[frame, 0].numpy(), picture.shape)
        assert np.abs(middle - wanted).max() < 2.0, (frame, middle, wanted)


def cube(low: float, high: float) -> torch.Tensor:
    axis = torch.linspace(low, high, 12, dtype=torch.float64)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(1, -1, 3)


def test_a_target_of_particles_is_drawn_where_the_body_is_not_yet_and_alone_at_the_end(tmp_path: Path) -> None:
    shift = torch.tensor([1.1, 0.0, 0.0], dtype=torch.float64)
    body, goal = torch.cat([cube(-0.9, -0.1), cube(-0.9, -0.1) + shift]), cube(-0.9, -0.1) + shift
    parts = (
        Part("lump", "plasticine", body, (0.8 / 11,)),
        Part("lump", "target", goal.expand(2, -1, -1), (0.8 / 11,)),
    )
    episode = replace(still(parts[0]), time=torch.arange(2) / 10, parts=parts)
    away, there = frames(episode, [0, 1], height=200)
    assert green(away)[:, 110:].mean() > 0.1
    assert not green(there).any()
    left = [missed_surface(mesh(parts[1], 0), parts[:1], frame).n_cells for frame in (0, 1)]
    assert left == [mesh(parts[1], 0).n_cells, 0]
    shown = episode_figure(episode, keys=2).axes
    assert [ax.get_xlabel() for ax in shown] == ["0 s", "0.1 s", "target"]
    assert green(pixels(shown[-1])).mean() > 0.1
    save_sheet(episode, tmp_path / "a.png", keys=2)
    assert green((255 * imread(tmp_path / "a.png")[..., :3]).astype(np.uint8)).any()


def pixels(ax) -> np.ndarray:
    """Return what a panel of a contact sheet shows."""
    (image,) = ax.images
    return np.asarray(image.get_array())


def green(picture: np.ndarray) -> np.ndarray:
    red, green, blue = picture.astype(float).transpose(2, 0, 1)
    return (green > 1.06 * red) & (green > 1.04 * blue)


def _corners(view: View) -> np.ndarray:
    low, high = view.lower, view.upper
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def test_a_film_has_every_frame_and_a_sheet_every_key(tmp_path: Path) -> None:
    at = torch.zeros(5, 1, 3)
    at[:, 0, 0] = torch.linspace(-0.5, 0.5, 5)
    episode = replace(still(Part("sphere", "rubber", at, (0.3,))), time=torch.arange(5) / 10)
    assert save_replay(episode, tmp_path / "a.mp4", tmp_path / "a.gif") == 5
    said = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-i", tmp_path / "a.mp4", "-f", "null", "-"], capture_output=True, check=True
    ).stderr.decode()
    assert "frame=    5" in said
    left, right = (pixels(ax) for ax in episode_figure(episode, keys=2).axes)
    middles = [np.nonzero(half[..., 0] > 1.5 * half[..., 1])[1].mean() for half in (left, right)]
    assert middles[0] < 250 < 350 < middles[1]
    assert not list(tmp_path.glob(".*"))


def test_a_scale_is_as_long_as_it_says_at_the_middle_of_the_view() -> None:
    """A rod of that length, across the middle of the view, is as long as the bar."""
    view = View((-1.0,) * 3, (1.0,) * 3, eye=(0.35, 0.5, 1.0), ground=None)
    shot, right = Shot.of(view, 300), axes(view)[0]
    half = torch.from_numpy(shot.bar / 2 * right)
    rod = Part("path", "rubber", torch.stack([-half, half])[None], (0.01,))
    episode = replace(still(rod), view=view)
    (plain,) = frames(episode, [0], height=300, marked=False)
    red, green_, _ = plain.astype(float).transpose(2, 0, 1)
    columns = np.flatnonzero((red > 1.8 * green_).any(axis=0))
    assert columns.max() - columns.min() + 1 == pytest.approx(shot.bar * shot.metre, abs=5)
    (marked,) = frames(episode, [0], height=300)
    changed = np.nonzero((marked != plain).any(axis=2))
    bar = changed[1][changed[0] == 300 - solids.INSET[1] - 1]  # its lowest row
    assert np.ptp(bar) + 1 == round(shot.bar * shot.metre)
    (titled,) = add_title([marked], "a title that is longer than its picture is wide: loss 1 m")
    strip, below = np.split(titled, [len(titled) - 300])
    np.testing.assert_array_equal(below, marked)
    inked = np.flatnonzero((strip.min(axis=2) < 100).any(axis=0))
    assert 0 < inked.min() < inked.max() < strip.shape[1] - 1
    assert (changed[1] < 60).any(), "no time"
    ax = episode_figure(episode).axes[0]
    (line,) = (line for line in ax.lines if line.get_gid() == "scale")
    sheet = Shot.of(view, 600)
    assert np.ptp(line.get_xdata()) == pytest.approx(sheet.bar * sheet.metre)
    assert [text.get_text() for text in ax.texts] == [f"{sheet.bar:g} m"]


def test_a_sheet_says_what_was_simulated_what_came_out_and_how() -> None:
    episode = still(Part("sphere", "rubber", torch.zeros(1, 1, 3), (0.3,)))
    few = Caption(
        "hill · draft", "loss 0.5 m", "example:scoop", {"a": "1 m/s", "b": "−2"}, "episode.json", "gradscape 0"
    )
    figure = episode_figure(episode, caption=few, width=170)
    assert figure.get_suptitle() == "hill · draft · loss 0.5 m"
    lines = figure.get_supxlabel().split("\n")
    assert lines[0] == "2 parameters of example:scoop: a = 1 m/s, b = −2"
    assert lines[1].startswith("Scale: ")
    assert lines[-1] == "gradscape 0"
    many = replace(few, outcome="no loss: not finite", values={f"speed {number}": "1.25 m/s" for number in range(90)})
    figure = episode_figure(episode, caption=many, width=170)
    said = figure.get_supxlabel().replace("\n", " ")
    assert said.startswith("90 parameters of example:scoop: speed 0 = 1.25 m/s, ")
    assert "…; see episode.json Scale" in said
    assert figure.get_suptitle().endswith("no loss: not finite")


def test_a_lump_encloses_what_its_particles_fill() -> None:
    n, edge = 20, 0.2
    axis = (np.arange(n) + 0.5) / n * edge
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    surface = lump(x, edge / n)
    assert surface.volume == pytest.approx(edge**3, rel=0.08)
    alone = lump(np.concatenate([x, [[0.5, 0.5, 0.5]]]), edge / n)
    assert alone.bounds.x_max == pytest.approx(0.5, abs=edge / n)  # a stray particle is seen


@pytest.mark.parametrize(
    ("shape", "size", "volume"),
    [
        ("sphere", (0.3,), 4 / 3 * np.pi * 0.3**3),
        ("capsule", (0.2, 0.1), np.pi * 0.1**2 * 0.4 + 4 / 3 * np.pi * 0.1**3),
        ("torus", (0.3, 0.1), 2 * np.pi**2 * 0.3 * 0.1**2),
        ("cylinder", (0.2, 0.3), np.pi * 0.2**2 * 0.6),
        ("ring", (0.2, 0.3, 0.1), np.pi * (0.3**2 - 0.2**2) * 0.1),
        ("box", (0.2, 0.3, 0.4), 0.024),
    ],
)
def test_solids_have_their_sizes(shape: str, size: tuple[float, ...], volume: float) -> None:
    body = mesh(Part(shape, "steel", torch.zeros(1, 1, 3), size), 0)  # type: ignore[arg-type]
    assert body.triangulate().volume == pytest.approx(volume, rel=0.02)
    outwards = (np.asarray(body.point_normals) * (body.points - body.center)).sum(axis=1)
    assert (outwards > -1e-6).mean() > (0.45 if shape in ("torus", "ring") else 0.99)


def test_turns_and_skins_and_triangles() -> None:
    quarter = rotate_about(1, torch.tensor([torch.pi / 2]))[0] @ torch.tensor([0.0, 0.0, 1.0])
    torch.testing.assert_close(quarter, torch.tensor([1.0, 0.0, 0.0]), atol=1e-6, rtol=0)
    axis = (torch.arange(4) + 0.5) / 4
    cube = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(1, -1, 3)
    vertices, faces = skin(cube)
    assert (vertices.amin(), vertices.amax()) == (0.0, 1.0)
    corners = vertices[0][faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1).sum() / 2
    assert float(area) == pytest.approx(6.0)
    assert len(triangles(np.array([[0, 0], [1, 0], [0, 1]]))) == 1
    assert len(triangles(np.array([[0, 0], [1, 0], [0, 1], [1, 1]]))) == 2
