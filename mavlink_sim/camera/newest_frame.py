"""Frames handed on to something slow, by a thread."""

from __future__ import annotations

import threading
from collections.abc import Callable

from vision.frame import Frame


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
