"""The engine MJX: MuJoCo in JAX."""

from ..engine import Engine

ENGINE = Engine("mjx", {"rollout": "mjx.rollout"}, concurrent=False, extra="mjx")
