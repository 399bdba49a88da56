"""A ball against walls and bars, held against closed forms, conservation laws and differences."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gradscape.envs.engines.balls.impacts import JAM, Board, Flight, Solver

AWAY = (100.0, 100.0)  # a bar there is never met
BOARD = Board(
    width=8.0,
    height=10.0,
    pivots=(AWAY,),
    half_length=1.0,
    bar_radius=0.1,
    ball_radius=0.25,
    restitution=0.6,
    friction=0.2,
)
SMOOTH = replace(BOARD, restitution=1.0, friction=0.0, gravity=0.0)
CROWDED = replace(BOARD, pivots=((2.2, 5.0), (5.8, 5.0), (1.0, 2.5), (4.0, 2.0), (7.0, 3.0), (4.0, 0.9)))
R = BOARD.ball_radius + BOARD.bar_radius


def vectors(*rows):
    return torch.tensor(rows, dtype=torch.float64)


def solver(board, *, dt, duration, rows=1, contacts="impact", name="float64"):
    steps = round(duration / dt)
    return Solver(board, dt=dt, steps=steps, name=name, capacity=rows, device="cpu", contacts=contacts)


def level(rows=1, bars=1):
    return torch.zeros(rows, bars, dtype=torch.float64)


def energy(board, x, v, spin):
    """Return kinetic, spin and potential energy by mass [J/kg]."""
    inertia = 0.4 * board.ball_radius**2
    return v.square().sum(dim=-1) / 2 + inertia * spin.square() / 2 + board.gravity * x[..., 1]


@pytest.mark.parametrize("dt", [1 / 7, 1 / 60, 1 / 240])
def test_free_flight_is_on_the_parabola_at_the_end_of_every_step(dt):
    start, velocity = vectors((1.0, 3.0)), vectors((2.0, 4.0))
    flying = solver(BOARD, dt=dt, duration=6 / 7)
    flying.run(level(), start, velocity)
    t = dt * torch.arange(flying.steps + 1, dtype=torch.float64)[:, None]
    parabola = start + velocity * t + vectors((0.0, -BOARD.gravity)) * t**2 / 2
    torch.testing.assert_close(flying.at_steps("x", 0), parabola, rtol=0, atol=1e-13)


def after_impact(v, spin, n, restitution, friction):
    """Return velocity and spin after an impact of a solid sphere: Coulomb's law for the impulses by mass."""
    t = np.array([-n[1], n[0]])
    push = -(1 + restitution) * (v @ n)
    slip = v @ t - BOARD.ball_radius * spin
    rub = -math.copysign(min(2 / 7 * abs(slip), friction * push), slip)
    return v + push * n + rub * t, spin - 2.5 * rub / BOARD.ball_radius


@pytest.mark.parametrize("restitution", [1.0, 0.6, 0.0])
@pytest.mark.parametrize("friction", [0.0, 0.2, 5.0])
@pytest.mark.parametrize(("angle", "spin"), [(0.4, 0.0), (-0.7, 12.0), (1.0, -30.0)])
def test_an_inclined_bar_reflects_the_ball_as_the_law_of_impact_says(restitution, friction, angle, spin):
    board = replace(SMOOTH, pivots=((4.0, 5.0),), restitution=restitution, friction=friction)
    bouncing = solver(board, dt=1 / 60, duration=0.5)
    velocity = vectors((0.5, -5.0))
    bouncing.run(level() + angle, vectors((4.0, 6.5)), velocity, torch.tensor([spin], dtype=torch.float64))
    n = np.array([-math.sin(angle), math.cos(angle)])
    v, turn = after_impact(velocity[0].numpy(), spin, n, restitution, friction)
    np.testing.assert_allclose(bouncing.at_end("v")[0], v, rtol=0, atol=1e-13)
    np.testing.assert_allclose(bouncing.at_end("spin")[0], turn, rtol=0, atol=1e-11)
    assert bouncing.at_end("hits").tolist() == [1]


def test_restitution_fades_below_crawling_speed():
    slow = solver(replace(SMOOTH, restitution=0.6), dt=1 / 60, duration=0.5)
    slow.run(level(), vectors((4.0, BOARD.ball_radius + 0.01)), vectors((0.0, -BOARD.crawl / 4)))
    torch.testing.assert_close(slow.at_end("v"), vectors((0.0, 0.6 / 4 * BOARD.crawl / 4)), rtol=0, atol=1e-15)
    assert slow.at_end("hits").tolist() == [0]


def test_a_sphere_thrown_along_a_rough_floor_ends_rolling_at_five_sevenths_of_its_speed():
    board = replace(BOARD, restitution=0.0, friction=0.5)
    rolling = solver(board, dt=1 / 60, duration=1.5)
    rolling.run(level(), vectors((0.5, board.ball_radius)), vectors((3.0, 0.0)))
    v = 5 / 7 * 3.0
    torch.testing.assert_close(rolling.at_end("v"), vectors((v, 0.0)), rtol=0, atol=1e-13)
    torch.testing.assert_close(rolling.at_end("spin"), vectors(-v / board.ball_radius), rtol=0, atol=1e-12)


def placed_on_the_bar(angle, along=0.9):
    """Return where the ball touches the upper face of a bar about (4, 5), `along` [m] up its axis."""
    axis = np.array([math.cos(angle), math.sin(angle)])
    return torch.from_numpy(np.array([4.0, 5.0]) + along * axis + R * np.array([-axis[1], axis[0]]))[None]


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
@pytest.mark.parametrize(
    ("angle", "friction"), [(0.3, 0.05), (0.9, 0.2), (0.3, 0.0), (0.3, 0.2), (0.7, 1.0), (-0.5, 0.6)]
)
def test_a_ball_slides_or_rolls_down_an_inclined_bar_as_coulomb_says(dt, angle, friction):
    board = replace(BOARD, pivots=((4.0, 5.0),), friction=friction)
    duration = 0.4
    sliding = solver(board, dt=dt, duration=duration)
    sliding.run(level() + angle, placed_on_the_bar(angle, math.copysign(0.9, angle)))
    fall, press = board.gravity * math.sin(abs(angle)), board.gravity * math.cos(angle)
    a = max(fall - friction * press, 5 / 7 * fall)  # it rolls where friction is enough for that
    down = -math.copysign(1.0, angle) * vectors((math.cos(angle), math.sin(angle)))
    torch.testing.assert_close(sliding.at_end("v"), a * duration * down, rtol=0, atol=1e-12)
    moved = sliding.at_end("x") - placed_on_the_bar(angle, math.copysign(0.9, angle))
    torch.testing.assert_close(moved, a * duration**2 / 2 * down, rtol=0, atol=1e-12)
    assert sliding.at_end("hits").tolist() == [0]


def test_a_dropped_ball_comes_to_rest_after_the_geometric_series_of_its_bounces():
    height, e = 2.0, BOARD.restitution
    dropped = solver(BOARD, dt=1 / 960, duration=4.0)
    dropped.run(level(), vectors((3.0, BOARD.ball_radius + height)))
    speed = math.sqrt(2 * BOARD.gravity * height)
    slowest = 1 + math.floor(math.log(BOARD.crawl / speed) / math.log(e))
    assert dropped.at_end("hits").tolist() == [slowest]
    assert energy(BOARD, *(dropped.at_end(f) for f in ("x", "v", "spin"))).item() == pytest.approx(
        BOARD.gravity * BOARD.ball_radius, abs=1e-12
    )


def test_a_ball_between_two_bars_jams_and_the_episode_still_takes_all_its_steps():
    """Two upper faces form a narrow valley: no step passes without the dropped rest, and nothing moves."""
    board = replace(BOARD, pivots=((3.45, 5.0), (4.55, 5.0)), half_length=0.6)
    jammed = solver(board, dt=1 / 60, duration=6.0)
    jammed.run(vectors((-0.8, 0.8)), vectors((4.0, 6.0)))
    assert int(jammed.taken) > 2 * jammed.steps + 32  # more than was made room for at first
    assert jammed.at_end("step").tolist() == [jammed.steps]
    assert int(jammed.flight.tensor("impacts").max()) == JAM - 1
    x = jammed.at_steps("x", 0)
    assert len(x) == jammed.steps + 1
    torch.testing.assert_close(x[-60:], x[-1].expand(60, 2), rtol=0, atol=1e-6)
    assert float(x[-1, 1]) > 4.5
    assert bool(jammed.gradient(vectors((1.0, 1.0))).angle.isfinite().all())


def clearance(board, angle, x):
    """Return how far balls at `x`, shape (..., row, 2), are from touching anything [m], in closed form."""
    r = board.ball_radius
    gaps = [x[..., 0] - r, x[..., 1] - r, board.width - r - x[..., 0], board.height - r - x[..., 1]]
    for k, pivot in enumerate(board.pivots):
        axis = torch.stack([angle[:, k].cos(), angle[:, k].sin()], dim=1)
        p = x - vectors(pivot)[0]
        nearest = (p * axis).sum(dim=-1).clamp(-board.half_length, board.half_length)
        gaps.append((p - nearest[..., None] * axis).norm(dim=-1) - r - board.bar_radius)
    return torch.stack(gaps).amin(dim=0)


def flights(board, dt, seed, rows=16, duration=2.0, name="float64", contacts="impact"):
    """Return a solver that has followed balls thrown above a crowd of bars, its angles, and which states are used."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return 2 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1

    thrown = solver(board, dt=dt, duration=duration, rows=rows, name=name, contacts=contacts)
    angle = uniform(rows, len(board.pivots))
    angle[::4] = angle[::4].sign()  # corners of the box
    angle[1::8] = 0.0
    start = vectors((4.0, 8.2)) + uniform(rows, 2) * vectors((3.7, 1.5))
    velocity = 20.0 * uniform(rows, 2) * uniform(rows, 1)
    velocity[::5] = 0.0
    thrown.run(angle, start, velocity, 40.0 * uniform(rows))
    used = torch.arange(int(thrown.taken.max()) + 1)[:, None] <= thrown.taken
    return thrown, angle, used


@settings(max_examples=40)
@given(
    dt=st.floats(1 / 500, 1 / 6),
    restitution=st.sampled_from([0.0, 0.3, 0.6, 1.0]),
    friction=st.sampled_from([0.0, 0.2, 1.0, 5.0]),
    gravity=st.sampled_from([0.0, 9.81]),
    half_length=st.sampled_from([0.6, 1.2]),
    seed=st.integers(0, 2**31),
)
@example(dt=1 / 6, restitution=0.0, friction=0.0, gravity=9.81, half_length=1.2, seed=1446276515)  # 3e-5 m deep
@example(dt=0.125, restitution=0.0, friction=0.2, gravity=9.81, half_length=1.2, seed=1280340127)  # rubbed too fast
def test_at_any_step_nothing_is_tunnelled_and_energy_never_grows(dt, restitution, friction, gravity, half_length, seed):
    board = replace(CROWDED, restitution=restitution, friction=friction, gravity=gravity, half_length=half_length)
    thrown, angle, used = flights(board, dt, seed, duration=min(2.0, 120 * dt))
    x, v, spin = (thrown.flight.tensor(f)[: len(used)] for f in ("x", "v", "spin"))
    clear, turns = clearance(board, angle, x), rolls_round(board, thrown)[: len(used)]
    rolled = torch.zeros_like(used)
    rolled[1:] = turns[:-1]
    free = thrown.flight.tensor("impacts").amax(dim=0) < JAM - 1  # two surfaces jam the others, by rounding
    assert float(clear[used & ~rolled & free].min()) > -1e-9
    assert float(clear[used & ~rolled].min()) > -1e-8
    assert float(clear[used].min()) > -1e-4  # a ball that turns back within 1/240 s has been g/2 (1/240 s)^2 deep
    flown = used[1:] & ~turns[:-1]
    for between in on_parabolas(thrown, used, x, v):
        left = clearance(board, angle, between)
        assert float(left[flown & free].min()) > -1e-9
        assert float(left[flown].min()) > -1e-8
    gain = energy(board, x, v, spin).diff(dim=0)
    assert float(gain[flown & free].max()) < 1e-11
    assert float(gain[flown].max()) < 1e-8
    assert float(gain[used[1:]].max()) < 1e-7  # of 100 J; around round ends: fifth-order errors of 1/240 s
    assert bool((pressing(board, thrown, angle, used & turns) > -1e-9).all())


def pressing(board, thrown, angle, carried):
    """Return by what force by mass [m/s^2] round ends push the balls that they carry."""
    step, row = carried.nonzero(as_tuple=True)
    x, v, support = (thrown.flight.tensor(f)[step, row] for f in ("x", "v", "support"))
    turned = angle[row, support // 4]
    tip = board.half_length * torch.stack([turned.cos(), turned.sin()], dim=1) * (1 - 2 * (support % 2))[:, None]
    n = x - torch.tensor(board.pivots, dtype=torch.float64)[support // 4] - tip
    return board.gravity * n[:, 1] / n.norm(dim=1) - v.square().sum(dim=1) / (board.ball_radius + board.bar_radius)


def rolls_round(board, thrown):
    """Return which iterations follow a round end, where the path is no parabola."""
    carrier = thrown.flight.tensor("support")
    return (carrier >= 0) & (carrier < 4 * len(board.pivots)) & (carrier % 4 >= 2)


def on_parabolas(thrown, used, x, v):
    """Yield points on the parabolas between events: each from its first position and velocity to its last position."""
    lasting = thrown.flight.tensor("when")[: len(used) - 1, :, None]
    for share in (0.3, 0.7):
        straight = x[:-1] + share * lasting * v[:-1]
        yield straight + share**2 * (x[1:] - x[:-1] - lasting * v[:-1])


def test_single_precision_neither_tunnels_nor_fails_nor_gains_more_than_rounding():
    for seed in range(6):
        board = replace(CROWDED, restitution=(0.0, 0.6, 1.0)[seed % 3])
        thrown, angle, used = flights(board, 1 / 60, seed, rows=64, name="float32")
        x, v, spin = (thrown.flight.tensor(f)[: len(used)].double() for f in ("x", "v", "spin"))
        assert float(clearance(board, angle, x)[used].min()) > -2e-5
        assert float(energy(board, x, v, spin).diff(dim=0)[used[1:]].max()) < 1e-4
        slopes = thrown.gradient(torch.ones(64, 2))
        assert all(bool(getattr(slopes, f).isfinite().all()) for f in ("angle", "start", "velocity", "spin"))


@pytest.mark.parametrize("dt", [0.8, 1 / 30, 1 / 240])
def test_one_bounce_off_the_floor_is_exact_at_any_step(dt):
    start = torch.stack([torch.full((64,), 4.0), torch.linspace(2.0, 3.0, 64)], dim=1).double()
    velocity = vectors((1.0, -1.0)).expand(64, 2)
    board, duration = replace(BOARD, friction=0.0), 0.8
    fall, g = start[:, 1] - board.ball_radius, board.gravity
    speed = (velocity[:, 1] ** 2 + 2 * g * fall).sqrt()
    left = duration - (speed + velocity[:, 1]) / g
    exact = board.ball_radius + board.restitution * speed * left - g * left**2 / 2
    bouncing = solver(board, dt=dt, duration=duration, rows=64)
    end = bouncing.run(level(64), start, velocity)
    torch.testing.assert_close(end[:, 1], exact, rtol=0, atol=1e-12)
    assert bouncing.at_end("hits").tolist() == [1] * 64
    slope = bouncing.gradient(vectors((0.0, 1.0)).expand(64, 2)).start[:, 1]
    wanted = board.restitution * g / speed * left - (board.restitution * speed - g * left) / speed
    torch.testing.assert_close(slope, wanted, rtol=1e-10, atol=1e-10)


def reflected(angle, start, velocity, duration, feature):
    """Return the end of a flight without gravity that meets a smooth elastic bar about (4, 5), as torch has it."""
    axis = torch.stack([angle.cos(), angle.sin()])
    p = start - vectors((4.0, 5.0))[0]
    if feature == "face":
        n = torch.stack([-axis[1], axis[0]])
        t = (R - p @ n) / (velocity @ n)
    else:
        m = p - SMOOTH.half_length * axis
        b, c = m @ velocity, m @ m - R**2
        t = (-b - (b**2 - (velocity @ velocity) * c).sqrt()) / (velocity @ velocity)
        n = (m + velocity * t) / R
    after = velocity - 2 * (velocity @ n) * n
    return start + velocity * t + after * (duration - t)


@pytest.mark.parametrize(("feature", "x"), [("face", 4.3), ("end", 5.1)])
def test_the_gradient_of_one_bounce_is_that_of_its_closed_form(feature, x):
    duration = 0.5
    leaves = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (-0.2, (x, 6.5), (0.4, -5.0))]
    end = reflected(*leaves, duration, feature)
    bouncing = solver(replace(SMOOTH, pivots=((4.0, 5.0),)), dt=1 / 60, duration=duration)
    angle, start, velocity = (leaf.detach()[None] for leaf in leaves)
    torch.testing.assert_close(bouncing.run(angle[None], start, velocity)[0], end.detach(), rtol=0, atol=1e-13)
    for weight in vectors((1.0, 0.0), (0.0, 1.0)):
        wanted = torch.autograd.grad(end @ weight, leaves, retain_graph=True)
        slopes = bouncing.gradient(weight[None])
        for got, want in zip((slopes.angle[0, 0], slopes.start[0], slopes.velocity[0]), wanted, strict=True):
            torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("contacts", "slope"), [("impact", -1.0), ("step", 1.0)])
def test_without_the_time_of_impact_the_slope_of_an_elastic_bounce_has_the_wrong_sign(contacts, slope):
    """The ball falls at constant speed: y_end = 2 r - (y - V T), which steps see as y_end = y + whole steps."""
    dropped = solver(SMOOTH, dt=1 / 240, duration=0.5, contacts=contacts)
    end = dropped.run(level(), vectors((3.0, 1.1)), vectors((0.0, -4.0)))
    mirrored = 2 * SMOOTH.ball_radius - (1.1 - 4.0 * 0.5)
    assert float(end[0, 1]) == pytest.approx(mirrored, abs=1e-12 if contacts == "impact" else 2 * 4.0 / 240)
    assert float(dropped.gradient(vectors((0.0, 1.0))).start[0, 1]) == pytest.approx(slope, abs=1e-12)


def test_fixed_steps_can_tunnel_where_chords_cannot():
    board = replace(SMOOTH, pivots=((4.0, 5.0),))
    ends = {}
    for contacts in ("impact", "step"):
        fast = solver(board, dt=1 / 10, duration=0.2, contacts=contacts)
        ends[contacts] = float(fast.run(level(), vectors((4.0, 6.0)), vectors((0.0, -20.0)))[0, 1])
    assert ends["impact"] > 5.0
    assert ends["step"] < 5.0


@pytest.mark.parametrize("contacts", ["impact", "step"])
@pytest.mark.parametrize(("dt", "restitution"), [(1 / 60, 0.6), (1 / 240, 0.6), (1 / 60, 0.0)])
def test_gradients_are_the_slopes_of_random_episodes(contacts, dt, restitution):
    """Where no event changes within the differences, and chaos leaves differences their digits."""
    rows, h = 64, 1e-6
    board = replace(CROWDED, restitution=restitution)
    thrown, angle, _ = flights(board, dt, seed=3, rows=rows, duration=1.5, contacts=contacts)
    start, velocity, spin = (thrown.flight.tensor(f)[0].clone() for f in ("x", "v", "spin"))
    weight = vectors((1.0, -0.7)).expand(rows, 2)
    slopes = thrown.gradient(weight)
    got = torch.cat([slopes.angle, slopes.start, slopes.velocity, slopes.spin[:, None]], dim=1)

    def run(shift):
        parts = torch.split(torch.cat([angle, start, velocity, spin[:, None]], dim=1) + shift, [6, 2, 2, 1], dim=1)
        end = thrown.run(parts[0], parts[1], parts[2], parts[3][:, 0])
        return (end * weight).sum(dim=1), thrown.flight.tensor("pick")[:360].clone()

    compared = 0
    for k, shift in enumerate(h * torch.eye(11, dtype=torch.float64)):
        ends, events = zip(*(run(share * shift) for share in (-2, -1, 1, 2)), strict=True)
        calm = (torch.stack(events[:3]) == events[3]).all(dim=(0, 1)) & (got.abs().amax(dim=1) < 100)
        wanted = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)  # of fourth order
        torch.testing.assert_close(got[calm, k], wanted[calm], rtol=1e-6, atol=1e-6)
        compared += int(calm.sum())
    assert compared > 11 * rows / 4


def test_a_second_run_and_a_second_gradient_forget_the_first():
    thrown, angle, _ = flights(CROWDED, 1 / 60, seed=5)
    start, velocity = (thrown.flight.tensor(f)[0].clone() for f in ("x", "v"))
    fresh = solver(CROWDED, dt=1 / 60, duration=2.0, rows=16)
    weight = torch.ones(16, 2, dtype=torch.float64)
    thrown.gradient(weight)
    for used in (thrown, fresh):
        used.run(angle, start, velocity)
    assert torch.equal(thrown.gradient(weight).angle, fresh.gradient(weight).angle)
    assert torch.equal(thrown.gradient(weight).angle, fresh.gradient(weight).angle)


def test_an_episode_is_one_launch_there_and_one_back(monkeypatch):
    """However many events it has: a launch costs more than an event."""
    backwards, launch = [], wp.launch

    def counted(*given, **how):
        backwards.append(how.get("adjoint", False))
        return launch(*given, **how)

    monkeypatch.setattr(wp, "launch", counted)
    for contacts in ("impact", "step"):
        thrown, _, _ = flights(CROWDED, 1 / 60, seed=5, contacts=contacts)
        thrown.gradient(torch.ones(16, 2))
        assert backwards == [False, True]
        backwards.clear()


def test_rows_that_need_more_room_than_was_made_end_as_they_do_where_there_is_enough():
    """Of two balls one jams between two faces and continues from where room ended, as often as that takes."""
    board = replace(BOARD, pivots=((3.45, 5.0), (4.55, 5.0)), half_length=0.6)
    angle, start = vectors((-0.8, 0.8), (0.3, -0.2)), vectors((4.0, 6.0), (1.0, 6.0))
    roomy, cramped = (solver(board, dt=1 / 60, duration=6.0, rows=2) for _ in range(2))
    cramped.flight = Flight(40, 2, "float64", "cpu")
    roomy._double_length()
    found = [(*made_of(used, angle, start), used.taken.clone()) for used in (roomy, cramped)]
    assert int(found[0][-1].max()) > 9 * 40  # room is doubled more than thrice
    assert int(found[0][-1].min()) < int(found[0][-1].max())
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


def made_of(used, angle, start):
    """Return ends, and slopes of their sum."""
    end = used.run(angle, start).clone()
    slopes = used.gradient(torch.ones_like(end))
    return end, slopes.angle, slopes.start, slopes.velocity, slopes.spin
