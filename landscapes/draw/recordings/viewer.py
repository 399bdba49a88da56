"""Rerun's viewers for a recording; they serve this machine only, and send nothing anywhere."""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from importlib.util import find_spec
from pathlib import Path
from typing import IO
from urllib.error import URLError
from urllib.request import urlopen

from ...storage.files import resolve
from ..loopback import LOOPBACK, LoopbackHandler, LoopbackServer

RECORDING = "/recording.rrd"  # whatever the file's name, which may be none for an address
START_LIMIT = 20.0  # seconds for rerun's server to come up
SILENT = {
    "CI": "true",
    "RUST_LOG": "error",
}  # the first is the one way to switch rerun's usage statistics off for a process and not for the user
ASSETS = {
    "/": "text/html; charset=utf-8",
    "/re_viewer.js": "text/javascript",
    "/re_viewer_bg.wasm": "application/wasm",
    "/favicon.ico": "image/x-icon",
}
# The page asks for a font and may report usage: the browser is told to speak to this server alone.
POLICY = "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:"


def open_viewer(path: Path, *, wait: float = 2.0) -> None:
    """Open a recording in rerun's own window, which stays open when this process ends.

    Raises OSError if the window does not stay open for `wait` seconds, or if rerun's program is not installed.
    """
    with tempfile.TemporaryFile() as log:
        viewer = _rerun(str(resolve(path)), "--port", "auto", log=log)
        try:
            code = viewer.wait(wait)
        except subprocess.TimeoutExpired:
            return
        log.seek(0)
        said = log.read().decode(errors="replace").split("\n\n")[0].strip() or f"exit code {code}"
    raise OSError(f"rerun's viewer could not open a window ({said}); open the recording in a browser with --serve")


@contextmanager
def serve_recording(path: Path) -> Iterator[str]:
    """Serve a recording with rerun's web viewer on the loopback interface, and yield the address to open.

    Raises OSError if rerun's own server does not answer, or if its program is not installed.
    """
    assets = _assets()

    class Handler(LoopbackHandler):
        def do_GET(self) -> None:  # noqa: N802 -- as http.server calls it
            asked = self.path.partition("?")[0]
            body = assets.get(asked)
            if asked == RECORDING:
                with suppress(OSError):  # it was there when the server started
                    body = path.read_bytes()
            if body is None:
                self.send_error(HTTPStatus.NOT_FOUND)
                return
            self.send_response(200)
            self.send_header("Content-Type", ASSETS.get(asked, "application/octet-stream"))
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Security-Policy", POLICY)
            self.end_headers()
            self.wfile.write(body)

    with LoopbackServer(0, Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"{server.address}/?url={server.address}{RECORDING}&hide_welcome_screen"
        finally:
            server.shutdown()


def _assets() -> dict[str, bytes]:
    """Get the web viewer's files from rerun's server, because the package does not contain them as files."""
    port, other = _free_port(), _free_port()
    server = _rerun("--serve-web", "--web-viewer-port", str(port), "--port", str(other), log=subprocess.DEVNULL)
    try:
        return {name: _fetch(f"http://{LOOPBACK}:{port}{name}", server) for name in ASSETS}
    finally:
        server.terminate()
        server.wait()


def _fetch(address: str, server: subprocess.Popen[bytes]) -> bytes:
    """Return the answer of a server that may still be starting."""
    deadline = time.monotonic() + START_LIMIT
    while True:
        try:
            with urlopen(address) as answer:
                found: bytes = answer.read()
                return found
        except URLError:
            if server.poll() is not None or time.monotonic() > deadline:
                raise OSError(f"rerun's web viewer does not answer at {address}; try --spawn") from None
            time.sleep(0.05)


def _rerun(*arguments: str, log: int | IO[bytes]) -> subprocess.Popen[bytes]:
    spec = find_spec("rerun_cli")
    if spec is None or not spec.submodule_search_locations:
        raise OSError("rerun's viewer is not installed next to its library; reinstall rerun-sdk")
    program = Path(next(iter(spec.submodule_search_locations))) / ("rerun.exe" if os.name == "nt" else "rerun")
    return subprocess.Popen(
        [str(program), "--bind", LOOPBACK, *arguments],
        env=os.environ | SILENT, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log,
        start_new_session=True,
    )  # fmt: skip


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])
