"""Motion JPEG over HTTP from a real loopback server, and errors without one."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from mavlink_sim.testing import free_port
from tests.vision.network_streams import QUICK, is_blue, jpeg, wait_for_frame
from vision.sources import SourceError, SourceSettings, open_source

pytestmark = [pytest.mark.usefixtures("no_proxy"), pytest.mark.realtime]


class CameraHandler(BaseHTTPRequestHandler):
    """A web camera; the server sets its image and whether it may send."""

    protocol_version = "HTTP/1.0"
    server: CameraServer

    def do_GET(self) -> None:
        server = self.server
        if server.password and self.headers.get("Authorization") != "Basic dXNlcjpzZSBjcmV0":
            self.send_response(401)
            self.send_header("WWW-Authenticate", 'Basic realm="camera"')
            self.end_headers()
            return
        if self.path != "/video":
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", server.content_type)
        self.end_headers()
        with contextlib.suppress(OSError):
            while not server.stopping.is_set():
                encoded = jpeg(server.blue)
                # The length is wrong on purpose, as with many cameras.
                self.wfile.write(b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: 1\r\n\r\n")
                half = len(encoded) // 2
                self.wfile.write(encoded[:half])
                self.wfile.write(encoded[half:] + b"\r\n")
                server.stopping.wait(0.02)

    def log_message(self, format: str, *arguments: Any) -> None:
        """No log output in tests."""


class CameraServer(ThreadingHTTPServer):
    allow_reuse_address = True

    def __init__(self, port: int = 0, *, blue: int = 200, password: bool = False) -> None:
        super().__init__(("127.0.0.1", port), CameraHandler)
        self.blue = blue
        self.password = password
        self.content_type = "multipart/x-mixed-replace; boundary=frame"
        self.stopping = threading.Event()

    @property
    def port(self) -> int:
        return int(self.server_address[1])


@contextmanager
def serving(server: CameraServer) -> Iterator[CameraServer]:
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.stopping.set()
        server.shutdown()
        server.server_close()
        thread.join()


def test_http_motion_jpeg_recovers_from_a_server_restart(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("WARNING")
    with serving(CameraServer()) as server:
        port = server.port
        source = open_source(f"http://127.0.0.1:{port}/video", QUICK)
        assert source.live
        before_ns = time.monotonic_ns()
        first = wait_for_frame(source, is_blue(200))
        second = wait_for_frame(source, lambda frame: frame.captured_ns > before_ns)
        assert second.sequence > first.sequence
    with source:
        deadline_s = time.monotonic() + 20
        while "lost" not in caplog.text and time.monotonic() < deadline_s:
            source.read(0.05)
        with serving(CameraServer(port, blue=60)):
            wait_for_frame(source, is_blue(60))
            assert source.statistics.reopened == 1
            source.close()
    lines = [record.getMessage() for record in caplog.records]
    assert sum("lost: " in line for line in lines) == 1
    assert sum("recovered after" in line for line in lines) == 1


def test_http_close_does_not_wait_for_a_silent_server() -> None:
    settings = SourceSettings(read_timeout_s=60.0)
    with serving(CameraServer()) as server:
        source = open_source(f"http://127.0.0.1:{server.port}/video", settings)
        closed = threading.Event()

        def close() -> None:
            source.close()
            closed.set()

        server.stopping.set()
        threading.Thread(target=close, daemon=True).start()
        assert closed.wait(30)


def test_http_uses_credentials_from_the_address_without_logging(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("DEBUG")
    with serving(CameraServer(password=True)) as server:
        with open_source(f"http://user:se%20cret@127.0.0.1:{server.port}/video", QUICK) as source:
            wait_for_frame(source, is_blue(200))
            assert source.uri == f"http://user:***@127.0.0.1:{server.port}/video"
        with pytest.raises(SourceError, match=r"HTTP 401.*USER:PASSWORD@") as caught:
            open_source(f"http://user:wr0ng@127.0.0.1:{server.port}/video", QUICK)
    assert "wr0ng" not in str(caught.value)
    assert "cret" not in caplog.text


def test_http_404_fails_at_once() -> None:
    with serving(CameraServer()) as server, pytest.raises(SourceError, match="HTTP 404"):
        open_source(f"http://127.0.0.1:{server.port}/other", QUICK)


def test_http_of_another_type_goes_to_ffmpeg_and_names_it() -> None:
    with serving(CameraServer()) as server:
        server.content_type = "text/plain"
        server.stopping.set()
        with pytest.raises(SourceError, match="text/plain"):
            open_source(
                f"http://127.0.0.1:{server.port}/video", SourceSettings(open_timeout_s=0.5, retry_min_s=0.1)
            )


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("http://127.0.0.1:{port}/video", "connection refused"),
        ("rtsp://user:secret@127.0.0.1:{port}/live", "connection refused"),
    ],
)
def test_refused_connection_is_one_line_without_password(
    address: str, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    uri = address.format(port=free_port(socket.SOCK_STREAM))
    with pytest.raises(SourceError, match=words) as caught:
        open_source(uri, SourceSettings(open_timeout_s=0.3, retry_min_s=0.05))
    assert "secret" not in str(caught.value)
    assert capfd.readouterr().err == ""
