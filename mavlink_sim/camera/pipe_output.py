"""Raw bgr24 images through a FIFO, or through standard output."""

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

from mavlink_sim.camera.newest_frame import NewestFrame
from vision.frame import Frame

logger = logging.getLogger(__name__)


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
