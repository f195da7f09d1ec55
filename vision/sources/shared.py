"""Frames in shared memory, `shm://NAME`: those of another process, and a source's own for other programs."""

from __future__ import annotations

import time
from dataclasses import replace
from threading import Lock

import numpy as np

from vision.frame import Frame
from vision.shared_frame import SharedFrameReader, SharedFrameWriter, segment_path
from vision.sources.capture import Capture, CaptureError, RawFrame
from vision.sources.source import SourceError, SourceSettings, SourceUnavailableError

_POLL_S = 0.001  # shared memory does not notify; a poll takes some microseconds


def check_name(name: str) -> None:
    """Raises SourceError for an invalid name of a shared memory."""
    try:
        segment_path(name)
    except (OSError, ValueError) as error:
        raise SourceError(f"shm://{name[:80]}: {error}") from error


class SharedFrameCapture(Capture):
    """The newest frame of a shared memory, each once.

    Raises:
        CaptureError: it does not exist (yet), or is something else.
    """

    def __init__(self, name: str, settings: SourceSettings) -> None:
        try:
            self._reader = SharedFrameReader(name)
        except (OSError, ValueError) as error:
            reason = (error.strerror if isinstance(error, OSError) else None) or error
            raise CaptureError(f"no frames in the shared memory {name[:80]!r} ({reason})") from error
        self._stale_ns = round(settings.read_timeout_s * 1e9)
        self._after: int | None = None
        self.calibration = self._reader.calibration

    def read(self, timeout_s: float) -> RawFrame | None:
        deadline_s = time.monotonic() + timeout_s
        while True:
            polled_ns = time.monotonic_ns()
            try:
                frame = self._reader.latest(self._after)
            except ValueError as error:  # a new writer from another release
                raise CaptureError(str(error)) from error
            if self._reader.calibration != self.calibration:
                raise CaptureError("the shared memory has a new writer with another camera")
            if frame is not None and self._after is None and self._is_stale(frame):
                # A dead writer's last frame is not a new frame.
                self._after = frame.sequence
                frame = None
            if frame is not None:
                break
            if time.monotonic() >= deadline_s:
                return None
            time.sleep(_POLL_S)
        before, self._after = self._after, frame.sequence
        skipped = 0 if before is None else max(frame.sequence - before - 1, 0)
        copy_ms = (time.monotonic_ns() - polled_ns) / 1e6
        return RawFrame(frame.image, frame.captured_ns, frame.depth_m, skipped=skipped, decode_ms=copy_ms)

    def _is_stale(self, frame: Frame) -> bool:
        return time.monotonic_ns() - frame.captured_ns > self._stale_ns

    def close(self) -> None:
        self._reader.close()


class FrameSharing:
    """Writes frames of any size to shared memory until closed.

    A camera can be opened only once; this lets several models use it. As `SourceSettings.on_frame` of a
    source it writes every frame as it arrives, independent of the readers. The cost is one memory copy per
    frame, and none for readers.

    Args:
        name: of the shared memory. It is created at the first frame, with that frame's size.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._writer: SharedFrameWriter | None = None
        # A blocked camera driver may still deliver a frame while everything is being closed.
        self._lock = Lock()
        self._closed = False

    def write(self, frame: Frame) -> None:
        """Publish a frame. Does nothing after `close`.

        Raises:
            SourceError: another program writes under that name, or the memory cannot be allocated.
        """
        with self._lock:
            if not self._closed:
                writer = self._writer_for(frame)
                if writer.depth and frame.depth_m is None:
                    unknown = np.full((frame.height, frame.width), np.nan, np.float32)
                    frame = replace(frame, depth_m=unknown)
                writer.write(frame)

    def _writer_for(self, frame: Frame) -> SharedFrameWriter:
        """The writer for frames of this size: a stream may change its size."""
        writer = self._writer
        # A source with depth has frames without it; these are shared with unknown depth.
        usable = writer is not None and (writer.depth or frame.depth_m is None)
        if writer is not None and usable and (writer.width, writer.height) == (frame.width, frame.height):
            return writer
        size = (frame.width, frame.height, frame.depth_m is not None)
        self._remove()
        try:
            self._writer = SharedFrameWriter(self._name, *size)
        except (OSError, ValueError) as error:
            raise SourceUnavailableError(f"frames cannot be shared as shm://{self._name}: {error}") from error
        return self._writer

    def close(self) -> None:
        """Remove the shared memory."""
        with self._lock:
            self._closed = True
            self._remove()

    def _remove(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()

    def __enter__(self) -> FrameSharing:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
