"""What a grid velocity becomes at walls and ladle: slip, separation, Coulomb's law, and a tool between two steps."""

import pytest
import torch

from gradscape.envs.engines.mpm.boundaries import Kind, LadleInTank, Open, Tool, ToolsInRoom

from ..bench import BoundaryBench, draw, vectors

TANK = LadleInTank(half_width=0.2, lid=0.6, radius=0.07, half_thickness=0.01, height=0.25, band=0.02, friction=0.25)
RIM = torch.tensor([0.0, 0.15, 0.0], dtype=torch.float64)
AWAY = torch.tensor([0.0, 10.0, 0.0], dtype=torch.float64)
BELOW = RIM - torch.tensor([0.0, TANK.radius, 0.0])  # the bowl's lowest point, on its mid-surface
RATE = 100.0  # 1 / length of a control step [1/s]


def built(boundary):
    bench = BoundaryBench(boundary, rate=RATE)

    def met(p, v, *, start=AWAY, end=None, fraction=0.0):
        tools = torch.stack([start, start if end is None else end])[:, None]
        return bench(p, v.reshape(-1, 3), tools, fraction)

    return met


@pytest.fixture(scope="module")
def tank():
    return built(TANK)


@pytest.fixture(scope="module")
def room():
    """Return a room as wide and as high as the tank, with a ball that touches where the bowl's lowest point does."""
    width, ball = TANK.half_width, Tool(Kind.SPHERE, (TANK.radius + TANK.half_thickness,), 0.0)
    return built(ToolsInRoom((ball,), (-width, 0.0, -width), (width, TANK.lid, width), 0.0, 0.0, 300.0))


def random(count, size, seed):
    return 2 * size * draw(count, 3, seed=seed)


def test_empty_space_and_the_tanks_inside_change_nothing(tank):
    v, inside = random(3, 3.0, seed=0), vectors((0.19, 0.01, -0.19), (0.0, 0.3, 0.0), (-0.19, 0.59, 0.19))
    assert torch.equal(built(Open())(random(3, 1.0, seed=1), v), v)
    assert torch.equal(tank(inside, v), v)


@pytest.mark.parametrize(
    ("place", "inward"),
    [
        ((-0.2, 0.1, 0.03), (1, 0, 0)),
        ((0.2, 0.1, 0.03), (-1, 0, 0)),
        ((0.03, 0.1, -0.2), (0, 0, 1)),
        ((0.03, 0.1, 0.2), (0, 0, -1)),
        ((0.03, 0.0, 0.03), (0, 1, 0)),
        ((0.03, 0.61, 0.03), (0, -1, 0)),
    ],
)
@pytest.mark.parametrize("kind", ["tank", "room"])
def test_walls_let_go_and_let_slide_but_let_nothing_in(tank, room, kind, place, inward):
    v, inward = random(50, 3.0, seed=2), vectors(inward)
    through = (v * inward).sum(dim=1, keepdim=True).clamp_max(0)
    met = {"tank": tank, "room": room}[kind](vectors(place).expand(50, 3), v)
    torch.testing.assert_close(met, v - through * inward)


DOWN = vectors((0, -0.01, 0))[0]  # in one control step, so 1 m/s


@pytest.mark.parametrize(
    ("v", "end", "wanted"),
    [
        ((2.0, 1.0, 0.0), RIM, (2.0 - TANK.friction * 1.0, 0, 0)),
        ((0.1, 1.0, 0.1), RIM, (0, 0, 0)),
        ((2.0, -0.5, 0.0), RIM, (2.0, -0.5, 0.0)),
        ((0.0, -0.1, 1.0), RIM, (0.0, -0.1, 1.0)),
        ((0, 0, 0), RIM + DOWN, tuple((RATE * DOWN).tolist())),
    ],
    ids=[
        "what runs into it is rubbed",
        "and stuck",
        "what leaves is free",
        "or slides off",
        "what it hits it takes along",
    ],
)
def test_the_ladle_stops_what_runs_into_it_by_coulombs_law(tank, v, end, wanted):
    p = BELOW - vectors((0, TANK.half_thickness, 0))  # on its outside, whose normal is down
    torch.testing.assert_close(tank(p, vectors(v), start=RIM, end=end), vectors(wanted), rtol=0, atol=1e-6)


def test_the_ladles_grip_fades_over_the_band(tank):
    gaps = torch.linspace(0, 1.25, 6, dtype=torch.float64) * TANK.band
    p = BELOW - vectors((0, 1, 0)) * (TANK.half_thickness + gaps[:, None])
    rise = tank(p, vectors((0, 1, 0)).expand(6, 3), start=RIM)[:, 1]
    s = (1 - gaps / TANK.band).clamp(0, 1)
    torch.testing.assert_close(rise, 1 - s * s * (3 - 2 * s), rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", ["tank", "room"])
def test_a_tool_is_where_its_step_has_taken_it(tank, room, kind):
    bench = {"tank": tank, "room": room}[kind]
    start, end = RIM + vectors((0, 0.1, 0))[0], RIM - vectors((0, 0.1, 0))[0]
    p, into = BELOW - vectors((0, TANK.half_thickness, 0)), vectors((0, 1, 0))
    met = {f: float(bench(p, into, start=start, end=end, fraction=f)[0, 1]) for f in (0.0, 0.5, 1.0)}
    assert met[0.0] == 1.0  # it is still above
    assert met[0.5] == pytest.approx(RATE * -0.2)  # here, going down
    assert met[1.0] == 1.0


def test_the_handle_stands_on_the_rim(tank):
    foot = RIM - vectors((TANK.radius, 0, 0))[0]
    beside = foot + vectors((TANK.half_thickness, 0.2, 0))[0]
    above = foot + vectors((TANK.half_thickness, TANK.height + TANK.half_thickness + TANK.band, 0))[0]
    into = vectors((-1, 0, 0))
    torch.testing.assert_close(tank(beside, into, start=RIM), vectors((0, 0, 0)), rtol=0, atol=1e-6)
    assert torch.equal(tank(above, into, start=RIM), into)
