"""A web server that answers browsers on this machine only.

Pages of other sites cannot read its answers, unless the name of their site resolves to 127.0.0.1 (DNS rebinding). The
browser then sends that name with its request. The server therefore refuses requests under any other name than this
machine's.
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
    """Serve this machine only; port 0 picks a free port."""

    def __init__(self, port: int, handler: Any) -> None:
        try:
            super().__init__((LOOPBACK, port), handler)
        except OSError as error:
            raise OSError(f"port {port} cannot be served ({error.strerror}); --port 0 picks a free one") from None

    @property
    def address(self) -> str:
        """Return the address for a browser."""
        return f"http://{LOOPBACK}:{self.server_port}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore browsers that disconnect early."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class LoopbackHandler(BaseHTTPRequestHandler):
    """Answer requests under a name of this machine, without a log line for each."""

    def parse_request(self) -> bool:
        """Read a request, and refuse it without exactly one name, or with the name of another machine."""
        if not super().parse_request():
            return False
        hosts = self.headers.get_all("Host", [])
        if len(hosts) == 1 and HOST.fullmatch(hosts[0].strip()):
            return True
        self.send_error(HTTPStatus.MISDIRECTED_REQUEST, "this server answers requests for 127.0.0.1 or localhost only")
        return False

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""
