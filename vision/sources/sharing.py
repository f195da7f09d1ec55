"""Offering a source's frames to other programs of this host while they are read: `shm://NAME`."""

from __future__ import annotations

import contextlib

from vision.frame import Frame
from vision.shared_frame import SharedFrameWriter
from vision.sources.source import Source, SourceError, SourceStatistics


class SharingSource(Source):
    """Another source, whose every frame also goes into shared memory before it is given.

    A camera can be opened once; this lets several models look through it. The copy costs the reader of this
    source one memory copy a frame, whoever reads the shared memory nothing.

    Args:
        source: open; closed with this one.
        name: of the shared memory.

    Raises:
        SourceError: another program writes under that name, or the memory cannot be had.
    """

    def __init__(self, source: Source, name: str) -> None:
        self._source = source
        self._name = name
        self._writer: SharedFrameWriter | None = None
        self.uri = source.uri
        self.live = source.live
        self.total_frames = source.total_frames

    def read(self, timeout_s: float = 1.0) -> Frame | None:
        frame = self._source.read(timeout_s)
        if frame is not None:
            self._writer_for(frame).write(frame)
        return frame

    def _writer_for(self, frame: Frame) -> SharedFrameWriter:
        """The writer of frames of this size: a stream may change its own in the middle."""
        size = (frame.width, frame.height, frame.depth_m is not None)
        writer = self._writer
        if writer is not None and (writer.width, writer.height, writer.depth) == size:
            return writer
        if writer is not None:
            self._writer = None
            writer.close()
        try:
            self._writer = SharedFrameWriter(self._name, *size)
        except (OSError, ValueError) as error:
            raise SourceError(f"frames cannot be shared as shm://{self._name}: {error}") from error
        return self._writer

    @property
    def statistics(self) -> SourceStatistics:
        return self._source.statistics

    def close(self) -> None:
        with contextlib.ExitStack() as stack:
            stack.callback(self._source.close)
            if self._writer is not None:
                stack.callback(self._writer.close)
