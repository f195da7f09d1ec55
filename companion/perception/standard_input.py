"""Standard input as a source that survives worker restarts: each worker starts at a whole frame.

What a dead worker had read from a pipe is lost, and a stream of raw pixels has no frame boundaries to find.
So the service keeps the pipe. A thread moves the bytes into a separate pipe of the worker (`splice(2)`: the
kernel moves pages, nothing is copied here) and tracks the position in the frame. The next worker gets the
stream's header, if any, and then the next whole frame.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import select
import stat
import threading
from typing import NamedTuple

from companion.settings import SourceSection
from vision.sources.source import RAW_PIXEL_FORMATS
from vision.sources.stream_formats import MAGIC, StreamError, parse_y4m_header

logger = logging.getLogger(__name__)

STANDARD_INPUT = "-"
_CHUNK_BYTES = 1 << 20
_LONGEST_LINE = 4096


class _Framing(NamedTuple):
    """The framing of the stream.

    Attributes:
        header: sent to every reader before its first frame.
        frame_bytes: of one frame; None if frames are self-delimiting, as in MJPEG.
        has_lines: every frame is preceded by a line.
        taken: bytes of the first frame that were read during detection.
    """

    header: bytes = b""
    frame_bytes: int | None = None
    has_lines: bool = False
    taken: bytes = b""


class _End(Exception):  # noqa: N818 - end of stream, not an error
    """The writer of standard input has closed it."""


class StandardInput:
    """The service's standard input, for its workers. Call `for_worker` before each start.

    Args:
        source: the format of the stream.
        descriptor: readable; stays open.
    """

    def __init__(self, source: SourceSection, descriptor: int = 0) -> None:
        """Raises OSError if the descriptor is not open."""
        self._source = source
        self._descriptor = descriptor
        mode = os.fstat(descriptor).st_mode
        self._is_stream = stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)
        self._file_begins = os.lseek(descriptor, 0, os.SEEK_CUR) if stat.S_ISREG(mode) else None
        self._changed = threading.Condition()
        self._waiting_writer: int | None = None
        self._closed = False
        self._thread: threading.Thread | None = None

    @property
    def ended(self) -> bool:
        """Whether its writer has closed it: no worker gets a frame any more."""
        return self._closed

    def for_worker(self) -> int:
        """Return a descriptor for the next worker's standard input. The caller closes it."""
        if not self._is_stream:
            if self._file_begins is not None:
                # Every worker reads a file from its start position, as with a named file.
                os.lseek(self._descriptor, self._file_begins, os.SEEK_SET)
            return os.dup(self._descriptor)
        reader, writer = os.pipe()
        with self._changed:
            if self._waiting_writer is not None:
                os.close(self._waiting_writer)
            self._waiting_writer = writer
            if self._closed:
                self._close_waiting_writer()
            self._changed.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="standard input", daemon=True)
            self._thread.start()
        return reader

    def close(self) -> None:
        """Stop: no more workers. The thread ends at its next data."""
        with self._changed:
            self._closed = True
            self._close_waiting_writer()
            self._changed.notify()

    # --- the thread

    def _run(self) -> None:
        with contextlib.suppress(OSError):  # above the user's limit: the default size is used
            fcntl.fcntl(self._descriptor, fcntl.F_SETPIPE_SZ, _CHUNK_BYTES)
        writer: int | None = None
        try:
            framing = self._recognise()
            line = framing.taken
            while True:
                if writer is None:
                    writer = self._next_writer(framing.header)
                    if writer is None:
                        return
                if framing.has_lines:
                    line = self._line()
                forwarded = self._forward(line, framing.frame_bytes, writer)
                line = b""
                if not forwarded:
                    os.close(writer)
                    writer = None
        except _End:
            logger.debug("standard input has ended")
        except OSError as error:
            logger.error("standard input cannot be read: %s", error.strerror)
        finally:
            if writer is not None:
                os.close(writer)
            self.close()

    def _recognise(self) -> _Framing:
        source = self._source
        if source.pixel_format in RAW_PIXEL_FORMATS and source.width and source.height:
            pixels = source.width * source.height
            return _Framing(frame_bytes=int(pixels * RAW_PIXEL_FORMATS[source.pixel_format]))
        if source.pixel_format not in (None, "y4m"):
            return _Framing()
        beginning = b""
        while len(beginning) < len(MAGIC):
            beginning += self._read(len(MAGIC) - len(beginning))
        if beginning != MAGIC:
            return _Framing(taken=beginning)
        header = beginning + self._line()
        try:
            return _Framing(header, parse_y4m_header(header.rstrip(b"\n")).frame_bytes, has_lines=True)
        except StreamError:  # the worker detects and reports it too
            return _Framing(taken=header)

    def _next_writer(self, header: bytes) -> int | None:
        """Wait for the next worker's pipe; None after `close`."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting_writer is not None or self._closed)
                writer, self._waiting_writer = self._waiting_writer, None
            if writer is None or _written(writer, header):
                return writer
            os.close(writer)

    def _forward(self, line: bytes, frame_bytes: int | None, writer: int) -> bool:
        """Forward one frame. False if the worker has died; the rest of its frame is then discarded."""
        alive = _written(writer, line)
        remaining = 0 if frame_bytes is None else frame_bytes
        try:
            if alive and frame_bytes is None:
                self._move(writer, _CHUNK_BYTES)
            while alive and remaining > 0:
                remaining -= self._move(writer, remaining)
        except BrokenPipeError:
            alive = False
        while remaining > 0:
            remaining -= len(self._read(min(remaining, _CHUNK_BYTES)))
        return alive

    def _line(self) -> bytes:
        line = b""
        while not line.endswith(b"\n") and len(line) < _LONGEST_LINE:
            line += self._read(1)
        return line

    def _read(self, count: int) -> bytes:
        while True:
            try:
                data = os.read(self._descriptor, count)
            except BlockingIOError:
                self._wait_readable()
                continue
            if not data:
                raise _End
            return data

    def _move(self, writer: int, count: int) -> int:
        """Move at most `count` bytes; returns their number."""
        while True:
            try:
                moved = os.splice(self._descriptor, writer, min(count, _CHUNK_BYTES))
            except BlockingIOError:
                self._wait_readable()
                continue
            except OSError as error:
                if error.errno != errno.EINVAL:
                    raise
                data = self._read(min(count, _CHUNK_BYTES))  # a socket type without splice support
                if not _written(writer, data):
                    raise BrokenPipeError from None
                return len(data)
            if moved == 0:
                raise _End
            return moved

    def _wait_readable(self) -> None:
        poll = select.poll()
        poll.register(self._descriptor, select.POLLIN)
        poll.poll()

    def _close_waiting_writer(self) -> None:
        if self._waiting_writer is not None:
            os.close(self._waiting_writer)
            self._waiting_writer = None


def _written(writer: int, data: bytes) -> bool:
    """Write all data; False if the pipe has no reader."""
    try:
        while data:
            data = data[os.write(writer, data) :]
    except BrokenPipeError:
        return False
    return True
