"""RTSP from a real loopback server."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading

import pytest

from tests.vision.network_streams import QUICK, is_blue, sending, wait_for_frame
from vision.sources import SourceError, SourceSettings, open_source
from vision.sources.network import without_password

pytestmark = [pytest.mark.usefixtures("no_proxy"), pytest.mark.realtime]


def test_passwords_are_never_shown() -> None:
    assert without_password("rtsp://me:pw@host:8554/a?b") == "rtsp://me:***@host:8554/a?b"
    assert without_password("rtsp://host/a") == "rtsp://host/a"


class RtspServer:
    """A camera with RTSP (RFC 2326) and its RTP inside the same connection."""

    def __init__(self, status: str = "200 OK") -> None:
        self._status = status
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._connections: list[socket.socket] = []
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                self._connections.append(connection)
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError), contextlib.ExitStack() as streams:
            reader = connection.makefile("rb")
            while request := reader.readline().decode():
                method = request.split(" ")[0]
                headers = {}
                while line := reader.readline().decode().strip():
                    key, _, value = line.partition(":")
                    headers[key.lower()] = value.strip()
                self._answer(connection, method, headers["cseq"])
                if method == "PLAY":
                    streams.enter_context(
                        sending(
                            lambda packet: connection.sendall(
                                struct.pack(">cBH", b"$", 0, len(packet)) + packet
                            )
                        )
                    )
                if method == "TEARDOWN":
                    return

    def _answer(self, connection: socket.socket, method: str, number: str) -> None:
        status = self._status if method == "DESCRIBE" else "200 OK"
        body = ""
        more = {"OPTIONS": "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"}.get(method, "")
        if method == "DESCRIBE" and status == "200 OK":
            lines = (
                "v=0",
                "o=- 0 0 IN IP4 127.0.0.1",
                "s=camera",
                "t=0 0",
                "m=video 0 RTP/AVP 26",
                "a=control:0",
            )
            body = "\r\n".join(lines) + "\r\n"
            more = f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
        if method == "SETUP":
            more = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\n"
        session = "" if method in ("OPTIONS", "DESCRIBE") else "Session: 1\r\n"
        connection.sendall(f"RTSP/1.0 {status}\r\nCSeq: {number}\r\n{session}{more}\r\n{body}".encode())

    def __enter__(self) -> RtspServer:
        return self

    def __exit__(self, *error: object) -> None:
        self._listener.close()
        for connection in self._connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()


def test_rtsp_plays() -> None:
    with RtspServer() as server, open_source(f"rtsp://127.0.0.1:{server.port}/live", QUICK) as source:
        frame = wait_for_frame(source, is_blue(200))
        assert (frame.width, frame.height) == (128, 96)
        later = wait_for_frame(source, lambda frame: True)
        assert later.sequence > frame.sequence


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        ("401 Unauthorized", r"\(RTSP/1.0 401 Unauthorized\)"),
        ("404 Not Found", "'RTSP/1.0 404 Not Found'"),
    ],
)
def test_rtsp_error_contains_the_servers_response(status: str, expected: str) -> None:
    with RtspServer(status) as server, pytest.raises(SourceError, match=expected):
        open_source(
            f"rtsp://127.0.0.1:{server.port}/live", SourceSettings(open_timeout_s=0.3, retry_min_s=0.1)
        )
