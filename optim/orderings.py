"""The paper's orderings of optimisers as data.

"Rethinking Optimization with Differentiable Simulation from a Global Perspective" (CoRL 2022; arXiv:2207.00167v1),
section 5. Its names: Rand is `random` here, CMA-ES `cma-es`, RandDescents `descents`, BO `bo-descents` (it descends
from each proposal), BO-Leap `bo-leap`. Only what the text says of losses is here. What it says of single episodes (a
cube lifted, a rope wrapped) is not, nor are the scenes we do not have: the one-link cartpole and the real robot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from .claims import Claim, Claims

GRADIENT_BASED = ("descents", "bo-descents")  # the paper's baselines that use gradients
BASELINES = ("random", "cma-es", *GRADIENT_BASED)


def _ahead(first: str, seconds: Sequence[str], source: str) -> tuple[Claim, ...]:
    return tuple(Claim(first, second, source) for second in seconds)


def _alike(first: str, second: str, source: str) -> tuple[Claim, ...]:
    return (Claim(first, second, source, alike=True),)


_CARTPOLE = "Fig. 2, right: all gradient-based methods far below the gradient-free ones"
_PLASTICINE = "Fig. 5: BO-Leap below the gradient-based methods in all tasks"
_BY_FAR = "Fig. 5: significantly below CMA-ES in Assembly, Torus and TripleMove"
_LEVEL = "Fig. 5: names Assembly, Torus and TripleMove as those where BO-Leap is below CMA-ES, so not this one"
_SIX = _ahead("bo-leap", GRADIENT_BASED, _PLASTICINE)
_CLEAR = _SIX + _ahead("bo-leap", ["cma-es"], _BY_FAR)
_DRAWN = _SIX + _alike("bo-leap", "cma-es", _LEVEL)

CLAIMS: Mapping[str, tuple[Claim, ...]] = {
    "cartpole": (
        *(
            claim
            for method in (*GRADIENT_BASED, "bo-leap")
            for claim in _ahead(method, ("random", "cma-es"), _CARTPOLE)
        ),
        *_ahead("cma-es", ["random"], "Fig. 2, right: CMA-ES ahead of Rand, yet does not lift the tip"),
    ),
    "fluid": _ahead("bo-leap", BASELINES, "Fig. 3: BO-Leap best of all baselines"),
    "rope": (
        *_ahead("bo-leap", ("cma-es", "bo-descents"), "Fig. 4: BO-Leap wraps the rope, CMA-ES and BO do not"),
        *_alike("descents", "random", "Fig. 4: RandDescents about as Rand"),
    ),
    "rolling-pin": _ahead("bo-leap", ("cma-es", *GRADIENT_BASED), "Fig. 5: BO-Leap ahead of CMA-ES and of gradients"),
    "assembly": _CLEAR,
    "torus": _CLEAR,
    "triple-move": _CLEAR,
    "pinch": _DRAWN,
    "table": _DRAWN,
    "writer": _DRAWN,
}
_LIMITATION = (
    "The paper compares no optimisers here: it shows the scene among its limitations, its gradients wrong or absent."
)
SILENT: Mapping[str, str] = {
    "bounce": "The paper compares no optimisers here: the scene serves to look at gradients through contact.",
    **dict.fromkeys(("pinball-2", "pinball-16", "swing-velocity", "swing-stiffness", "flip"), _LIMITATION),
}


def claims_about(env: str) -> Claims:
    """Return what the paper claims of an environment, or why it claims nothing."""
    if claims := CLAIMS.get(env):
        return Claims(claims)
    return Claims((), SILENT.get(env, "The paper does not have this environment, so it claims nothing about it."))
