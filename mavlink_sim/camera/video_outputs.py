"""The outputs of a camera: shared memory, a pipe, Motion JPEG over HTTP, H.264 in RTP. One address each.

| address | content |
|---|---|
| `shm://NAME` | colour, depth and stamps (`vision.shared_frame`) |
| `pipe:PATH` | raw bgr24 images through a FIFO, created if missing; `pipe:-` is standard output |
| `http://HOST:PORT` | Motion JPEG at `/` (`multipart/x-mixed-replace`), one image at `/snapshot.jpg` |
| `rtp://HOST:PORT` | H.264 in RTP (RFC 6184), payload type 96, as PX4's Gazebo camera sends to UDP 5600 |

A slow or stopped reader loses frames; it never delays the camera or another reader.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import select
import socket
import stat
import sys
import threading
from collections.abc import Callable
from fractions import Fraction
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from typing import Any, Protocol
from urllib.parse import urlsplit

import cv2

from vision.camera_model import CameraCalibration
from vision.extras import install_command
from vision.frame import Frame
from vision.shared_frame import SharedFrameWriter, segment_path

CLOCK_HZ = 90_000
PACKET_BYTES = 1400
BITS_PER_PIXEL = 0.2
"""Sets the bit rate: 640×480 at 30 Hz is about 1.8 Mbit/s."""


class RtpOutput:
    """Sends to one host and port, which may be a multicast group.

    Raises (when made):
        ValueError: a size that H.264 with subsampled colour does not support.
        ModuleNotFoundError: PyAV is not installed (`check_output` says what to install), or it has no H.264
            encoder.
    """

    def __init__(self, host: str, port: int, width: int, height: int, rate_hz: float) -> None:
        if width % 2 or height % 2:
            raise ValueError(f"H.264 needs even sides, got {width}x{height}")
        import av

        if "libx264" not in av.codecs_available:
            raise ModuleNotFoundError(
                "this PyAV was built without libx264, which encodes the stream", name="av"
            )
        self._av: Any = av
        address = f"[{host}]" if ":" in host else host
        self._container: Any = av.open(f"rtp://{address}:{port}?pkt_size={PACKET_BYTES}", "w", format="rtp")
        rate = max(1, round(rate_hz))
        stream: Any = self._container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.time_base = Fraction(1, CLOCK_HZ)
        stream.codec_context.gop_size = rate
        stream.bit_rate = round(BITS_PER_PIXEL * width * height * rate)
        stream.options = {"preset": "ultrafast", "tune": "zerolatency", "profile": "baseline"}
        self._stream = stream
        self._first_ns: int | None = None
        self._last_pts = -1
        self._failed = False
        self._thread: NewestFrame | None = NewestFrame(f"rtp {port}", self._send)

    def write(self, frame: Frame) -> None:
        if self._thread is not None:
            self._thread.put(frame)

    def close(self) -> None:
        if self._thread is not None:
            self._thread.close()
            self._thread = None
            self._container.close()

    def _send(self, frame: Frame) -> None:
        if self._first_ns is None:
            self._first_ns = frame.captured_ns
        pts = (frame.captured_ns - self._first_ns) * CLOCK_HZ // 1_000_000_000
        if pts <= self._last_pts:
            return  # RTP needs increasing stamps
        self._last_pts = pts
        image = self._av.VideoFrame.from_ndarray(frame.image, format="bgr24").reformat(format="yuv420p")
        image.pts, image.time_base = pts, Fraction(1, CLOCK_HZ)
        try:
            for packet in self._stream.encode(image):
                self._container.mux(packet)
        except OSError as error:  # no listener on a port of this host, or the network is down
            if not self._failed:
                logger.warning("sending RTP failed: %s; retrying with every frame", error)
            self._failed = True
        else:
            self._failed = False


_PIPE_BYTES = 1 << 20
_WAIT_MS = 200


class PipeOutput:
    """Raw bgr24 images in sequence into a FIFO or standard output; only complete ones.

    Raises (when made):
        ValueError: the path is something other than a FIFO.
        OSError: the FIFO cannot be made.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self._made = False
        self._closed = threading.Event()
        self._descriptor: int | None = None
        if path == "-":
            self._descriptor = os.dup(sys.stdout.fileno())
        else:
            try:
                os.mkfifo(path, 0o600)
                self._made = True
            except FileExistsError:
                if not stat.S_ISFIFO(os.stat(path).st_mode):
                    raise ValueError(
                        f"pipe:{path}: must be a FIFO or not exist yet, but another file is there"
                    ) from None
        self._thread = NewestFrame(f"pipe {path}", self._send)

    def write(self, frame: Frame) -> None:
        self._thread.put(frame)

    def close(self) -> None:
        self._closed.set()
        self._thread.close()
        self._hang_up()
        if self._made:
            self._made = False
            with contextlib.suppress(FileNotFoundError):
                os.unlink(self.path)

    def _send(self, frame: Frame) -> None:
        if self._descriptor is None and not self._reader_found():
            return
        rest = frame.image.data.cast("B")
        assert self._descriptor is not None
        watch = select.poll()
        watch.register(self._descriptor, select.POLLOUT)
        while rest and not self._closed.is_set():
            if not watch.poll(_WAIT_MS):
                continue  # the reader is slow; newer frames replace the waiting ones
            try:
                rest = rest[os.write(self._descriptor, rest[: 1 << 16]) :]
            except BlockingIOError:
                continue
            except BrokenPipeError:
                logger.info("the reader of pipe:%s has closed it", self.path)
                self._hang_up()
                if self.path == "-":  # no reader can reopen it
                    self._closed.set()
                return

    def _reader_found(self) -> bool:
        if self._closed.is_set():
            return False
        try:
            self._descriptor = os.open(self.path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            if error.errno not in (errno.ENXIO, errno.ENOENT):  # no reader, or the FIFO was removed
                logger.error("pipe:%s cannot be opened: %s", self.path, error.strerror)
                self._closed.set()
            return False
        with contextlib.suppress(OSError):  # above the user's limit: the default size does
            fcntl.fcntl(self._descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        return True

    def _hang_up(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


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


class NewestFrame:
    """A thread that hands frames on to something slow: the newest one each time, the others are dropped.

    Attributes:
        dropped: frames that a newer one took the place of.
    """

    def __init__(self, name: str, take: Callable[[Frame], None]) -> None:
        self.dropped = 0
        self._take = take
        self._frame: Frame | None = None
        self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, frame: Frame) -> None:
        """Pass a frame; never blocks."""
        with self._changed:
            self.dropped += self._frame is not None
            self._frame = frame
            self._changed.notify()

    def close(self, timeout_s: float = 2.0) -> None:
        """End the thread after the current frame."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._frame is None and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                frame, self._frame = self._frame, None
            assert frame is not None
            self._take(frame)


SCHEMES = ("shm://NAME", "pipe:PATH", "pipe:-", "http://HOST:PORT", "rtp://HOST:PORT")
STANDARD_OUTPUT = "pipe:-"


class FrameOutput(Protocol):
    """An output of frames. `write` does not block; `close` may be called more than once."""

    def write(self, frame: Frame) -> None: ...

    def close(self) -> None: ...


def check_output(address: str) -> None:
    """Raise ValueError for an address that `open_output` does not support, or not as installed."""
    parts = urlsplit(address)
    if parts.scheme == "shm":
        segment_path(parts.netloc + parts.path)
    elif parts.scheme == "pipe":
        if not parts.path:
            raise ValueError(f"output {address!r}: expected pipe:PATH of a FIFO or pipe:- (standard output)")
    elif parts.scheme in ("http", "rtp"):
        _host_and_port(address)
        # Before a camera's process starts: the vehicle would fly on without its camera.
        if parts.scheme == "rtp" and find_spec("av") is None:
            raise ValueError(f"output {address!r}: H.264 needs PyAV: {install_command('av')}")
    else:
        raise ValueError(f"output {address!r}: expected one of {', '.join(SCHEMES)}")


def _host_and_port(address: str) -> tuple[str, int]:
    parts = urlsplit(address)
    try:
        port = parts.port
    except ValueError:
        port = None
    low = 0 if parts.scheme == "http" else 1
    if not parts.hostname or port is None or port < low:
        raise ValueError(f"output {address!r}: expected {parts.scheme}://HOST:PORT with a port up to 65535")
    return parts.hostname, port


def open_output(
    address: str,
    width: int,
    height: int,
    rate_hz: float,
    *,
    depth: bool = True,
    calibration: CameraCalibration | None = None,
) -> FrameOutput:
    """The output at an address (see the module's table).

    Args:
        width, height: of the frames to come.
        rate_hz: their rate, for encoders.
        depth: whether the frames have depth; only shared memory transports it.
        calibration: the camera's lens and mount; only shared memory transports them.

    Raises:
        ValueError: an invalid address, or RTP without the package that encodes it.
        OSError: a port or name that is taken.
        ModuleNotFoundError: that package has no H.264 encoder.
    """
    check_output(address)
    parts = urlsplit(address)
    if parts.scheme == "shm":
        return SharedFrameWriter(
            parts.netloc + parts.path, width, height, depth=depth, calibration=calibration
        )
    if parts.scheme == "pipe":
        return PipeOutput(parts.path)
    host, port = _host_and_port(address)
    if parts.scheme == "http":
        return MjpegOutput(host, port)
    return RtpOutput(host, port, width, height, rate_hz)
