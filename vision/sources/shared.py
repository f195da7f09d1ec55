"""Frames that another process puts into shared memory: `shm://NAME`, with depth where it gives depth."""

from __future__ import annotations

import time

from vision.shared_frame import SharedFrameReader
from vision.sources.feed import Feed, FeedLost, Picture

_LOOK_EVERY_S = 0.001  # shared memory wakes nobody; a look costs some microseconds


class SharedFrameFeed(Feed):
    """The newest frame of a shared memory, each once.

    Raises:
        FeedLost: nobody has made it (yet).
    """

    def __init__(self, name: str) -> None:
        try:
            self._reader = SharedFrameReader(name)
        except (OSError, ValueError) as error:
            raise FeedLost(f"no frames in the shared memory {name!r} ({error})") from error
        self._after: int | None = None

    def read(self, timeout_s: float) -> Picture | None:
        deadline_s = time.monotonic() + timeout_s
        while True:
            frame = self._reader.latest(self._after)
            if frame is not None:
                break
            if time.monotonic() >= deadline_s:
                return None
            time.sleep(_LOOK_EVERY_S)
        before, self._after = self._after, frame.sequence
        skipped = 0 if before is None else max(frame.sequence - before - 1, 0)
        return Picture(frame.image, frame.captured_ns, frame.depth_m, skipped=skipped)

    def close(self) -> None:
        self._reader.close()
