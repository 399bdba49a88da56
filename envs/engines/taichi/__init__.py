"""Taichi, the independent reference: solvers written again in another language, with the compiler's gradients."""

from ..engine import Engine

ENGINE = Engine(
    "taichi",
    {"mpm": "taichi.mpm", "springs": "taichi.springs"},
    deterministic=False,
    concurrent=False,
    newest_python=(3, 12),
)
