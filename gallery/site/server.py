"""A server of the site for browsers on this machine."""

from __future__ import annotations

import contextlib
import shlex
from functools import partial
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler
from pathlib import Path
from typing import Any

from ...landscapes.draw.loopback import LoopbackHandler, LoopbackServer


class SiteHandler(LoopbackHandler, SimpleHTTPRequestHandler):
    """Serve the files in a folder, without directory listings and without links that lead out of it."""

    def send_head(self) -> Any:
        """Open the requested file if it exists."""
        asked = Path(self.translate_path(self.path))
        with contextlib.suppress(OSError, RuntimeError, ValueError):  # no name of a file, a loop of links
            file = (asked / "index.html" if asked.is_dir() else asked).resolve(strict=True)
            if file.is_file() and file.is_relative_to(Path(self.directory).resolve()):
                return super().send_head()
        self.send_error(HTTPStatus.NOT_FOUND)
        return None


def open_server(out: str, port: int) -> LoopbackServer:
    """Return a server of the site in a folder. Raises ValueError without a site, OSError for a port in use."""
    if not (Path(out) / "index.html").exists():
        raise ValueError(f"{out} contains no gallery; build it with `landscape gallery build --out {shlex.quote(out)}`")
    return LoopbackServer(port, partial(SiteHandler, directory=out))
