"""A byte stream from standard input or a FIFO: raw pixels, YUV4MPEG2 or MJPEG."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import stat
import time
from collections import deque
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vision.sources.capture import Capture, CaptureError, RawFrame
from vision.sources.source import (
    PIPE_PIXEL_FORMATS,
    RAW_PIXEL_FORMATS,
    EndOfStream,
    SourceError,
    SourceSettings,
    SourceUnavailableError,
)
from vision.sources.stream_formats import MAGIC, MjpegParser, RawParser, StreamError, StreamParser, Y4mParser

_PIPE_BYTES = 1 << 20  # one frame of 640x480 in one read; the kernel's default is 64 KiB


class PipeCapture(Capture):
    """Frames from a file descriptor, which it owns.

    Args:
        descriptor: open for reading; a pipe, FIFO, socket or regular file.
        settings: pixel_format, width, height, rate_hz.
        end_is_loss: whether the writer's exit is a loss (a FIFO of a live source) or the end.
    """

    silence_is_loss = False  # closing a FIFO would kill a writer that is only slow

    def __init__(self, descriptor: int, settings: SourceSettings, *, end_is_loss: bool = False) -> None:
        self._descriptor = descriptor
        self._settings = settings
        self._end_is_loss = end_is_loss
        self._is_file = stat.S_ISREG(os.fstat(descriptor).st_mode)
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)
        self._parser: StreamParser | None = _parser_from_settings(settings)
        self._head = b""
        self._ready: deque[tuple[NDArray[np.uint8], int, float]] = deque()
        self._delivered = 0
        self._received = False
        with contextlib.suppress(
            OSError
        ):  # not a pipe, or above the user's limit: the default size is enough
            fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def read(self, timeout_s: float) -> RawFrame | None:
        deadline_s = time.monotonic() + timeout_s
        while not self._ready:
            if not self._poll.poll(max(deadline_s - time.monotonic(), 0.0) * 1000.0):
                self._check_clean_end()
                return None
            data = os.read(self._descriptor, _PIPE_BYTES)
            if not data:
                self._end()
            self._parse(data)
        image, captured_ns, decode_ms = self._ready.popleft()
        rate_hz = self._settings.rate_hz or (self._parser.rate_hz if self._parser else None) or 30.0
        self.interval_s = 1 / rate_hz
        media_s = self._delivered * self.interval_s
        self._delivered += 1
        stamp_ns = None if self._is_file else captured_ns
        return RawFrame(image, stamp_ns, media_s=media_s, decode_ms=decode_ms)

    def _check_clean_end(self) -> None:
        # A FIFO's writer that exited before the pipe was opened raises no POLLHUP; a read detects it.
        if self._received and not os.get_blocking(self._descriptor):
            with contextlib.suppress(BlockingIOError):
                data = os.read(self._descriptor, _PIPE_BYTES)
                if not data:
                    self._end()
                self._parse(data)

    def _parse(self, data: bytes) -> None:
        captured_ns = time.monotonic_ns()
        self._received = True
        if self._parser is None:
            self._head += data
            if len(self._head) < len(MAGIC):
                return
            data = self._head
        try:
            if self._parser is None:
                self._parser = _parser_from_magic(data)
            images = self._parser.push(data)
        except StreamError as error:
            raise CaptureError(str(error)) from error
        self.unreadable = self._parser.unreadable
        decode_ms = (time.monotonic_ns() - captured_ns) / 1e6 / max(len(images), 1)
        self._ready.extend((image, captured_ns, decode_ms) for image in images)

    def _end(self) -> None:
        leftover = (
            self._parser.leftover()
            if self._parser
            else f"{len(self._head)} bytes, too few to detect the format"
        )
        if self._parser is None and not self._head:
            leftover = "no data received"
        if self._end_is_loss:
            raise CaptureError(f"the writer has closed it{f', {leftover}' if leftover else ''}")
        raise EndOfStream(leftover)

    def close(self) -> None:
        os.close(self._descriptor)


class Fifo:
    """A named pipe that stays open between writers, so that a writer is not killed during reopening."""

    def __init__(self, path: Path, settings: SourceSettings) -> None:
        self._path = path
        self._settings = settings
        check_pipe_settings(str(path), settings)
        self._held_descriptor = _open_fifo(path)
        self._closed = False

    def open_capture(self) -> PipeCapture:
        return PipeCapture(
            _open_fifo(self._path), self._settings, end_is_loss=self._settings.every_frame is not True
        )

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            os.close(self._held_descriptor)


def _open_fifo(path: Path) -> int:
    # Without O_NONBLOCK the call would block until there is a writer.
    try:
        return os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise SourceUnavailableError(f"{path}: cannot open the pipe: {error.strerror}") from error


def check_pipe_settings(name: str, settings: SourceSettings) -> None:
    """Check that a pipe can be read with these settings.

    Raises:
        SourceError: a camera's pixel format, or raw pixels without their size.
    """
    pixel_format = settings.pixel_format
    if pixel_format is not None and pixel_format not in PIPE_PIXEL_FORMATS:
        raise SourceError(
            f"{name}: a pipe carries {', '.join(PIPE_PIXEL_FORMATS)}, but pixel_format is {pixel_format!r}"
        )
    if pixel_format == "gray16" and not settings.as_depth:
        raise SourceError(f"{name}: gray16 is depth: set it as source.depth, beside a colour source")
    if pixel_format in RAW_PIXEL_FORMATS and (settings.width is None or settings.height is None):
        raise SourceError(f"{name}: {pixel_format} needs width and height")
    if pixel_format == "yuv420" and (settings.width or 0) % 2 + (settings.height or 0) % 2:
        raise SourceError(
            f"{name}: yuv420 needs an even width and height, got {settings.width}x{settings.height}"
        )


def _parser_from_settings(settings: SourceSettings) -> StreamParser | None:
    if settings.pixel_format in RAW_PIXEL_FORMATS:
        assert settings.width is not None
        assert settings.height is not None
        return RawParser(settings.width, settings.height, settings.pixel_format)
    if settings.pixel_format == "y4m":
        return Y4mParser()
    if settings.pixel_format == "mjpeg":
        return MjpegParser()
    return None


def _parser_from_magic(head: bytes) -> StreamParser:
    if head.startswith(MAGIC):
        return Y4mParser()
    if head.startswith(b"\xff\xd8\xff"):
        return MjpegParser()
    raise StreamError(
        f"neither YUV4MPEG2 nor JPEG (it starts with {head[:8].hex(' ')}); for raw pixels give pixel_format "
        f"{', '.join(sorted(RAW_PIXEL_FORMATS.keys() - {'gray16'}))} with width and height"
    )
