"""What grid velocities meet, as Taichi functions: the boundaries' data, made of contacts that act one after another.

A contact is a function (node position p [m], velocity v [m/s], environment e, tools, control step, fraction of it, 1
over its span [1/s]) -> velocity. In a shell around a tool, velocities lose a share of what goes into it and are rubbed,

    v' = v + share(d) (rub(u - u_n n) - (u - u_n n) - u_n n)   where u = v - v_tool and u_n = n.u < 0,

d being the signed distance and n its normal. Sizes and frictions are compiled in.
"""

from functools import cache, reduce
from types import SimpleNamespace
from typing import Any, no_type_check

from ..mpm.boundaries import Boundary, LadleInTank, Open
from ..mpm.sdf import TINY
from ..mpm.tools import FAINTEST, STICKY, UPSTREAM_DT, Kind, Tool, ToolsInRoom
from .runtime import real as real_type
from .runtime import ti

LADLE_SLIP, TOOL_SLIP = 1e-10, 1e-8  # added to squared sliding speeds [m^2/s^2], so that rest has a gradient
ON_WALL = 1e-6  # a wall's own nodes belong to it [m]


@cache
def boundary_contact(boundary: Boundary, name: str) -> Any:
    """Return all of a boundary's contacts as one, in the precision `name`. Raises ValueError for an unknown one."""
    if isinstance(boundary, Open):
        return _free()
    if isinstance(boundary, LadleInTank):
        handle = [_handle(boundary, name)] if boundary.height else []
        contacts = [_bowl(boundary, name), *handle, _drag(boundary, name)]
        edge = boundary.half_width - ON_WALL
        lower, upper = (-edge, ON_WALL, -edge), (edge, boundary.lid, edge)
        return reduce(_apply_both, [*contacts, _walls(lower, upper, name)])
    if isinstance(boundary, ToolsInRoom):
        slots = [sum(tool.slots for tool in boundary.tools[:j]) for j in range(len(boundary.tools))]
        contacts = [
            _tool(tool, slot, _influence(boundary, name), name)
            for tool, slot in zip(boundary.tools, slots, strict=True)
        ]
        lower = (boundary.lower[0], -1e9, boundary.lower[2])  # below it has a floor
        return reduce(_apply_both, [*contacts, _floor(boundary, name), _walls(lower, boundary.upper, name)])
    raise ValueError(f"the Taichi engine knows Open, LadleInTank and ToolsInRoom; got boundary {boundary!r}")


@no_type_check
def _free() -> Any:
    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        return v

    return contact


@no_type_check
def _apply_both(first: Any, second: Any) -> Any:
    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        return second(p, first(p, v, e, tools, step, fraction, rate), e, tools, step, fraction, rate)

    return contact


@cache
@no_type_check
def _shapes(name: str) -> SimpleNamespace:
    """Return signed distances (outward normal, distance [m]) of a point in each shape's own frame."""
    real = real_type(name)

    @ti.func
    def sphere(p, radius):
        length = ti.sqrt(p.dot(p) + real(TINY))
        return p / length, length - radius

    @ti.func
    def capsule(p, axis, half_length, radius):
        along = ti.max(-half_length, ti.min(p.dot(axis), half_length))
        return sphere(p - along * axis, radius)

    @ti.func
    def torus(p, ring, tube):
        axial = ti.sqrt(p[0] ** 2 + p[2] ** 2 + real(TINY))
        to_ring = p - ti.Vector([p[0], real(0.0), p[2]]) * (ring / axial)
        gap = axial - ring
        length = ti.sqrt(gap**2 + p[1] ** 2 + real(TINY))
        return to_ring / length, length - tube

    @ti.func
    def bowl(p, radius, half_thickness):
        """Return the distance to an open half-sphere shell, its rim in the plane y = 0, its opening upwards."""
        out, gap = sphere(p, radius)
        side = ti.select(gap < real(0.0), -real(1.0), real(1.0))
        rim, to_rim = torus(p, radius, half_thickness)
        below = p[1] < real(0.0)
        return ti.select(below, side * out, rim), ti.select(below, side * gap - half_thickness, to_rim)

    @ti.func
    def cylinder(p, radius, half_height):
        axial = ti.sqrt(p[0] ** 2 + p[2] ** 2 + real(TINY))
        outward = ti.Vector([p[0], real(0.0), p[2]]) / axial
        upward = ti.Vector([real(0.0), ti.select(p[1] < real(0.0), -real(1.0), real(1.0)), real(0.0)])
        out, over = axial - radius, ti.abs(p[1]) - half_height
        to_edge = ti.sqrt(out**2 + over**2 + real(TINY))
        past_edge = (out > real(0.0)) & (over > real(0.0))
        n, d = ti.select(out > over, outward, upward), ti.max(out, over)
        edge = (out * outward + over * upward) / to_edge
        return ti.select(past_edge, edge, n), ti.select(past_edge, to_edge, d)

    return SimpleNamespace(sphere=sphere, capsule=capsule, torus=torus, bowl=bowl, cylinder=cylinder)


@cache
@no_type_check
def _laws(name: str) -> SimpleNamespace:
    """Return what contacts share: a tool's motion, Coulomb's friction, and the two together."""
    real = real_type(name)

    @ti.func
    def motion(tools: ti.template(), e, step, slot: ti.template(), fraction, rate):
        start = tools[e, step, slot]
        change = tools[e, step + 1, slot] - start
        return start + fraction * change, rate * change

    @ti.func
    def rub(t, normal, friction, slip: ti.template()):
        """Return the sliding velocity after a contact that stopped the `normal` velocity."""
        speed = ti.sqrt(t.dot(t) + real(slip))
        return t * ti.max(real(0.0), real(1.0) + friction * normal / speed)

    @ti.func
    def touch(v, body, n, share, friction, slip: ti.template()):
        u = v - body
        normal = u.dot(n)
        t = u - normal * n
        felt = ti.select(normal < real(0.0), share, real(0.0))
        return v + felt * (rub(t, normal, friction, slip) - u)

    return SimpleNamespace(motion=motion, rub=rub, touch=touch)


@no_type_check
def _bowl(ladle: LadleInTank, name: str) -> Any:
    real, laws, bowl = real_type(name), _laws(name), _shapes(name).bowl
    fade = _fade(ladle.band, name)

    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        rim, body = laws.motion(tools, e, step, 0, fraction, rate)
        n, d = bowl(p - rim, real(ladle.radius), real(ladle.half_thickness))
        return laws.touch(v, body, n, fade(d), real(ladle.friction), LADLE_SLIP)

    return contact


@no_type_check
def _handle(ladle: LadleInTank, name: str) -> Any:
    """Return the contact with an upright capsule that stands on the bowl's rim."""
    real, laws, capsule = real_type(name), _laws(name), _shapes(name).capsule
    fade = _fade(ladle.band, name)

    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        rim, body = laws.motion(tools, e, step, 0, fraction, rate)
        half = real(ladle.height / 2)
        middle = rim + ti.Vector([-real(ladle.radius), half, real(0.0)])
        up = ti.Vector([real(0.0), real(1.0), real(0.0)])
        n, d = capsule(p - middle, up, half, real(ladle.half_thickness))
        return laws.touch(v, body, n, fade(d), real(ladle.friction), LADLE_SLIP)

    return contact


@no_type_check
def _drag(tank: LadleInTank, name: str) -> Any:
    """Return what the tank's floor and walls leave of the velocity along them."""
    real = real_type(name)
    edge = tank.half_width - ON_WALL

    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        on = ti.Vector([ti.abs(p[0]) > real(edge), p[1] < real(ON_WALL), ti.abs(p[2]) > real(edge)])
        w = v
        for a, b in ti.static(((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))):
            w[b] = ti.select(on[a] and not on[b], real(tank.slip) * v[b], w[b])
        return w

    return contact


@no_type_check
def _fade(band: float, name: str) -> Any:
    real = real_type(name)

    @ti.func
    def fade(d):
        s = ti.max(real(0.0), ti.min(real(1.0) - d / real(band), real(1.0)))
        return s * s * (real(3.0) - real(2.0) * s)

    return fade


@no_type_check
def _tool(tool: Tool, slot: int, influence: Any, name: str) -> Any:
    real, laws, distance = real_type(name), _laws(name), _distance(tool, name)
    rolls = tool.kind is Kind.ROLLER

    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        place, body = laws.motion(tools, e, step, slot, fraction, rate)
        local = p - place
        axis = up = ti.Vector([real(0.0), real(1.0), real(0.0)])
        if ti.static(rolls):
            angles, spin = laws.motion(tools, e, step, slot + 1, fraction, rate)
            axis = ti.Vector([ti.sin(angles[1]), real(0.0), ti.cos(angles[1])])
            body += (spin[0] * axis + spin[1] * up).cross(local)
        n, d = distance(local, axis)
        return laws.touch(v, body, n, influence(d), real(tool.friction), TOOL_SLIP)

    return contact


@no_type_check
def _influence(room: ToolsInRoom, name: str) -> Any:
    """Return the share of what runs into a tool that a node at a distance loses in a substep."""
    real, substeps = real_type(name), room.dt / UPSTREAM_DT

    @ti.func
    def influence(d):
        left = (real(1.0) - ti.exp(-real(room.softness) * ti.max(d, real(0.0)))) / real(1.0 - FAINTEST)
        inside = left <= real(0.0)
        decay = ti.exp(real(substeps) * ti.log(ti.select(inside, real(1.0), left)))
        return ti.select(inside, real(1.0), ti.max(real(1.0) - decay, real(0.0)))

    return influence


@no_type_check
def _distance(tool: Tool, name: str) -> Any:
    """Return a tool's signed distance, as a function of (point in its frame, its axis)."""
    real, shapes = real_type(name), _shapes(name)
    a, b = (*tool.size, 0.0)[:2]

    @ti.func
    def sphere(p, axis):
        return shapes.sphere(p, real(a))

    @ti.func
    def torus(p, axis):
        return shapes.torus(p, real(a), real(b))

    @ti.func
    def cylinder(p, axis):
        return shapes.cylinder(p, real(a), real(b))

    @ti.func
    def capsule(p, axis):
        return shapes.capsule(p, axis, real(a), real(b))

    return {Kind.SPHERE: sphere, Kind.TORUS: torus, Kind.CYLINDER: cylinder}.get(tool.kind, capsule)


@no_type_check
def _floor(room: ToolsInRoom, name: str) -> Any:
    """Return the contact with the floor's nodes: nothing sinks, what presses is rubbed, or sticks."""
    real, laws = real_type(name), _laws(name)
    sticky = room.friction >= STICKY

    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        t = ti.Vector([real(0.0), ti.max(v[1], real(0.0)), real(0.0)])
        if ti.static(not sticky):
            sliding = laws.rub(ti.Vector([v[0], real(0.0), v[2]]), v[1], real(room.friction), TOOL_SLIP)
            t = ti.select(v[1] < real(0.0), sliding, v)
        return ti.select(p[1] <= real(room.floor), t, v)

    return contact


@no_type_check
def _walls(lower: tuple[float, ...], upper: tuple[float, ...], name: str) -> Any:
    """Return the contact with slippery walls around a box."""
    real = real_type(name)

    @ti.func
    def contact(p, v, e, tools: ti.template(), step, fraction, rate):
        w = v
        for a in ti.static(range(3)):
            inward = ti.select(p[a] <= real(lower[a]), ti.max(v[a], real(0.0)), v[a])
            w[a] = ti.select(p[a] >= real(upper[a]), ti.min(inward, real(0.0)), inward)
        return w

    return contact
