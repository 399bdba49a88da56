"""The page of the explorer: the map of a slice's page, with controls that move the slice."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ...space import LOG10
from .rendering import STATIC, STYLE, scripts, templates
from .report import inert

if TYPE_CHECKING:
    from ...space import ParameterSpace

SCRIPT = "explore.js"


def explore_page(
    space: ParameterSpace, nodes: Mapping[str, Any], *, title: str, about: str, look: Mapping[str, Any], gradients: bool
) -> str:
    """Return the page: it begins with the samples `nodes` of the first plane, and asks the server for finer ones.

    `about` says how the objective is evaluated. The page contains its own scripts and style.
    """
    values = [space.to_values(end).tolist() for end in (space.lower, space.upper)]
    parameters = [
        {"name": name, "unit": unit, "low": low, "high": high, "logarithmic": scale == LOG10}
        for name, unit, low, high, scale in zip(space.names, space.units, *values, space.scales, strict=True)
    ]
    entry = {
        "env": title,
        "episodes": (),
        "runs": (),
        "identity": {"gradients": gradients, "parameters": parameters},
    }
    page = templates().get_template("explore.html")
    return page.render(
        entry=entry, about=about, parameters=parameters, plane=True, finer=gradients, deviates=False,
        status=dict.fromkeys(("nonfinite", "escaped", "error", "missing"), 0),
        axes="two of its parameters", nodes=inert(nodes), space=inert({"parameters": parameters, **look}),
        style=(STATIC / STYLE).read_text(encoding="utf-8"),
        scripts=[(STATIC / name).read_text(encoding="utf-8") for name in (*scripts(2), SCRIPT)],
    )  # fmt: skip
