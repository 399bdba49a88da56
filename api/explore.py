"""`gs.explore`: look around in a landscape that is sampled meanwhile."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Unpack

from cyclopts import Parameter
from cyclopts.validators import Number

from .call import current, verb
from .options import Dims, Scene, SceneKeywords
from .scene import environment
from .view import has_display

if TYPE_CHECKING:
    from ..jobs.explore_page import Explorer


@verb
def explore(
    scene: Scene,
    dims: Dims | None = None,
    *,
    port: Annotated[int, Parameter(validator=Number(gte=0, lte=65535))] = 0,
    browser: Annotated[bool, Parameter(negative="--no-browser")] = True,
    **keywords: Unpack[SceneKeywords],
) -> Explorer:
    """Look around in a landscape, on a page of this machine that samples it meanwhile.

    The page shows a plane through a point, coarse first and then finer. Choose the two parameters that vary, and move
    the point by sliders or to a node of the map. A click on a node plays its episode, where the environment has some,
    and draws a descent from there. What is shown can be kept as a slice in out/, with its picture and the command that
    makes it again. Ctrl-C ends it; it writes nothing but what is kept.

    Raises ValueError for what the scene does not have, and OSError for a port in use.

    Example: landscape explore pinball-16 --dims 13 14

    Parameters
    ----------
    dims
        The two parameters that vary at first, by number or by name. The default is the first two.
    port
        Port of the page on this machine; 0 takes a free one.
    browser
        Open the page in this system's browser. Its address is printed in any case.
    """
    call = current()
    env = environment(scene, keywords, dims=dims)
    from ..jobs.explore import Exploration
    from ..jobs.explore_page import Explorer
    from ..jobs.folder import ROOT

    explorer = Explorer(Exploration(env, (0, 1) if dims is None else dims, call.command, ROOT), port)
    if browser and has_display():
        import webbrowser

        webbrowser.open(explorer.address)
    return explorer
