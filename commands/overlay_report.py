"""What `landscape view` does and prints."""

from __future__ import annotations

import os
import shlex
import sys
import time
from pathlib import Path

from ..jobs.folder import RUN_STORE as RUN
from ..jobs.folder import SLICE_STORE as SLICE
from ..landscapes.storage.files import resolved
from .terminal import Console

SITE = "index.html"
SHOWN = (  # of a folder, the first that is there
    *(SITE, "overlay.rrd", "race.png", "landscape.png", "progress.png", "sweep.mp4"),
    *("surface.png", "episode.mp4", "episode.png", "sweep.rrd", "episode.rrd"),
)
PICTURES = (".png", ".html", ".mp4", ".gif")


def view(file: str, *, serve: bool) -> None:
    """Open a file that one of the verbs left, or the picture of a folder."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    path = _shown(Path(file), serve=serve)
    if path.name == SITE and serve:
        raise ValueError(f"a site is served by: landscape gallery serve --out {shlex.quote(str(path.parent))}")
    if path.suffix != ".rrd" and serve:
        raise ValueError(f"--serve shows recordings (.rrd) in a browser; {path} is none")
    if path.suffix == ".rrd":
        show(console, path, serve=serve)
        return
    serving = f"landscape gallery serve --out {shlex.quote(str(path.parent))}"
    need_display(path, f"serve it to a browser: {serving}" if path.name == SITE else "copy it to where one is")
    import typer

    console.print(f"opening {path}", markup=False)
    if typer.launch(str(resolved(path))):
        raise OSError(f"no program of this system opens {path}; open it with one of your own")


def _shown(path: Path, *, serve: bool) -> Path:
    """Return what to open for a path; of a folder that is to be served, first a recording."""
    folder = path.parent if path.name in (SLICE, RUN) else path
    if folder.is_dir():
        for name in sorted(SHOWN, key=lambda name: serve and not name.endswith(".rrd")):
            if (folder / name).exists():
                return folder / name
        raise ValueError(
            f"{path} holds none of {', '.join(SHOWN)}; what `landscape slice`, sweep, optimize, race, overlay, replay "
            "and gallery build leave does"
        )
    if not path.exists():
        raise ValueError(f"there is no file {path}")
    if path.suffix not in (*PICTURES, ".rrd"):
        raise ValueError(f"view opens {', '.join(PICTURES)}, .rrd and results folders; got {path}")
    return path


def show(console: Console, path: Path, *, serve: bool) -> None:
    """Open a recording in rerun's viewer, or serve it to a browser until Ctrl-C."""
    from ..landscapes.draw.recordings.viewer import open_viewer, served

    if not serve:
        need_display(path, f"look at it in a browser: landscape view {shlex.quote(str(path))} --serve")
        console.print(f"opening {path} in rerun's viewer", markup=False)
        open_viewer(path)
        return
    with served(path) as address:
        try:
            console.print(f"{path} is at {address} until Ctrl-C", markup=False)
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            return


def need_display(what: object, instead: str) -> None:
    """Raise ValueError, saying what to do instead, where there is no display to open something on."""
    displays = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in displays):
        raise ValueError(f"there is no display here to open {what} on; {instead}")
