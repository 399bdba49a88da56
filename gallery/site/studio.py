"""Draw a site's pictures while its pages are written: slices in processes, dark variants in a thread.

    python -m gradscape.gallery.site.studio SOURCE FOLDER [SOURCE FOLDER ...]

draws the slices in the figures' folders into the folders of their pages. It pickles an error to its standard output.
"""

from __future__ import annotations

import pickle
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from types import TracebackType
from typing import Any

from ...landscapes.storage.store import open_slice
from ..files import PICTURE, STORE, THUMBNAIL, RecordFiles, dark_name

MAX_DRAWN_HERE = 4  # slices: a process takes as long to start
MAX_PROCESSES = 4
Reading = Callable[[], AbstractContextManager[Any]]


class Studio:
    """Draw slices and recolour pictures; on exit, wait for all of them and raise the first error."""

    def __init__(self, places: Sequence[tuple[Path, Path]]) -> None:
        self._thread = ThreadPoolExecutor(1)  # what recolours lets go of Python
        self._begun: list[Future[None]] = []
        self._drawers = _start(places) if len(places) > MAX_DRAWN_HERE else []
        if not self._drawers:
            for source, folder in places:
                draw_slice(source, folder)

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._thread.shutdown(cancel_futures=kind is not None)
        for drawer in self._drawers:
            if kind is not None:
                drawer.kill()
            said, _ = drawer.communicate()
            if kind is None and drawer.returncode:
                raise _failure(said, drawer.returncode)
        if kind is None:
            for one in self._begun:
                one.result()

    def develop(self, source: Path, target: Path, within: Reading = nullcontext) -> None:
        """Make the dark variant of a picture next to `target`; the context `within` names the file in an error."""
        self._begun.append(self._thread.submit(_develop, source, target, within))

    def place(self, source: RecordFiles, target: RecordFiles) -> None:
        """Copy a record with its picture into the site, and make the dark variant of the picture."""
        target.record.parent.mkdir(exist_ok=True)
        shutil.copyfile(source.record, target.record)
        shutil.copyfile(source.picture, target.picture)
        self.develop(source.picture, target.picture)


def _start(places: Sequence[tuple[Path, Path]]) -> list[subprocess.Popen[bytes]]:
    """Start processes that draw the slices: one for each core up to a limit, or none on a single core."""
    from ...envs.engines.runtime import cores

    count = min(cores(), MAX_PROCESSES) if cores() > 1 else 0
    shares = [[str(path) for place in places[k::count] for path in place] for k in range(count)]
    command = [sys.executable, "-m", __name__]
    return [subprocess.Popen([*command, *share], stdout=subprocess.PIPE) for share in shares]


def _failure(said: bytes, code: int) -> Exception:
    """Return the error that a process reported, or one with its exit code."""
    try:
        error = pickle.loads(said)  # of a process of our own
        return error if isinstance(error, Exception) else RuntimeError(str(error))
    except (pickle.UnpicklingError, EOFError, AttributeError, ImportError, IndexError):
        return RuntimeError(f"a process that draws slices ended with code {code}; see its output above")


def _develop(source: Path, target: Path, within: Reading) -> None:
    from ...landscapes.draw.figures import dark

    with within():
        dark.save_dark(source, target.with_name(dark_name(target.name)))


def draws(source: Path, rank: int) -> list[str]:
    """Return which pictures of a slice to draw; a line keeps its stored one, because its events need episodes."""
    return [THUMBNAIL] if rank == 1 and (source / PICTURE).exists() else [THUMBNAIL, PICTURE]


def draw_slice(source: Path, folder: Path) -> None:
    """Draw a figure's slice for light and for dark pages."""
    from ...landscapes.draw.figures.contour import landscape_figure
    from ...landscapes.draw.figures.multiples import thumbnail_figure
    from ...landscapes.draw.figures.profile import profile_figure
    from ..league import save_both

    dataset = open_slice(source / STORE)
    rank = len(dataset["loss"].dims)
    save_both(thumbnail_figure(dataset), folder / THUMBNAIL)
    if PICTURE in draws(source, rank):
        save_both((landscape_figure if rank == 2 else profile_figure)(dataset), folder / PICTURE)
    else:
        shutil.copyfile(source / PICTURE, folder / PICTURE)


def main() -> None:
    """Draw the slices named on the command line."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who began it ends it
    places = [Path(one) for one in sys.argv[1:]]
    try:
        for source, folder in zip(places[::2], places[1::2], strict=True):
            draw_slice(source, folder)
    except Exception as error:  # to be raised where it is waited for
        sys.stdout.buffer.write(pickle.dumps(error))
        sys.exit(1)


if __name__ == "__main__":
    main()
