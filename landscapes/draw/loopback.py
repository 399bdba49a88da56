"""A web server that answers browsers of this machine, and no page from elsewhere.

Pages of other sites cannot read what it answers, unless the name of their site is made to mean 127.0.0.1 (DNS
rebinding). A browser then asks for that name, so that what is asked for under another name than this machine's is
refused.
"""

from __future__ import annotations

import re
import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

LOOPBACK = "127.0.0.1"
HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d+)?", re.IGNORECASE)  # the port may be that of a tunnel


class LoopbackServer(ThreadingHTTPServer):
    """Serve this machine only; port 0 takes a free one."""

    def __init__(self, port: int, handler: Any) -> None:
        try:
            super().__init__((LOOPBACK, port), handler)
        except OSError as error:
            raise OSError(f"port {port} cannot be served ({error.strerror}); --port 0 takes a free one") from None

    @property
    def address(self) -> str:
        """Return where a browser finds it."""
        return f"http://{LOOPBACK}:{self.server_port}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of browsers that leave before they have everything."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class LoopbackHandler(BaseHTTPRequestHandler):
    """Answer what is asked for under a name of this machine, without a line per request."""

    def parse_request(self) -> bool:
        """Read a request, and refuse one under another name, or under none or two."""
        if not super().parse_request():
            return False
        hosts = self.headers.get_all("Host", [])
        if len(hosts) == 1 and HOST.fullmatch(hosts[0].strip()):
            return True
        self.send_error(HTTPStatus.MISDIRECTED_REQUEST, "ask for 127.0.0.1 or localhost")
        return False

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""
