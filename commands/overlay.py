"""An overlay, opened once it is drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .terminal import Console

if TYPE_CHECKING:
    from ..jobs.overlay import Overlay


def show(found: Overlay, console: Console, *, spawn: bool = False, serve: bool = False) -> None:
    """Open the overlay in a viewer, if asked.

    Parameters
    ----------
    spawn
        Open the overlay in the rerun viewer.
    serve
        Serve the overlay to a browser on this machine, until Ctrl-C.
    """
    from ..api.view import check_display, show_recording
    from ..jobs.overlay import STREAM

    if spawn and not serve:
        check_display(found.folder / STREAM, "leave out --spawn, or take --serve to look at it in a browser")
    if spawn or serve:
        show_recording(found.folder / STREAM, serve=serve)
