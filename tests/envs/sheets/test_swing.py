"""The swing scenes: cloth and anchors, losses against episodes, symmetry, the floor, and gradients as the paper saw."""

from dataclasses import replace

import pytest
import torch

from gradscape.envs.sheets import sheets
from gradscape.envs.sheets.flip import Flip
from gradscape.envs.sheets.swing import Swing, SwingStiffness, SwingVelocity
from gradscape.landscapes.objective import Status

DRAFT64 = replace(Swing.fidelities["draft"], precision="float64")
LOSSES = ("single", "corner", "mesh")


def made(cls, loss="single", fidelity=DRAFT64):
    return cls(fidelity=fidelity, device="cpu", loss=loss)


def last(env, x):
    return env.episode(x).points["sheet"][-1]


@pytest.fixture(scope="module")
def velocity():
    return made(SwingVelocity)


@pytest.fixture(scope="module", params=[SwingVelocity, SwingStiffness])
def cls(request):
    return request.param


@pytest.mark.parametrize("fidelity", ["draft", "standard"])
def test_the_cloth_starts_level_and_held_at_its_two_right_corners(fidelity):
    sheet = SwingVelocity(fidelity=fidelity, device="cpu").sheet
    low, high = sheet.x.min(axis=0), sheet.x.max(axis=0)
    assert low.tolist() == pytest.approx([-0.2, 0.1, -0.1])
    assert high.tolist() == pytest.approx([0.0, 0.1, 0.1])
    assert sheet.x[list(sheet.held)].ravel().tolist() == pytest.approx([0.0, 0.1, -0.1, 0.0, 0.1, 0.1])
    assert sheet.masses.sum() == pytest.approx(0.2 * 0.2**2)


def test_an_episode_is_that_of_the_parameters_and_its_anchors_stand_still(cls):
    env = made(cls)
    episode = env.episode(env.example("target"))
    frames, held = episode.points["sheet"], list(env.sheet.held)
    assert torch.equal(frames[0], torch.from_numpy(env.sheet.x))
    assert float(episode.time[-1]) == pytest.approx(env.duration)
    for number, place in zip(held, episode.tools.values(), strict=True):
        assert torch.equal(frames[:, number], place)
        assert torch.equal(place, place[:1].expand_as(place))
    assert frames[:, :, 1].min() < 0.005  # it swings down onto the floor


@pytest.mark.parametrize("cls", [SwingVelocity, SwingStiffness])
def test_the_papers_anchors_swing_the_cloth_onto_the_floor_and_gradients_are_the_slopes(cls):
    env = cls(fidelity=DRAFT64, device="cpu", **cls.preset_options("paper"))
    x, throw = env.example("target"), torch.tensor([1.0, -0.5, 0.0], dtype=torch.float64)
    episode, right = env.episode(x), torch.tensor([[0.0, 0.1, -0.1], [0.0, 0.1, 0.1]], dtype=torch.float64)
    time = episode.time.clamp(max=0.4)
    gone = throw * (time - time**2 / 0.8)[:, None]  # slows down evenly, to rest after 0.4 s
    torch.testing.assert_close(episode.points["sheet"][:, list(env.sheet.held)], right + gone[:, None])
    assert float(episode.points["sheet"][-1, :, 1].mean()) < 0.02  # onto the floor, folded
    other, step = env.space.uniform(1, seed=1), 1e-8 * (env.space.upper - env.space.lower)
    ends = env.evaluate(torch.cat([other - step, other + step]), grad=False).loss
    slope = float(env.evaluate(other).grad @ step)
    assert float(ends[1] - ends[0]) / 2 == pytest.approx(slope, rel=1e-3)


@pytest.mark.parametrize("loss", LOSSES)
def test_the_target_is_where_its_own_example_brings_the_cloth(cls, loss):
    env = made(cls, loss)
    result = env.evaluate(env.example("target")[None])
    assert float(result.loss) == 0.0
    assert result.status.tolist() == [Status.OK]  # though a distance has no slope at 0


@pytest.mark.slow
def test_losses_are_distances_between_the_ends_of_episodes(cls):
    envs = {loss: made(cls, loss) for loss in LOSSES}
    env = envs["mesh"]
    x = env.space.uniform(4, seed=3)
    loss = {name: env.evaluate(x, grad=False).loss for name, env in envs.items()}
    target, n = last(env, env.example("target")), env.fidelity.resolution
    share = torch.ones(n + 1, dtype=torch.float64) / n  # trapezoidal: edges weigh half
    share[[0, -1]] /= 2
    share = share[:, None] * share
    for row in range(4):
        gap = last(env, x[row]) - target
        lengths = gap.norm(dim=1).reshape(n + 1, n + 1)
        torch.testing.assert_close(loss["mesh"][row], (share * lengths).sum())
        torch.testing.assert_close(loss["corner"][row], lengths[[0, 0, -1, -1], [0, -1, 0, -1]].mean())
        torch.testing.assert_close(loss["single"][row], (share.flatten() @ gap).norm())
        assert lengths[-1, [0, -1]].tolist() == [0, 0]
    assert (loss["single"] <= loss["mesh"]).all()  # the norm of a mean is at most the mean of norms
    assert (loss["single"] > 1e-3).all()


def test_both_scenes_swing_the_same_cloth(velocity):
    stiffness = made(SwingStiffness)
    uniform, throw = torch.full((16,), 10.0), torch.tensor([1.0, -0.5, 0.0])
    assert torch.equal(stiffness.end(uniform), velocity.end(throw))


@pytest.mark.parametrize("resolution", [7, 8, 19])
def test_a_patch_is_as_large_as_the_next_and_lies_where_it_is_named(resolution):
    """Each patch's share of the cloth is a sixteenth, and its middle is a patch's, at every resolution."""
    env = made(SwingStiffness, fidelity=replace(DRAFT64, resolution=resolution))
    patch = env._drive(torch.eye(16, dtype=torch.float64)).stiffness
    torch.testing.assert_close(patch.sum(dim=0), torch.ones(len(env.sheet.x), dtype=torch.float64))
    area = torch.from_numpy(env.sheet.masses / env.sheet.masses.sum())
    torch.testing.assert_close(patch @ area, torch.full((16,), 1 / 16, dtype=torch.float64))
    middle = (16 * patch * area) @ torch.from_numpy(env.sheet.x)
    number = torch.arange(16)
    for found, place in ((middle[:, 0] / 0.2 + 1, number // 4), (middle[:, 2] / 0.2 + 0.5, number % 4)):
        assert ((found - (place + 0.5) / 4).abs() < 0.3 / resolution).all()


def test_a_mirrored_throw_ends_mirrored(velocity):
    """Up to rounding, which sums of forces in another order make and which touching the floor enlarges."""
    throw = torch.tensor([1.0, -0.5, 0.7], dtype=torch.float64)
    mirror = torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    n = velocity.fidelity.resolution + 1
    there, back = (velocity.episode(x).points["sheet"][:31] for x in (throw, mirror * throw))
    turned = there.reshape(31, n, n, 3).flip(2).reshape(31, n * n, 3) * mirror
    torch.testing.assert_close(back, turned, rtol=0, atol=1e-12)
    assert (there[-1, :, 1] < 0.0).sum() > 5


def test_the_floor_lets_no_vertex_in(monkeypatch):
    env = made(SwingVelocity)
    monkeypatch.setattr(sheets, "FRAME", env.fidelity.dt)
    for throw in ((2.0, -2.0, 2.0), (1.0, -0.5, 0.3)):
        y = env.episode(torch.tensor(throw, dtype=torch.float64)).points["sheet"][:, :, 1]
        assert y.min() > -1e-14
        assert (y.abs() < 1e-14).any()


@pytest.mark.slow
def test_a_cloth_whose_throw_changes_by_a_millionth_ends_a_little_elsewhere_since_contact_does_not_jump():
    """With the rule `start` more of them jump."""
    x = SwingVelocity.space.uniform(48, seed=5)
    shift = 1e-7 * torch.tensor([1.0, 1.0, 1.0], dtype=torch.float64)
    torn = {}
    for rule in ("end", "start"):
        env = SwingVelocity(fidelity=DRAFT64, device="cpu", contact=rule)
        result = env.evaluate(x)
        change = env.evaluate(x + shift, grad=False).loss - result.loss
        torn[rule] = int(((change - result.grad @ shift).abs() > 1e-4 * (result.grad @ shift).abs() + 1e-9).sum())
    assert torn["end"] <= 3
    assert torn["start"] >= 2 * torn["end"] + 2


@pytest.mark.slow
def test_gradients_are_slopes_but_some_point_against_the_slope_over_two_decimetres_per_second(velocity):
    """The paper finds gradients that are noisy and often opposite to the slope; here one in six to four is."""
    x = velocity.space.uniform(32, seed=2)
    gradient = velocity.evaluate(x).grad[:, 0]

    def slope(step):
        shift = torch.tensor([step, 0.0, 0.0], dtype=torch.float64)
        ends = [velocity.evaluate(x + sign * shift, grad=False).loss for sign in (1, -1)]
        return (ends[0] - ends[1]) / (2 * step)

    near, far = slope(1e-8), slope(0.2)
    assert ((near - gradient).abs() < 1e-5 * gradient.abs() + 1e-6).sum() > 29
    assert (far * gradient < 0).sum() > 2


def test_an_unstable_simulation_is_a_failure_and_no_error(cls):
    env = cls(fidelity=replace(Swing.fidelities["draft"], dt=1 / 100), device="cpu")
    result = env.evaluate(env.space.uniform(3, seed=0))
    assert (result.status == Status.NONFINITE).all()
    assert result.loss.isnan().all()
    assert result.grad.isnan().all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [SwingVelocity, SwingStiffness, Flip])
def test_the_corners_of_the_box_can_be_simulated(kind):
    env, rng = kind(fidelity="draft", device="cpu"), torch.Generator().manual_seed(0)
    corner = torch.randint(0, 2, (64, env.space.dim), generator=rng).bool()
    assert (env.evaluate(torch.where(corner, env.space.upper, env.space.lower)).status == Status.OK).all()
