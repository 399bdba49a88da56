"""The verb `view`: open the results of other verbs in a suitable viewer."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

from .call import current, verb
from .options import ARGUMENT

SITE = "index.html"
SHOWN = (  # of a folder, the first that is there
    *(SITE, "overlay.rrd", "race.png", "landscape.png", "progress.png", "sweep.mp4"),
    *("surface.png", "episode.mp4", "episode.png", "sweep.rrd", "episode.rrd"),
)
PICTURES = (".png", ".html", ".mp4", ".gif")
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")  # variables of the environment that name one


@verb
def view(file: Annotated[str, ARGUMENT], *, serve: bool = False) -> None:
    """Open the results of other verbs in a viewer.

    Pictures, films and pages open in the default programs of this system. Recordings (.rrd) open in the rerun viewer,
    or in a browser with --serve. It writes no file.

    Example: landscape view out/my-episode --serve

    Parameters
    ----------
    file
        A picture, a film, a page, a recording (.rrd), or a results folder.
    serve
        Serve a recording to a browser, until Ctrl-C.
    """
    path = _choose(Path(file), serve=serve)
    if path.suffix == ".rrd":
        show_recording(path, serve=serve)
    else:
        _open(path, serve=serve)


def show_recording(path: Path, *, serve: bool) -> None:
    """Show a recording in rerun's viewer, or serve it to a browser until Ctrl-C.

    Raises ValueError where a window is wanted and there is no display, OSError where the viewer does not come up.
    """
    from ..landscapes.draw.recordings.viewer import open_viewer, serve_recording

    note = current().watch.note
    if not serve:
        check_display(path, f"open it in a browser with: landscape view {shlex.quote(str(path))} --serve")
        note(f"opening {path} in rerun's viewer")
        open_viewer(path)
        return
    with serve_recording(path) as address:
        try:
            note(f"{path} is at {address} until Ctrl-C")
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            return


def has_display() -> bool:
    """Whether there is a display here for a window."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in DISPLAYS)


def check_display(path: Path, instead: str) -> None:
    """Raise ValueError, saying what to do `instead`, where there is no display to open a file on."""
    if not has_display():
        raise ValueError(f"this machine has no display to open {path} on; {instead}")


def _open(path: Path, *, serve: bool) -> None:
    """Open a picture, a film or a page with this system's program for it."""
    from ..landscapes.storage.files import resolve

    serving = f"landscape gallery serve --out {shlex.quote(str(path.parent))}"
    if serve and path.name == SITE:
        raise ValueError(f"view does not serve a site; serve it with: {serving}")
    if serve:
        raise ValueError(f"--serve shows only recordings (.rrd) in a browser; got {path}")
    instead = f"serve it to a browser with: {serving}" if path.name == SITE else "copy it to a machine with a display"
    check_display(path, instead)
    current().watch.note(f"opening {path}")
    if not launch(resolve(path)):
        raise OSError(f"this system has no program that opens {path}; open the file yourself")


def launch(path: Path) -> bool:
    """Open a file with this system's program for it, and say whether there is one."""
    program = "open" if sys.platform == "darwin" else "xdg-open"
    try:
        return subprocess.run([program, str(path)], capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


def _choose(path: Path, *, serve: bool) -> Path:
    """Return what to open for a path; of a folder that is to be served, first a recording."""
    from ..jobs.folder import RUN_STORE, SLICE_FILE, SLICE_STORE

    folder = path.parent if path.name in (SLICE_STORE, SLICE_FILE, RUN_STORE) else path
    if folder.is_dir():
        for name in sorted(SHOWN, key=lambda name: serve and not name.endswith(".rrd")):
            if (folder / name).exists():
                return folder / name
        raise ValueError(
            f"{path} contains none of {', '.join(SHOWN)}; give a folder that `landscape slice`, sweep, optimize, race, "
            "overlay, replay or gallery build has written"
        )
    if not path.exists():
        raise ValueError(f"view found no file or folder {path}; check the path")
    if path.suffix not in (*PICTURES, ".rrd"):
        raise ValueError(f"view opens {', '.join(PICTURES)}, .rrd and results folders; got {path}")
    return path
