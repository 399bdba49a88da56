"""The flip scene: the toss that was found, the pan at rest and lifted, and the path it takes."""

import math
from dataclasses import replace

import pytest
import torch

from gradscape.envs.sheets.flip import Flip

STILL = torch.zeros(15, dtype=torch.float64)


@pytest.fixture(scope="module")
def draft():
    return Flip(fidelity="draft", device="cpu")


def extremes(sheet):
    """Return the left-, right-, back- and frontmost vertices of where a pancake started, shape (vertex, 3)."""
    x, z = torch.from_numpy(sheet.x[:, 0]), torch.from_numpy(sheet.x[:, 2])
    return [int(x.argmin()), int(x.argmax()), int(z.argmin()), int(z.argmax())]


def upper_side(frames, sheet):
    """Return the unit normal of the upper side in every frame, by the two diameters, shape (frame, 3)."""
    left, right, back, front = (frames[:, i] for i in extremes(sheet))
    return torch.nn.functional.normalize(torch.linalg.cross(front - back, right - left), dim=1)


@pytest.mark.parametrize("fidelity", ["draft", "standard"])
def test_the_pancake_is_as_large_heavy_and_soft_as_documented(fidelity):
    env = Flip(fidelity=fidelity, device="cpu")
    sheet = env.sheet
    assert [float(d) for d in sheet.x.max(axis=0) - sheet.x.min(axis=0)] == pytest.approx([0.2, 0.0, 0.2])
    assert sheet.masses.sum() == pytest.approx(3.0 * math.pi * 0.1**2)
    drive = env._drive(STILL[None])
    assert drive.stiffness.unique().tolist() == [60.0]
    assert drive.velocity.abs().max() == 0


@pytest.mark.parametrize("fidelity", ["draft", "standard"])
def test_the_found_toss_turns_the_pancake_over(fidelity):
    env = Flip(fidelity=fidelity, device="cpu")
    x = env.example("flip")
    assert float(env.evaluate(x[None], grad=False).loss) < 0.02
    episode = env.episode(x)
    frames = episode.points["sheet"]
    up = upper_side(frames, env.sheet)
    assert up[0].tolist() == [0, 1, 0]
    assert up[-1, 1] < -0.98
    upright = up[:, 1].abs() < 0.3
    assert upright.any()
    pan = episode.tools["pan"]  # in its frame, all vertices are above its bottom while the pancake stands upright
    above = (frames[:, :, 1] - pan[:, None, 1]) * pan[:, None, 2].cos()
    above = above - (frames[:, :, 0] - pan[:, None, 0]) * pan[:, None, 2].sin()
    assert above[upright].amin() > 0


def test_the_loss_is_the_mean_distance_of_four_vertices_to_their_places_after_a_flip(draft):
    x = draft.space.uniform(3, seed=0)
    start = torch.from_numpy(draft.sheet.x)
    left, right, back, front = extremes(draft.sheet)
    for row, loss in zip(x, draft.evaluate(x, grad=False).loss, strict=True):
        end = draft.end(row)
        gaps = [end[left] - start[right], end[right] - start[left], end[back] - start[back], end[front] - start[front]]
        torch.testing.assert_close(loss, torch.stack(gaps).norm(dim=1).mean())


@pytest.mark.parametrize("fidelity", ["draft", "standard"])
def test_on_a_still_pan_the_pancake_rests(fidelity):
    """Two of the four vertices miss their places by a diameter, two are there: 0.1 m on average."""
    env = Flip(fidelity=fidelity, device="cpu")
    assert float(env.evaluate(STILL[None], grad=False).loss) == pytest.approx(0.1, abs=1e-4)
    frames = env.episode(STILL).points["sheet"]
    torch.testing.assert_close(frames, frames[:1].expand_as(frames), rtol=0, atol=1e-4)


def test_a_pan_that_lifts_slowly_carries_the_pancake_up(draft):
    x = STILL.clone()
    x[1::3] = 0.03 * torch.arange(1, 6)
    frames = draft.episode(x).points["sheet"]
    end = frames[-1] - torch.from_numpy(draft.sheet.x)
    torch.testing.assert_close(
        end, torch.tensor([0.0, 0.15, 0.0], dtype=torch.float64).expand_as(end), rtol=0, atol=1e-3
    )


def test_a_pan_that_drops_away_leaves_the_pancake_in_free_fall(draft):
    x = STILL.clone()
    x[1::3] = -0.075
    frames = draft.episode(x).points["sheet"][:8]  # the pan, at 0.375 m/s, is caught up with after 0.076 s
    dt = draft.fidelity.dt
    n = torch.arange(8, dtype=torch.float64) * 4
    fall = dt**2 * n * (n + 1) / 2 * draft.sheet.gravity
    torch.testing.assert_close(frames[:, :, 1], -fall[:, None].expand(frames.shape[:2]), rtol=0, atol=1e-6)
    torch.testing.assert_close(frames[:, :, ::2], frames[:1, :, ::2].expand(8, -1, 2), rtol=0, atol=1e-6)


def test_the_pan_is_at_the_parameters_at_the_ends_of_segments(draft):
    x = draft.space.uniform(1, seed=4)[0]
    episode = draft.episode(x)
    pan = episode.tools["pan"]
    assert pan[0].tolist() == [0, 0, 0]
    assert torch.equal(pan[20::20], x.reshape(5, 3))
    torch.testing.assert_close(pan[10], x[:3] / 2)
    torch.testing.assert_close(pan[30], (x[:3] + x[3:6]) / 2)
    assert episode.time[20::20].tolist() == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])


def test_a_pancake_that_misses_the_pan_comes_to_rest_on_the_floor(draft):
    """The pan drops and tilts away, so that the pancake slides off; it ends flat on a floor of its own height."""
    x = STILL.clone()
    x[2::3], x[1::3] = 0.6, -0.07
    end, floor = draft.end(x), draft.surface.floor.height
    frames = Flip(fidelity="draft", device="cpu", horizon=2.0).episode(x).points["sheet"]
    assert end[:, 1].min() >= floor - 1e-6
    torch.testing.assert_close(frames[-1, :, 1], torch.full_like(frames[-1, :, 1], floor), rtol=0, atol=1e-3)
    assert Flip(fidelity="draft", device="cpu", floor=False, horizon=2.0).end(x)[:, 1].max() < 4 * floor


def test_the_floor_is_below_all_that_the_pan_reaches(draft):
    """Points of its underside, at every corner of what a waypoint may be."""
    pan, low = draft.pan, draft.space.lower[:3]
    angle = torch.linspace(-pan.sweep, pan.sweep, 401, dtype=torch.float64)
    deep = pan.bend + pan.thickness
    out = torch.sign(angle) * pan.flat + deep * angle.sin()
    up = pan.bend - deep * angle.cos()
    for tilt in torch.linspace(float(low[2]), -float(low[2]), 41, dtype=torch.float64):
        underside = low[1] + out * tilt.sin() + up * tilt.cos()
        assert underside.min() > draft.surface.floor.height + 0.05


@pytest.mark.parametrize(("option", "value"), [("floor", False), ("rim", False), ("bending", 0.0), ("friction", 0.4)])
def test_a_part_of_the_model_changes_tosses_and_leaves_gradients_slopes(option, value):
    """Along a random direction, over steps that are shorter than what lies between contacts."""
    fidelity = replace(Flip.fidelities["draft"], precision="float64")
    x, change = Flip.space.uniform(24, seed=3), 1e-7
    way = torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    env = Flip(fidelity=fidelity, device="cpu", **{option: value})
    result = env.evaluate(x)
    ends = [env.evaluate(x + sign * change * way, grad=False).loss for sign in (1, -1)]
    slope, ours = (ends[0] - ends[1]) / (2 * change), (result.grad * way).sum(dim=1)
    assert ((slope - ours).abs() / ours.abs()).median() < 1e-6
    whole = Flip(fidelity=fidelity, device="cpu").evaluate(x, grad=False).loss
    assert ((result.loss - whole).abs() > 1e-3).sum() >= 5
