"""Offering a source's frames to other programs of this host while they arrive: `shm://NAME`."""

from __future__ import annotations

from threading import Lock
from types import TracebackType

from vision.frame import Frame
from vision.shared_frame import SharedFrameWriter
from vision.sources.source import SourceError


class FrameSharing:
    """Frames of any size into shared memory, for as long as this is open.

    A camera can be opened once; this lets several models look through it. Given to a source as
    `SourceSettings.on_frame`, it writes every frame as it arrives, whoever takes it and how slowly. The copy
    costs one memory copy a frame, whoever reads the shared memory nothing.

    Args:
        name: of the shared memory. Nothing is there before the first frame, whose size it has.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._writer: SharedFrameWriter | None = None
        # A camera's driver that hangs may still be giving a frame when all is being closed.
        self._lock = Lock()
        self._closed = False

    def write(self, frame: Frame) -> None:
        """Show a frame to the others. After `close` it does nothing.

        Raises:
            SourceError: another program writes under that name, or the memory cannot be had.
        """
        with self._lock:
            if not self._closed:
                self._writer_for(frame).write(frame)

    def _writer_for(self, frame: Frame) -> SharedFrameWriter:
        """The writer of frames of this size: a stream may change its own in the middle."""
        size = (frame.width, frame.height, frame.depth_m is not None)
        writer = self._writer
        if writer is not None and (writer.width, writer.height, writer.depth) == size:
            return writer
        self._take_away()
        try:
            self._writer = SharedFrameWriter(self._name, *size)
        except (OSError, ValueError) as error:
            raise SourceError(f"frames cannot be shared as shm://{self._name}: {error}") from error
        return self._writer

    def close(self) -> None:
        """Take the shared memory away."""
        with self._lock:
            self._closed = True
            self._take_away()

    def _take_away(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()

    def __enter__(self) -> FrameSharing:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
