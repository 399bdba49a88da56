"""Walls and the reach of tools in C++, for the kernels of `grid_cpu`, by the kind of boundary.

Each text takes a boundary's `data`, and nodes at `p`. `find_reach(p, from, to)` says between which z a tool may reach
nodes that lie in line with p along z: further apart from them, the boundary's own function would change nothing, and
no adjoint of theirs be anything but 0. `along(p, v)` is what floor and walls leave of a velocity along them, linear and
its own adjoint; `below(p)` and `above(p)` say along which axes a node is at a wall that lets velocities only rise, only
fall. Expressions are those of the boundary's own function.
"""

from .boundaries import LadleInTank, Open
from .tools import STICKY, ToolsInRoom

# Rounding moves a node by less than a thousandth of a tool's reach.
REACH = """
    auto find_place = [&](int slot) {
        const auto &a = wp::index(tools, e, step, slot), &b = wp::index(tools, e, step + 1, slot);
        return V4{a[0], a[1], a[2], 0.0f} + fraction * V4{b[0] - a[0], b[1] - a[1], b[2] - a[2], 0.0f};
    };
    const float far = __builtin_inff(), rounded = 1.001f;
    auto widen = [](float z, float reach, float& from, float& to) {
        from = __builtin_fminf(from, z - reach);
        to = __builtin_fmaxf(to, z + reach);
    };
    auto widen_by_ball = [&](float x, float y, float z, float radius, float& from, float& to) {
        const float left = radius * radius - x * x - y * y;
        if (left > 0.0f) widen(z, rounded * __builtin_sqrtf(left), from, to);
    };
"""
OPEN = """
    auto find_reach = [](V4 p, float& from, float& to) {};
    auto along = [](V4 p, V4 v) { return v; };
    auto below = [](V4 p) { return p != p; };
    auto above = below;
"""
LADLE_IN_TANK = (
    REACH
    + """
    const float beside = data.half_thickness + data.band, near_bowl = rounded * (data.radius + beside);
    const float edge = data.half_width - 1e-6f, slip = data.slip, near_rod = rounded * beside;
    const V4 ladle = find_place(0);
    auto find_reach = [&](V4 p, float& from, float& to) {
        const float x = p[0] - ladle[0], y = p[1] - ladle[1];
        if (y < near_rod) widen_by_ball(x, y, ladle[2], near_bowl, from, to);
        if (data.height > 0.0f && __builtin_fabsf(x + data.radius) < near_rod) widen(ladle[2], near_rod, from, to);
    };
    const V4 lower = {-edge, 1e-6f, -edge, -far}, upper = {edge, data.lid, edge, far};
    auto below = [&](V4 p) { return p < lower; };
    auto above = [&](V4 p) { return p > upper; };
    auto along = [&](V4 p, V4 v) {
        const auto at = (p < lower) | (p > V4{edge, far, edge, far});
        return at[0] | at[1] | at[2] ? (at ? v : v * slip) : v;
    };
"""
)
TOOLS_IN_ROOM = (
    REACH
    + f"""
    const bool sticks = data.floor_friction >= {STICKY}f;
"""
    + """
    auto find_reach = [&](V4 p, float& from, float& to) {
        for (int t = 0; t < data.reach.shape[0]; ++t) {
            const float reach = rounded * wp::index(data.reach, t);
            const V4 gap = p - find_place(wp::index(data.slot, t));
            widen_by_ball(gap[0], gap[1], p[2] - gap[2], reach, from, to);
        }
        if (p[1] <= data.floor && !sticks) widen(0.0f, far, from, to);
    };
    const V4 lower = {data.lower[0], sticks ? data.floor : -far, data.lower[2], -far};
    const V4 upper = {data.upper[0], data.upper[1], data.upper[2], far};
    auto below = [&](V4 p) { return p <= lower; };
    auto above = [&](V4 p) { return p >= upper; };
    auto along = [&](V4 p, V4 v) { return p[1] <= data.floor ? V4{0.0f, v[1], 0.0f, 0.0f} : v; };
"""
)
WALLS = {Open: OPEN, LadleInTank: LADLE_IN_TANK, ToolsInRoom: TOOLS_IN_ROOM}
