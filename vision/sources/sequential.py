"""Every frame, in order: files, and pipes whose writer waits for the reader."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from vision.frame import Frame
from vision.sources.capture import CaptureError, MediaTime, OpenCapture, RawFrame, adapted, label
from vision.sources.source import (
    EndOfStream,
    NoFrameError,
    Source,
    SourceError,
    SourceSettings,
    SourceStatistics,
    SourceUnavailableError,
)

logger = logging.getLogger(__name__)


class SequentialSource(Source):
    """Reads a capture in the caller's thread. The constructor reads the first frame as a check."""

    live = False

    def __init__(
        self,
        uri: str,
        open_capture: OpenCapture,
        settings: SourceSettings,
        *,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        self.uri = label(uri, settings)
        self._on_close = on_close
        self._on_frame = settings.on_frame
        try:
            self._capture = adapted(open_capture, settings)()
        except CaptureError as lost:
            raise SourceUnavailableError(f"{self.uri}: {lost}") from lost
        self._sequence = 0
        self._media_time = MediaTime()
        self._delivered = 0
        self._dropped = 0
        self._unreadable_seen = 0
        self._closed = False
        self._ended = False
        self.total_frames = self._capture.total_frames
        self.calibration = self._capture.calibration
        try:
            self._first: RawFrame | None = self._read_first(settings.open_timeout_s)
        except BaseException:
            self.close()
            raise

    def _read_first(self, timeout_s: float) -> RawFrame:
        deadline_s = time.monotonic() + timeout_s
        try:
            raw = self._capture.read(timeout_s)
            while raw is None and time.monotonic() < deadline_s:
                raw = self._capture.read(max(deadline_s - time.monotonic(), 0.0))
        except EndOfStream as end:
            raise NoFrameError(f"{self.uri}: ended before its first frame{_detail(end)}") from end
        except CaptureError as lost:
            raise SourceUnavailableError(f"{self.uri}: {lost}") from lost
        if raw is None:
            raise SourceUnavailableError(f"{self.uri}: no frame within {timeout_s:g} s; start its writer")
        return raw

    def read(self, timeout_s: float = 1.0) -> Frame | None:
        if self._closed or self._ended:
            raise EndOfStream
        raw = self._first
        self._first = None
        if raw is None:
            try:
                raw = self._capture.read(timeout_s)
            except EndOfStream as end:
                self._ended = True
                self._log_early_end(end)
                raise
            except CaptureError as lost:
                self._ended = True
                raise SourceError(f"{self.uri}: {lost}") from lost
        if raw is None:
            return None
        self._sequence += raw.skipped + self._capture.unreadable - self._unreadable_seen
        self._unreadable_seen = self._capture.unreadable
        self._dropped += raw.skipped
        frame = self._media_time.of(raw, self._capture.interval_s).numbered(self._sequence)
        self._sequence += 1
        self._delivered += 1
        if self._on_frame is not None:
            self._on_frame(frame)
        return frame

    def _log_early_end(self, end: EndOfStream) -> None:
        if detail := _detail(end):
            logger.warning("%s: ended after %d frames%s", self.uri, self._delivered, detail)

    @property
    def statistics(self) -> SourceStatistics:
        return SourceStatistics(
            delivered=self._delivered, dropped=self._dropped, unreadable=self._capture.unreadable
        )

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._capture.close()
            if self._on_close is not None:
                self._on_close()


def _detail(end: EndOfStream) -> str:
    return f": {end}" if str(end) else ""
