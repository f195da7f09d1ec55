"""Where a camera's frames go: shared memory, a pipe, Motion JPEG over HTTP, H.264 in RTP. One address each.

| address | what a reader gets |
|---|---|
| `shm://NAME` | colour, depth and stamps (`vision.shared_frame`) |
| `pipe:PATH` | raw bgr24 pictures through a FIFO, made if it is not there; `pipe:-` is standard output |
| `http://HOST:PORT` | Motion JPEG at `/`, one picture at `/snapshot.jpg` |
| `rtp://HOST:PORT` | H.264 in RTP (RFC 6184), payload type 96, as PX4's Gazebo camera sends to UDP 5600 |

A reader that is slow, hung or gone loses frames; it never delays the camera or another reader.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import select
import stat
import sys
import threading
from collections.abc import Callable
from typing import Protocol
from urllib.parse import urlsplit

from vision.frame import Frame
from vision.shared_frame import SharedFrameWriter, segment_path

logger = logging.getLogger(__name__)

SCHEMES = ("shm://NAME", "pipe:PATH", "pipe:-", "http://HOST:PORT", "rtp://HOST:PORT")
STANDARD_OUTPUT = "pipe:-"
_PIPE_BYTES = 1 << 20
_WAIT_MS = 200


class FrameOutput(Protocol):
    """Takes frames. `write` returns at once; `close` may be called more than once."""

    def write(self, frame: Frame) -> None: ...

    def close(self) -> None: ...


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
        """Hand a frame over; never waits."""
        with self._changed:
            self.dropped += self._frame is not None
            self._frame = frame
            self._changed.notify()

    def close(self, timeout_s: float = 2.0) -> None:
        """End the thread after the frame in hand."""
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


class PipeOutput:
    """Raw bgr24 pictures, one after another, into a FIFO or standard output; whole ones only.

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
                continue  # the reader is slow; newer frames take the place of those waiting
            try:
                rest = rest[os.write(self._descriptor, rest[: 1 << 16]) :]
            except BlockingIOError:
                continue
            except BrokenPipeError:
                logger.info("the reader of pipe:%s has gone", self.path)
                self._hang_up()
                if self.path == "-":  # nobody can come back to it
                    self._closed.set()
                return

    def _reader_found(self) -> bool:
        if self._closed.is_set():
            return False
        try:
            self._descriptor = os.open(self.path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            if error.errno not in (errno.ENXIO, errno.ENOENT):  # no reader; the FIFO taken away
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


def check_output(address: str) -> None:
    """Raise ValueError, saying what is expected, for an address that `open_output` would not know."""
    parts = urlsplit(address)
    if parts.scheme == "shm":
        segment_path(parts.netloc + parts.path)
    elif parts.scheme == "pipe":
        if not parts.path:
            raise ValueError(f"output {address!r}: expected pipe:PATH of a FIFO or pipe:- (standard output)")
    elif parts.scheme in ("http", "rtp"):
        _host_and_port(address)
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


def open_output(address: str, width: int, height: int, rate_hz: float, *, depth: bool = True) -> FrameOutput:
    """The output at an address (see the module's table).

    Args:
        width, height: of the frames to come.
        rate_hz: how many a second, as an encoder needs to know.
        depth: whether the frames bear depth; only shared memory carries it on.

    Raises:
        ValueError: an address that cannot be.
        OSError: a port or name that is taken.
        ModuleNotFoundError: RTP without the package that encodes it.
    """
    check_output(address)
    parts = urlsplit(address)
    if parts.scheme == "shm":
        return SharedFrameWriter(parts.netloc + parts.path, width, height, depth=depth)
    if parts.scheme == "pipe":
        return PipeOutput(parts.path)
    host, port = _host_and_port(address)
    if parts.scheme == "http":
        from mavlink_sim.camera.mjpeg_output import MjpegOutput

        return MjpegOutput(host, port)
    from mavlink_sim.camera.rtp_output import RtpOutput

    return RtpOutput(host, port, width, height, rate_hz)
