"""Publishes a source's frames to other programs on this host as they arrive: `shm://NAME`."""

from __future__ import annotations

from threading import Lock
from types import TracebackType

from vision.frame import Frame
from vision.shared_frame import SharedFrameWriter
from vision.sources.source import SourceError


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
                self._writer_for(frame).write(frame)

    def _writer_for(self, frame: Frame) -> SharedFrameWriter:
        """The writer for frames of this size: a stream may change its size."""
        size = (frame.width, frame.height, frame.depth_m is not None)
        writer = self._writer
        if writer is not None and (writer.width, writer.height, writer.depth) == size:
            return writer
        self._remove()
        try:
            self._writer = SharedFrameWriter(self._name, *size)
        except (OSError, ValueError) as error:
            raise SourceError(f"frames cannot be shared as shm://{self._name}: {error}") from error
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
