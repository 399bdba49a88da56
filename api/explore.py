"""`gs.explore`: explore a landscape on a page that samples it meanwhile."""

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
    """Explore a landscape in a browser, on a local page that samples it while you look.

    The page shows a plane through a point, first coarse and then finer. You choose the two parameters that vary, and
    move the point with sliders or to a node of the map. A click on a node draws a descent from there, and plays its
    episode if the environment can draw one. You can save the plane as a slice in out/, with its picture and the command
    that makes it again. Ctrl-C ends the page. It writes no other file.

    Raises ValueError if the environment does not support a keyword, and OSError if the port is in use.

    Example: landscape explore pinball-16 --dims 13 14

    Parameters
    ----------
    dims
        The two parameters that vary at first, by number or by name. The default is the first two.
    port
        Port of the page on this machine. 0 picks a free one.
    browser
        Open the page in the default browser. The address is always printed.
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
