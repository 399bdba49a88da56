"""The engine Newton: its solvers as they are, differentiated by Warp's tape."""

from ..engine import Engine

ENGINE = Engine("newton", {"rollout": "newton.rollout"}, concurrent=False, extra="newton")
