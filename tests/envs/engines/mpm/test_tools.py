"""What grid velocities become at tools and floor: nothing out of reach, Coulomb's law, rolling, and true gradients."""

import math

import pytest
import torch
import warp as wp

from gradscape.envs.controls import roll
from gradscape.envs.engines.mpm.boundaries import (
    FAINTEST,
    STICKY,
    UPSTREAM_DT,
    Kind,
    Tool,
    ToolsInRoom,
    shapes,
)
from gradscape.envs.engines.runtime import precision

from ..bench import BoundaryBench, draw, vectors

SIZES = {
    Kind.SPHERE: (0.03,),
    Kind.CAPSULE: (0.05, 0.03),
    Kind.TORUS: (0.06, 0.02),
    Kind.CYLINDER: (0.04, 0.03),
    Kind.ROLLER: (0.06, 0.03),
}
FRICTION, SOFTNESS, RATE, YAW = 0.8, 300.0, 50.0, 0.7
SHELL = math.log(1 / FAINTEST) / SOFTNESS
LOWER, UPPER = (-0.5, 0.0, -0.5), (0.5, 1.0, 0.5)
PLACE = vectors((0.03, 0.4, -0.02))[0]  # of a tool's middle
AWAY = vectors((0.0, 50.0, 0.0))[0]
KINDS = pytest.mark.parametrize("kind", SIZES, ids=lambda kind: kind.name.lower())


def room(*tools, friction=0.0, floor=0.1, substeps=1.0):
    scene = ToolsInRoom(tools, LOWER, UPPER, floor, friction, SOFTNESS, substeps * UPSTREAM_DT)
    return BoundaryBench(scene, rate=RATE)


def slots(kind, start, travel=(0.0, 0.0, 0.0), spin=0.0, turn=0.0):
    """Return what one tool fills of `tools` in one control step, shape (2, slot, 3); a roller begins at YAW."""
    path = torch.stack([start, start + vectors(travel)[0]])[:, None]
    if kind is not Kind.ROLLER:
        return path
    return torch.cat([path, vectors((0.3, YAW, 0.0), (0.3 + spin, YAW + turn, 0.0))[:, None]], dim=1)


def surface(kind, p):
    """Return (normal, distance) of points from a tool at PLACE."""
    types, size = precision("float64"), SIZES[kind]
    functions = {Kind.SPHERE: "sphere", Kind.TORUS: "torus", Kind.CYLINDER: "cylinder"}
    axis = [] if kind in functions else [(0, 1, 0) if kind is Kind.CAPSULE else (math.sin(YAW), 0, math.cos(YAW))]
    local = wp.array((p - PLACE).numpy(), dtype=types.vec3)
    given = [types.vec3(*a) for a in axis] + [types.real(length) for length in size]
    hits = torch.from_numpy(wp.map(getattr(shapes("float64"), functions.get(kind, "capsule")), local, *given).numpy())
    return hits[:, :3], hits[:, 3:]


def nodes_at(kind, gaps, count=300, seed=0):
    """Return nodes at these distances from a tool's surface, their normals, and which no edge upsets."""
    start = PLACE + 0.2 * draw(count, 3, seed=seed)
    normal, distance = surface(kind, start)
    p = start + (gaps.reshape(-1, 1) - distance) * normal
    again, reached = surface(kind, p)
    same = ((again - normal).abs().amax(dim=1) < 1e-6) & ((reached - gaps.reshape(-1, 1)).abs()[:, 0] < 1e-9)
    assert same.sum() > count / 3
    return p, again, same


def dot(a, b):
    return (a * b).sum(dim=1, keepdim=True)


def rubbed(u, normal, friction):
    """Return the tangential part of u after Coulomb's law, for what runs into a surface."""
    into = dot(u, normal)
    tangent = u - into * normal
    speed = tangent.norm(dim=1, keepdim=True)
    return tangent * (1 + friction * into / speed).clamp_min(0)


@KINDS
def test_a_tool_meets_what_runs_into_its_shell_and_nothing_else(kind):
    p, v = PLACE + 0.2 * draw(4000, 3, seed=1), 2 * draw(4000, 3, seed=2)
    normal, distance = surface(kind, p)
    met = room(Tool(kind, SIZES[kind], FRICTION))(p, v, slots(kind, PLACE))
    meets = (distance < SHELL)[:, 0] & (dot(v, normal) < 0)[:, 0]
    assert 20 < meets.sum() < 3000
    assert torch.equal(met[~meets], v[~meets])
    assert (met[meets] != v[meets]).any(dim=1).all()


@KINDS
@pytest.mark.parametrize("motion", [(0.0, 0.0, 0.0), (0.01, -0.03, 0.02)])
def test_matter_slides_on_a_tool_by_coulombs_law(kind, motion):
    p, normal, same = nodes_at(kind, torch.full((300,), -1e-3, dtype=torch.float64))
    v, body = 2 * draw(300, 3, seed=3), RATE * vectors(motion)
    u = v - body
    into = same & (dot(u, normal) < 0)[:, 0]
    met = room(Tool(kind, SIZES[kind], FRICTION))(p, v, slots(kind, PLACE, motion))
    wanted = body + rubbed(u, normal, FRICTION)
    torch.testing.assert_close(met[into], wanted[into], rtol=0, atol=1e-6)
    stuck = (wanted == body).all(dim=1) & into
    assert stuck.sum() > 5  # friction was enough
    assert (into & ~stuck).sum() > 5  # and here it was not


@KINDS
def test_the_grip_fades_in_the_shell(kind):
    gaps = torch.linspace(0, 0.999, 300, dtype=torch.float64) * SHELL
    p, normal, same = nodes_at(kind, gaps)
    v = 2 * draw(300, 3, seed=4)
    v = v - (dot(v, normal).clamp_min(0) + 0.5) * normal
    met = room(Tool(kind, SIZES[kind], FRICTION))(p, v, slots(kind, PLACE))
    influence = ((torch.exp(-SOFTNESS * gaps) - FAINTEST) / (1 - FAINTEST))[:, None]  # 1 at the surface, 0 at the end
    wanted = (1 - influence) * v + influence * rubbed(v, normal, FRICTION)
    torch.testing.assert_close(met[same], wanted[same], rtol=0, atol=1e-6)


def test_what_a_shell_takes_in_a_time_does_not_depend_on_how_it_is_cut():
    """The speed into a tool decays as (1 - k)^(t / UPSTREAM_DT), k being the share of one of PlasticineLab's steps."""
    gaps = torch.linspace(0.01, 0.99, 300, dtype=torch.float64) * SHELL
    p, normal, same = nodes_at(Kind.SPHERE, gaps)
    v = -1.3 * normal + 0.2 * torch.linalg.cross(normal, vectors((0.3, 0.5, 0.8)).expand_as(normal))
    share = (torch.exp(-SOFTNESS * gaps) - FAINTEST) / (1 - FAINTEST)
    for duration, cuts in ((1.0, (1, 2, 5)), (2.5, (1, 10))):
        wanted = v + 1.3 * (1 - (1 - share[:, None]) ** duration) * normal
        for count in cuts:
            shell, met = room(Tool(Kind.SPHERE, SIZES[Kind.SPHERE], 0.0), substeps=duration / count), v
            for _ in range(count):
                met = shell(p, met, slots(Kind.SPHERE, PLACE))
            torch.testing.assert_close(met[same], wanted[same], rtol=0, atol=1e-7)  # the normal is rounded by 1e-9


def test_a_rollers_surface_turns_with_it():
    """Matter that sticks to it moves at v + omega x r: omega is its spin along its axis and its turn about y."""
    motion, spin, turn, fraction = (0.004, -0.002, 0.001), 0.5, -0.2, 0.25
    heading = YAW + fraction * turn
    axis = vectors((math.sin(heading), 0, math.cos(heading)))
    p = PLACE + 0.1 * draw(4000, 3, seed=5)
    local = p - (PLACE + fraction * vectors(motion))
    flat = local - dot(local, axis).clamp(-0.06, 0.06) * axis
    p, local, flat = (t[flat.norm(dim=1) < 0.03] for t in (p, local, flat))
    omega = RATE * (spin * axis + turn * vectors((0, 1, 0)))
    wanted = RATE * vectors(motion) + torch.linalg.cross(omega.expand_as(local), local)
    v = wanted - flat  # straight towards the axis
    met = room(Tool(Kind.ROLLER, SIZES[Kind.ROLLER], 1e6))(
        p, v, slots(Kind.ROLLER, PLACE, motion, spin, turn), fraction
    )
    assert len(p) > 100
    torch.testing.assert_close(met, wanted, rtol=0, atol=1e-8)


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_without_slip_a_rollers_lowest_line_is_at_rest(turn):
    """Half-way through a step that `roll` has made; where it turns, the line turns about its middle."""
    half_length, radius = SIZES[Kind.ROLLER]
    far = vectors((9, 9, 9))[0]
    place, angles = roll(PLACE, vectors((0.4, turn, 0.0))[None], radius, lower=-far, upper=far)
    tools = torch.stack([place[0], angles[0]], dim=1)
    heading = float(angles[0, :, 1].mean())
    along = torch.linspace(-half_length, half_length, 7, dtype=torch.float64)[:, None]
    offset = along * vectors((math.sin(heading), 0, math.cos(heading)))
    p = place[0].mean(dim=0) + offset - vectors((0, 0.999 * radius, 0))
    bench = room(Tool(Kind.ROLLER, SIZES[Kind.ROLLER], 1e6))
    met = bench(p, vectors((0, 1, 0)).expand(7, 3), tools, 0.5)
    turning = torch.linalg.cross(-turn * RATE * vectors((0, 1, 0)).expand(7, 3), offset)
    slip = 1e-3 * radius * 0.4 * RATE  # of a line a thousandth above the lowest
    torch.testing.assert_close(met, turning, rtol=0, atol=1.01 * slip)
    assert place[0].diff(dim=0).norm() == pytest.approx(radius * 0.4)


@pytest.mark.parametrize("friction", [0.0, 0.4, STICKY])
def test_the_floor_slips_rubs_or_sticks(friction):
    bench = room(Tool(Kind.SPHERE, (0.03,), 0.0), friction=friction, floor=0.1)
    v = 2 * draw(200, 3, seed=6)
    up = vectors((0, 1, 0)).expand(200, 3)
    wanted = torch.where((v[:, 1] < 0)[:, None], rubbed(v, up, friction), v)
    if friction >= STICKY:  # what rises may leave, but not sideways
        wanted = v.clamp_min(0) * up
    for height in (0.1, 0.03):
        met = bench(vectors((0.1, height, 0.2)), v, slots(Kind.SPHERE, AWAY))
        torch.testing.assert_close(met, wanted, rtol=0, atol=1e-6)
    assert torch.equal(bench(vectors((0.1, 0.1001, 0.2)), v, slots(Kind.SPHERE, AWAY)), v)


def test_tools_in_one_scene_act_as_each_alone():
    """A roller fills two slots, so that what follows it must be found behind them."""
    kinds = [Kind.SPHERE, Kind.ROLLER, Kind.CYLINDER, Kind.ROLLER, Kind.TORUS]
    tools = [Tool(kind, SIZES[kind], 0.1 + 0.1 * i) for i, kind in enumerate(kinds)]
    middles = vectors(*[(-0.4 + 0.2 * i, 0.4, 0.05 * i) for i in range(5)])
    motions = 0.02 * draw(5, 3, seed=8)
    parts = [slots(k, m, t.tolist(), 0.2, 0.1) for k, m, t in zip(kinds, middles, motions, strict=True)]
    whole = room(*tools)
    assert whole.boundary.slots == 7
    for i, (tool, middle) in enumerate(zip(tools, middles, strict=True)):
        p, v = middle + 0.12 * draw(200, 3, seed=9), 4 * draw(200, 3, seed=10)
        lone = room(tool)(p, v, parts[i], 0.5)
        near = (torch.cdist(p, middles) < 0.1).sum(dim=1) == (torch.cdist(p, middles[i : i + 1]) < 0.1)[:, 0]
        assert (lone != v)[near].any()
        assert torch.equal(whole(p, v, torch.cat(parts, dim=1), 0.5)[near], lone[near])


def test_a_node_in_two_shells_meets_both_in_turn():
    tools = [Tool(Kind.SPHERE, (0.03,), 0.2), Tool(Kind.CAPSULE, (0.05, 0.03), 0.3)]
    places = [slots(Kind.SPHERE, PLACE), slots(Kind.CAPSULE, PLACE + vectors((0.065, 0, 0))[0])]
    p, v = PLACE + vectors((0.0325, 0.001, 0)) + 1e-3 * draw(50, 3, seed=11), 2 * draw(50, 3, seed=12)
    first, second = (room(tool) for tool in tools)
    wanted = second(p, first(p, v, places[0]), places[1])
    assert torch.equal(room(*tools)(p, v, torch.cat(places, dim=1)), wanted)
    assert (wanted != first(p, v, places[0])).any()
    assert (wanted != second(p, v, places[1])).any()


@KINDS
@pytest.mark.parametrize(("friction", "substeps"), [(0.0, 1.0), (FRICTION, 1.0), (FRICTION, 0.25)])
def test_adjoints_are_slopes(kind, friction, substeps):
    """By the velocity and by the tool's place, motion and angles, in the shell and inside, rubbed or stuck."""
    count, fraction, step = 60, 0.3, 1e-6
    bench = room(Tool(kind, SIZES[kind], friction), Tool(Kind.SPHERE, (0.02,), friction), substeps=substeps)
    tools = torch.cat([slots(kind, PLACE, (0.001, -0.003, 0.002), 0.1, 0.05), slots(Kind.SPHERE, AWAY)], dim=1)
    gaps = SHELL * torch.linspace(-0.5, 0.8, count, dtype=torch.float64)
    p, normal, _ = nodes_at(kind, gaps, count, seed=13)
    v = draw(count, 3, seed=14) - 0.8 * normal
    weights, dv, dt = draw(count, 3, seed=15), draw(count, 3, seed=16), 0.05 * draw(*tools.shape, seed=17)
    ends = [bench(p, v + s * step * dv, tools + s * step * dt, fraction) for s in (1, -1)]
    changed = (bench(p, v, tools, fraction) != v).any(dim=1)
    assert changed.sum() > count / 2
    for node in range(count):
        adj_v, adj_tools = bench.adjoint(
            *(t[node : node + 1] for t in (p, v)), tools, weights[node : node + 1], fraction
        )
        slope = ((ends[0] - ends[1])[node] * weights[node]).sum() / (2 * step)
        got = (adj_v * dv[node]).sum() + (adj_tools * dt).sum()
        assert got == pytest.approx(float(slope), abs=1e-6 * max(1.0, float(adj_tools.abs().max())))


@pytest.mark.parametrize("friction", [0.0, 0.4, STICKY])
def test_the_floors_adjoint_is_its_slope(friction):
    bench = room(Tool(Kind.SPHERE, (0.03,), 0.0), friction=friction)
    p, v, tools = vectors((0.1, 0.05, 0.2)), 2 * draw(100, 3, seed=18), slots(Kind.SPHERE, AWAY)
    weights, direction, step = draw(100, 3, seed=19), draw(100, 3, seed=20), 1e-6
    adj_v, adj_tools = bench.adjoint(p, v, tools, weights)
    slope = (bench(p, v + step * direction, tools) - bench(p, v - step * direction, tools)) / (2 * step)
    torch.testing.assert_close(dot(adj_v, direction), dot(slope, weights), rtol=0, atol=1e-7)
    assert not adj_tools.any()
