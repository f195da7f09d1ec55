"""Network streams over real loopback sockets: RTSP, RTP, MPEG-TS, and Motion JPEG over HTTP."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
import pytest

from mavlink_sim.testing import free_port
from tests.vision.network_streams import QUICK, is_blue, jpeg, read_until_logged, sending, wait_for_frame
from vision.sources import SourceError, SourceSettings, open_source
from vision.sources.network import UdpStream

pytestmark = [pytest.mark.usefixtures("no_proxy"), pytest.mark.realtime]


def test_rtp_jpeg_recovers_from_a_sender_restart(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    settings = SourceSettings(open_timeout_s=20.0, read_timeout_s=0.5, retry_min_s=0.05)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.connect(("127.0.0.1", port))

        def send(packet: bytes) -> None:
            with contextlib.suppress(ConnectionRefusedError):  # there is no listener yet
                out.send(packet)

        with sending(send):
            source = open_source(f"udp://127.0.0.1:{port}?format=rtp-jpeg", settings)
            frame = wait_for_frame(source, is_blue(200))
            assert (frame.width, frame.height) == (128, 96)
        with source:
            read_until_logged(source, caplog, "lost")
            with sending(send, blue=60):
                wait_for_frame(source, is_blue(60))
                assert source.statistics.reopened >= 1


def test_silent_udp_port_names_the_expected_stream(capfd: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    settings = SourceSettings(open_timeout_s=0.5)
    with pytest.raises(SourceError, match=f"no MPEG-TS .*{port}"):
        open_source(f"udp://127.0.0.1:{port}", settings)
    with pytest.raises(SourceError, match=f"no RTP H264 .*{port}"):
        open_source(f"udp://127.0.0.1:{port}?format=rtp-h264", settings)
    assert capfd.readouterr().err == ""


def test_udp_port_in_use_is_reported() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        port = other.getsockname()[1]
        with pytest.raises(SourceError, match=f"{port} is in use"):
            open_source(f"udp://127.0.0.1:{port}", SourceSettings(open_timeout_s=0.5))


@pytest.mark.parametrize(
    ("uri", "lines"),
    [
        (
            "udp://:5600?format=rtp-h264",
            ["c=IN IP4 0.0.0.0", "m=video 5600 RTP/AVP 96", "a=rtpmap:96 H264/90000"],
        ),
        (
            "udp://127.0.0.1:7000?format=rtp-h265&payload=98",
            ["m=video 7000 RTP/AVP 98", "a=rtpmap:98 H265/90000"],
        ),
        ("udp://239.1.2.3:7000?format=rtp-jpeg", ["c=IN IP4 239.1.2.3/16", "m=video 7000 RTP/AVP 26"]),
        ("udp://[::1]:7000?format=rtp-jpeg", ["o=- 0 0 IN IP6 ::1", "c=IN IP6 ::1"]),
    ],
)
def test_session_description_matches_the_address(uri: str, lines: list[str]) -> None:
    text = UdpStream(uri, SourceSettings()).session_description().split("\r\n")
    assert set(lines) <= set(text)


@pytest.mark.parametrize(
    ("container", "codec", "address"),
    [
        pytest.param("mpegts", "mpeg2video", "udp://127.0.0.1:{port}", id="MPEG-TS"),
        pytest.param("rtp", "libx264", "udp://127.0.0.1:{port}?format=rtp-h264", id="RTP H.264"),
    ],
)
def test_an_encoded_stream_over_udp_is_received(container: str, codec: str, address: str) -> None:
    av = pytest.importorskip("av", reason="PyAV encodes the stream; it is not installed")
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV has no {codec}")
    port = free_port()
    stop = threading.Event()

    def send() -> None:
        scheme = "udp" if container == "mpegts" else "rtp"
        with av.open(f"{scheme}://127.0.0.1:{port}?pkt_size=1316", "w", format=container) as out:
            stream = out.add_stream(codec, rate=30)
            stream.width, stream.height, stream.pix_fmt, stream.gop_size = 128, 96, "yuv420p", 5
            if codec == "libx264":
                stream.options = {"preset": "ultrafast", "tune": "zerolatency"}
            image = np.full((96, 128, 3), (200, 90, 20), np.uint8)
            index = 0
            while not stop.wait(1 / 30):
                video_frame = av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format="yuv420p")
                video_frame.pts = index
                index += 1
                out.mux(stream.encode(video_frame))

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    try:
        with open_source(address.format(port=port), QUICK) as source:
            frame = wait_for_frame(source, is_blue(200))
            assert (frame.width, frame.height) == (128, 96)
    finally:
        stop.set()
        sender.join()


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
        later = wait_for_frame(source)
        assert later.sequence > frame.sequence


@pytest.mark.parametrize(
    ("status", "expected"),
    [("401 Unauthorized", r"\(RTSP/1.0 401 Unauthorized\)"), ("404 Not Found", "'RTSP/1.0 404 Not Found'")],
)
def test_rtsp_error_contains_the_servers_response(status: str, expected: str) -> None:
    with RtspServer(status) as server, pytest.raises(SourceError, match=expected):
        open_source(
            f"rtsp://127.0.0.1:{server.port}/live", SourceSettings(open_timeout_s=0.3, retry_min_s=0.1)
        )


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


def test_http_motion_jpeg_recovers_from_a_server_restart(caplog: pytest.LogCaptureFixture) -> None:
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
        read_until_logged(source, caplog, "lost")
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


def test_http_uses_credentials_from_the_address_without_logging(caplog: pytest.LogCaptureFixture) -> None:
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
