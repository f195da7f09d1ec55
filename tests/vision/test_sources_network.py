"""Streams over real loopback sockets: HTTP Motion JPEG, RTP, RTSP and MPEG-TS."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.request import getproxies

import cv2
import numpy as np
import pytest

from vision.frame import Frame
from vision.sources import Source, SourceError, SourceSettings, open_source
from vision.sources.network import UdpStream, without_password

QUICK = SourceSettings(open_timeout_s=20.0, read_timeout_s=2.0, retry_min_s=0.05, retry_max_s=0.2)


@pytest.fixture(autouse=True)
def _no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loopback is asked directly, whatever the machine's environment says."""
    for name in getproxies():
        monkeypatch.delenv(f"{name}_proxy", raising=False)
        monkeypatch.delenv(f"{name.upper()}_PROXY", raising=False)


def jpeg(blue: int) -> bytes:
    image = np.full((48, 64, 3), (blue, 90, 20), np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def wait_for_frame(source: Source, wanted: Callable[[Frame], bool], within_s: float = 30.0) -> Frame:
    deadline_s = time.monotonic() + within_s
    while time.monotonic() < deadline_s:
        frame = source.read(0.5)
        if frame is not None and wanted(frame):
            return frame
    raise AssertionError(f"no such frame within {within_s} s")


def is_blue(value: int) -> Callable[[Frame], bool]:
    return lambda frame: abs(int(frame.image[24, 32, 0]) - value) < 12


def free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


# --- HTTP


class CameraHandler(BaseHTTPRequestHandler):
    """A web camera; what it shows, and whether it may, is its server's."""

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
                picture = jpeg(server.blue)
                # The length is wrong on purpose, as many a camera's is.
                self.wfile.write(b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: 1\r\n\r\n")
                half = len(picture) // 2
                self.wfile.write(picture[:half])
                self.wfile.write(picture[half:] + b"\r\n")
                server.stopping.wait(0.02)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Tests are quiet."""


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


def test_http_motion_jpeg_is_live_and_its_server_may_stop_and_return(
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
    assert sum("back after" in line for line in lines) == 1


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


def test_http_takes_user_and_password_from_the_address_and_shows_neither(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("DEBUG")
    with serving(CameraServer(password=True)) as server:
        with open_source(f"http://user:se%20cret@127.0.0.1:{server.port}/video", QUICK) as source:
            wait_for_frame(source, is_blue(200))
            assert source.uri == f"http://user:***@127.0.0.1:{server.port}/video"
        with pytest.raises(
            SourceError, match=r"asks for a user and password .*HTTP 401.*USER:PASSWORD@"
        ) as caught:
            open_source(f"http://user:wr0ng@127.0.0.1:{server.port}/video", QUICK)
    assert "wr0ng" not in str(caught.value)
    assert "cret" not in caplog.text


def test_http_with_nothing_there_says_so_at_once() -> None:
    with serving(CameraServer()) as server, pytest.raises(SourceError, match="has nothing there"):
        open_source(f"http://127.0.0.1:{server.port}/other", QUICK)


def test_http_of_another_kind_goes_to_ffmpeg_and_its_failure_names_the_kind() -> None:
    with serving(CameraServer()) as server:
        server.content_type = "text/plain"
        server.stopping.set()
        with pytest.raises(SourceError, match="the server sends text/plain, and no video"):
            open_source(
                f"http://127.0.0.1:{server.port}/video", SourceSettings(open_timeout_s=0.5, retry_min_s=0.1)
            )


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("http://127.0.0.1:{port}/video", "connection refused; is the server running"),
        ("rtsp://user:secret@127.0.0.1:{port}/live", "connection refused; is the camera on"),
    ],
)
def test_nobody_listening_is_one_clear_line_without_the_password(
    address: str, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    uri = address.format(port=free_port(socket.SOCK_STREAM))
    with pytest.raises(SourceError, match=words) as caught:
        open_source(uri, SourceSettings(open_timeout_s=0.3, retry_min_s=0.05))
    assert "secret" not in str(caught.value)
    assert capfd.readouterr().err == ""


# --- RTP


def rtp_packets(image: np.ndarray[Any, Any], sequence: int, timestamp: int) -> list[bytes]:
    """One picture as RTP packets of JPEG (RFC 2435), its quantisation tables in the first."""
    data = cv2.imencode(
        ".jpg", image, [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    )[1]
    jpeg_bytes = data.tobytes()
    tables, position = b"", 2
    while jpeg_bytes[position + 1] != 0xDA:
        length = int.from_bytes(jpeg_bytes[position + 2 : position + 4], "big")
        if jpeg_bytes[position + 1] == 0xDB:
            tables += b"".join(
                jpeg_bytes[at + 1 : at + 65] for at in range(position + 4, position + 2 + length, 65)
            )
        position += 2 + length
    position += 2 + int.from_bytes(jpeg_bytes[position + 2 : position + 4], "big")
    scan = jpeg_bytes[position:-2]
    height, width = image.shape[:2]
    packets, offset = [], 0
    while offset < len(scan):
        chunk = scan[offset : offset + 1000]
        last = offset + len(chunk) == len(scan)
        header = struct.pack(
            ">BBHII", 0x80, 26 | (0x80 if last else 0), (sequence + len(packets)) & 0xFFFF, timestamp, 0x1234
        )
        header += struct.pack(">I", offset) + bytes([1, 255, width // 8, height // 8])
        if offset == 0:
            header += struct.pack(">BBH", 0, 0, len(tables)) + tables
        packets.append(header + chunk)
        offset += len(chunk)
    return packets


@contextmanager
def sending(send: Callable[[bytes], object], blue: int = 200) -> Iterator[None]:
    """Sends a picture of that blue thirty times a second."""
    stop = threading.Event()
    image = np.full((96, 128, 3), (blue, 90, 20), np.uint8)

    def run() -> None:
        sequence = timestamp = 0
        with contextlib.suppress(OSError):
            while not stop.wait(1 / 30):
                packets = rtp_packets(image, sequence, timestamp)
                for packet in packets:
                    send(packet)
                sequence += len(packets)
                timestamp += 3000

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_rtp_jpeg_is_received_and_its_sender_may_stop_and_return(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port(socket.SOCK_DGRAM)
    settings = SourceSettings(open_timeout_s=20.0, read_timeout_s=0.5, retry_min_s=0.05)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.connect(("127.0.0.1", port))

        def send(packet: bytes) -> None:
            with contextlib.suppress(ConnectionRefusedError):  # nobody listens yet
                out.send(packet)

        with sending(send):
            source = open_source(f"udp://127.0.0.1:{port}?format=rtp-jpeg", settings)
            frame = wait_for_frame(source, is_blue(200))
            assert (frame.width, frame.height) == (128, 96)
        with source:
            deadline_s = time.monotonic() + 20
            while "lost" not in caplog.text and time.monotonic() < deadline_s:
                source.read(0.05)
            with sending(send, blue=60):
                wait_for_frame(source, is_blue(60))
                assert source.statistics.reopened >= 1


def test_a_udp_port_where_nothing_comes_says_what_was_expected(capfd: pytest.CaptureFixture[str]) -> None:
    port = free_port(socket.SOCK_DGRAM)
    settings = SourceSettings(open_timeout_s=0.5)
    with pytest.raises(SourceError, match=f"no MPEG-TS came on UDP port {port}; is the sender sending"):
        open_source(f"udp://127.0.0.1:{port}", settings)
    with pytest.raises(SourceError, match=f"no RTP H264 came on UDP port {port}"):
        open_source(f"udp://127.0.0.1:{port}?format=rtp-h264", settings)
    assert capfd.readouterr().err == ""


def test_a_udp_port_in_use_says_so() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        port = other.getsockname()[1]
        with pytest.raises(SourceError, match=f"UDP port {port} is taken by another program"):
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
def test_the_session_description_says_what_the_address_says(uri: str, lines: list[str]) -> None:
    text = UdpStream(uri, SourceSettings()).session_description().split("\r\n")
    assert set(lines) <= set(text)


def test_a_payload_type_out_of_range_is_refused() -> None:
    with pytest.raises(SourceError, match="payload must be an RTP payload type from 0 to 127, got '200'"):
        UdpStream("udp://:5600?format=rtp-h264&payload=200", SourceSettings())


def test_passwords_are_never_shown() -> None:
    assert without_password("rtsp://me:pw@host:8554/a?b") == "rtsp://me:***@host:8554/a?b"
    assert without_password("rtsp://host/a") == "rtsp://host/a"


# --- RTSP


class RtspServer:
    """A camera that speaks RTSP (RFC 2326) with its RTP inside the same connection."""

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
    ("status", "words"),
    [
        ("401 Unauthorized", r"asks for a user and password \(RTSP/1.0 401 Unauthorized\)"),
        ("404 Not Found", "answers 'RTSP/1.0 404 Not Found'; is the path right"),
    ],
)
def test_rtsp_refused_says_what_the_server_said(status: str, words: str) -> None:
    with RtspServer(status) as server, pytest.raises(SourceError, match=words):
        open_source(
            f"rtsp://127.0.0.1:{server.port}/live", SourceSettings(open_timeout_s=0.3, retry_min_s=0.1)
        )


# --- what needs an encoder


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
    port = free_port(socket.SOCK_DGRAM)
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
                picture = av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format="yuv420p")
                picture.pts = index
                index += 1
                out.mux(stream.encode(picture))

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    try:
        with open_source(address.format(port=port), QUICK) as source:
            frame = wait_for_frame(source, is_blue(200))
            assert (frame.width, frame.height) == (128, 96)
    finally:
        stop.set()
        sender.join()
