"""An HTTP server in threads whose silent clients cannot fill the service's process with threads."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from socketserver import ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

MAX_CONNECTIONS = 8
"""Each has a thread; of more, the oldest is closed."""


class _Handler(WSGIRequestHandler):
    timeout = 5.0  # of each read, seconds

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


class _Server(ThreadingMixIn, WSGIServer):
    """A server whose silent clients cannot fill the service's process with threads."""

    daemon_threads = True
    request_queue_size = 128

    def server_bind(self) -> None:
        self._open: dict[socket.socket, None] = {}
        self._lock = threading.Lock()
        super().server_bind()

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            self._open[request] = None
            oldest = next(iter(self._open)) if len(self._open) > MAX_CONNECTIONS else None
            if oldest is not None:
                del self._open[oldest]
        if oldest is not None:
            with suppress(OSError):  # it has just ended
                oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)


class _Server6(_Server):
    address_family = socket.AF_INET6


def open_server(host: str, port: int, application: Any) -> WSGIServer:
    """Open a server on an address, not served yet. `application`: WSGI (PEP 3333). Raises OSError."""
    return make_server(host, port, application, _Server6 if ":" in host else _Server, _Handler)
