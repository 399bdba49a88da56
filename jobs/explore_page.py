"""The explorer's web server: its page, and what the page asks for."""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from http import HTTPStatus
from threading import Thread
from typing import Any
from urllib.parse import parse_qs, urlsplit

from ..landscapes.convert import to_json
from ..landscapes.draw.loopback import LoopbackHandler, LoopbackServer
from ..landscapes.draw.pages.explore import explore_page
from .explore import Exploration, Look

LARGEST = 4_000_000  # bytes of a question
POLICY = "; ".join(  # of the page: it holds its scripts, and asks nobody but this server
    f"{what}-src {whence}"
    for what, whence in {
        "default": "'none'", "script": "'unsafe-inline'", "style": "'unsafe-inline'", "img": "data: blob:",
        "media": "data:", "connect": "'self'",
    }.items()
)  # fmt: skip


class Explorer:
    """A local page that samples a landscape while you look at it; `address` is its address for a browser.

    A notebook shows the page. `close` ends it, and it also ends with the program.
    """

    def __init__(self, exploration: Exploration, port: int) -> None:
        """Serve the page at a port, 0 for a free one. Raises OSError for one in use."""
        self.exploration, self.token = exploration, secrets.token_urlsafe(16)
        self._server = LoopbackServer(port, partial(ExplorerHandler, explorer=self))
        self._server.daemon_threads = True
        self.address = f"{self._server.address}/?token={self.token}"
        self._thread = Thread(target=self._server.serve_forever, name="explorer", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving the page."""
        self.exploration.close()
        if self._thread.is_alive():
            self._server.shutdown()
        self._server.server_close()

    def wait(self) -> None:
        """Wait until the page is no longer served."""
        while self._thread.is_alive():
            self._thread.join(1.0)

    def page(self) -> str:
        """Return the page, with the first picture of the plane."""
        seen = self.exploration.wait(-1)
        while seen.slice is None and not seen.complete:
            seen = self.exploration.wait(seen.number)
        env, look = self.exploration.env, self.exploration.look
        fidelity = f", {env.fidelity.name} fidelity" if env.fidelity.name else ""
        about = f"{env.space.dim} parameters{fidelity}, {env.device}"
        return explore_page(
            env.space, self.exploration.nodes(seen), title=env.name, about=about,
            look={"dims": look.dims, "at": look.at}, gradients=env.has_gradient,
        )  # fmt: skip

    def answer(self, question: str, asked: Mapping[str, Any]) -> Any:
        """Answer the page, in plain JSON.

        Raises ValueError for an invalid request, and KeyError for an unknown one.
        """
        exploration = self.exploration
        if question == "look":
            exploration.turn(Look((int(asked["dims"][0]), int(asked["dims"][1])), tuple(map(float, asked["at"]))))
            return {}
        if question == "seen":
            seen = exploration.wait(int(asked["number"]))
            nodes = None if seen.slice is None else exploration.nodes(seen)
            return {**to_json(replace(seen, slice=None)), "slice": nodes}
        if question == "film":
            return to_json(exploration.film(asked["at"]))
        if question == "descend":
            return to_json(exploration.descend(asked["at"], everywhere=bool(asked["everywhere"])))
        if question == "keep":
            return to_json(exploration.keep())
        raise KeyError(question)

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.address}" width="100%" height="900" style="border: 0"></iframe>'


class ExplorerHandler(LoopbackHandler):
    """Answer clients that know the token: GET returns the page, POST answers its requests."""

    def __init__(self, *given: Any, explorer: Explorer) -> None:
        """Answer a request to an explorer."""
        self.explorer = explorer
        super().__init__(*given)

    def do_GET(self) -> None:  # noqa: N802 # its name is the base's
        """Send the page."""
        address = urlsplit(self.path)
        token = parse_qs(address.query).get("token", [""])[0]
        if not self._is_known(token):
            return
        if address.path != "/":
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self._send(HTTPStatus.OK, self.explorer.page().encode(), "text/html; charset=utf-8")

    def do_POST(self) -> None:  # noqa: N802 # its name is the base's
        """Answer a question of the page, in JSON."""
        length = self.headers.get("Content-Length", "")
        if not self._is_known(self.headers.get("Authorization", "").removeprefix("Bearer ")):
            return
        if not length.isdecimal() or int(length) > LARGEST:
            self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            return
        try:
            asked = json.loads(self.rfile.read(int(length)))
            found, status = self.explorer.answer(self.path.strip("/"), asked), HTTPStatus.OK
        except (KeyError, TypeError, IndexError):
            found, status = {"error": f"the explorer has no such request: {self.path}"}, HTTPStatus.BAD_REQUEST
        except Exception as error:  # of a simulator, which may raise anything: the page says it
            found, status = {"error": f"{type(error).__name__}: {error}"}, HTTPStatus.BAD_REQUEST
        self._send(status, json.dumps(found).encode(), "application/json")

    def _is_known(self, token: str) -> bool:
        if secrets.compare_digest(token.encode(), self.explorer.token.encode()):
            return True
        self.send_error(HTTPStatus.FORBIDDEN, "open the address that the explorer printed, with its token")
        return False

    def _send(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self.send_response(status)
        for name, value in {
            "Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer", "Content-Security-Policy": POLICY,
        }.items():  # fmt: skip
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)
