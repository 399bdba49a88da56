"""The look of the materials of episodes and their light; style.py has that of diagrams."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ...episode import Part

BACKGROUND, GROUND, SHADOW = "#ffffff", "#f1efec", 0.34  # share of the light a full shadow takes
STAMP: dict[str, Any] = {"color": "#3c3c3c", "font_size": 11, "font": "arial"}
VEIL = 0.75  # how much the ground of what is written on a frame covers
INSET, THICK = (18, 14), 4  # of what is written on a frame, from its edges; of its scale's bar [pixel]
KEY = (-0.55, 1.0, 0.65)  # where the light that throws shadows comes from
LIGHTS = ((KEY, 0.70), ((0.7, 0.3, 1.0), 0.48), ((0.1, 0.3, -1.0), 0.18))  # direction, strength
ANGLE = 24.0  # the camera's, from side to side [degrees]

_MATT: dict[str, Any] = {"ambient": 0.28, "diffuse": 0.80, "specular": 0.06, "specular_power": 12}
_GLOSS: dict[str, Any] = {"ambient": 0.20, "diffuse": 0.78, "specular": 0.45, "specular_power": 40}
_CLEAR: dict[str, Any] = {"ambient": 0.35, "diffuse": 0.65, "specular": 0.30, "specular_power": 60}

CLAY = ("#e07a3f", "#e9b44c", "#c8553d", "#b0719a", "#d99a8b")  # warm, one for each body
LINKS = ("#4f7ba6", "#7fa5c8", "#b4cde2")  # of a chain, from its base
LOOKS: dict[str, dict[str, Any]] = {
    "syrup": _CLEAR | {"color": "#5b9bd5", "opacity": 0.42, "culling": "back"},
    "sugar": _MATT | {"color": "#f28e2b"},
    "plasticine": _MATT,
    "cloth": _MATT | {"color": "#4f86b8"},
    "dough": _MATT | {"color": "#e3b26a"},
    "rubber": _GLOSS | {"color": "#d1495b"},
    "steel": _GLOSS | {"color": "#a7b7c4"},
    "iron": _GLOSS | {"color": "#4a4f55"},
    "wood": _MATT | {"color": "#b98a5e"},
    "board": _MATT | {"color": "#f3efe6"},
    "glass": _GLOSS | {"color": "#aebfca"},
    "goal": _MATT | {"color": "#58ab65"},
    "target": _CLEAR | {"color": "#3fa34d", "opacity": 0.32},
}
BACK = {"cloth": "#b9cfe2", "dough": "#a86b2d"}  # the other side of sheets


def look(part: Part) -> dict[str, Any]:
    """Return how a part is drawn."""
    chosen = dict(LOOKS[part.material])
    if part.material == "plasticine":
        chosen["color"] = CLAY[part.tint % len(CLAY)]
    if part.material == "target" and part.shape != "sheet":
        chosen["culling"] = "front"  # so that what is in it keeps its colour
    if part.shape == "path" and part.material == "steel":
        chosen["color"] = LINKS[part.tint % len(LINKS)]
    return chosen


def solid(part: Part) -> bool:
    """Whether a part throws a shadow."""
    return part.material not in ("syrup", "target", "glass") and part.shape != "trail"
