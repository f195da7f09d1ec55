"""Motion JPEG over HTTP: a stream at `/` (`multipart/x-mixed-replace`), one image at `/snapshot.jpg`."""

from __future__ import annotations

import logging
import socket
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2

from mavlink_sim.camera.newest_frame import NewestFrame
from vision.frame import Frame

logger = logging.getLogger(__name__)

BOUNDARY = "frame"
MAX_CLIENTS = 16
SEND_TIMEOUT_S = 5.0
"""A client that reads nothing for this long is dropped."""
JPEG_QUALITY = 85


class MjpegOutput:
    """An HTTP server: `/` streams, `/snapshot.jpg` is one image.

    Args:
        host: address to listen on; "127.0.0.1" accepts only clients of this host.
        port: 0 selects a free one, see `port`.

    Raises:
        OSError: the port is taken.
    """

    def __init__(self, host: str, port: int) -> None:
        self._jpeg: bytes | None = None
        self._stamp_ns = 0
        self._number = 0
        self._clients = 0
        self._closed = False
        self._changed = threading.Condition()
        output = self

        class Handler(_Handler):
            source = output

        self._server = _Server((host, port), Handler)
        self.host, self.port = host, int(self._server.server_address[1])
        self._encoder = NewestFrame(f"mjpeg {self.port}", self._encode)
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, name="mjpeg server", daemon=True
        )
        self._thread.start()

    @property
    def clients(self) -> int:
        """The number of clients."""
        return self._clients

    def write(self, frame: Frame) -> None:
        if self._clients:
            self._encoder.put(frame)

    def close(self) -> None:
        with self._changed:
            if self._closed:
                return
            self._closed = True
            self._changed.notify_all()
        self._encoder.close()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(2.0)

    def _encode(self, frame: Frame) -> None:
        done, jpeg = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not done:
            logger.error("cannot encode a frame of %dx%d as JPEG", frame.width, frame.height)
            return
        with self._changed:
            self._jpeg, self._stamp_ns, self._number = jpeg.tobytes(), frame.captured_ns, self._number + 1
            self._changed.notify_all()

    def enter(self) -> bool:
        """Register a client; False if there are too many."""
        with self._changed:
            if self._clients >= MAX_CLIENTS:
                return False
            self._clients += 1
            return True

    def leave(self) -> None:
        """Unregister a client."""
        with self._changed:
            self._clients -= 1

    def after(self, number: int) -> tuple[bytes, int, int] | None:
        """(image, stamp in ns, number) of the first image newer than a number; None when closed."""
        with self._changed:
            while not self._closed and (self._jpeg is None or self._number <= number):
                self._changed.wait()
            if self._closed or self._jpeg is None:
                return None
            return self._jpeg, self._stamp_ns, self._number

    @property
    def number(self) -> int:
        """How many images have been encoded."""
        return self._number


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: Any, client_address: Any) -> None:
        logger.exception("serving %s failed", client_address)


class _Handler(BaseHTTPRequestHandler):
    source: MjpegOutput
    timeout = SEND_TIMEOUT_S

    def do_GET(self) -> None:
        if self.path not in ("/", "/stream", "/stream.mjpg", "/snapshot.jpg"):
            self.send_error(HTTPStatus.NOT_FOUND, "the stream is at /, one image at /snapshot.jpg")
            return
        if not self.source.enter():
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_CLIENTS} clients are served already")
            return
        try:
            if self.path == "/snapshot.jpg":
                self._snapshot()
            else:
                self._stream()
        except (ConnectionError, TimeoutError) as error:
            logger.info("client %s has gone: %s", self.client_address, error)
        finally:
            self.source.leave()
            self.close_connection = True

    def _snapshot(self) -> None:
        entry = self.source.after(self.source.number)
        if entry is None:
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, "the camera has closed")
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "image/jpeg")
        self.send_header("Content-Length", str(len(entry[0])))
        self.send_header("X-Captured-Ns", str(entry[1]))
        self.end_headers()
        self.wfile.write(entry[0])

    def _stream(self) -> None:
        # Little is kept in the kernel for a client: what waits there is old.
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 16)
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        number = self.source.number
        while (entry := self.source.after(number)) is not None:
            jpeg, stamp_ns, number = entry
            head = (
                f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n"
                f"X-Captured-Ns: {stamp_ns}\r\n\r\n"
            )
            self.wfile.write(head.encode("ascii") + jpeg + b"\r\n")

    def log_message(self, format: str, *args: object) -> None:
        logger.info("%s " + format, self.client_address, *args)
