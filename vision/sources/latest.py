"""A live source: a thread reads the capture and keeps only the newest frame for the reader.

A capture that stops is reopened, with a pause that doubles up to a limit; loss and recovery are logged once
each.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from vision.frame import Frame
from vision.sources.capture import (
    LONGEST_STEP_S,
    Capture,
    CaptureError,
    MediaTime,
    OpenCapture,
    RawFrame,
    adapted,
    label,
)
from vision.sources.source import (
    CameraChangedError,
    EndOfStream,
    NoFrameError,
    Source,
    SourceError,
    SourceSettings,
    SourceStatistics,
    SourceUnavailableError,
)

logger = logging.getLogger(__name__)

_POLL_S = 0.2  # how soon the reading thread notices `close` while no data arrives
_OPENING_GRACE_S = 1.0  # beyond the deadline, for a driver that is still in a call


class LatestSource(Source):
    """A live source. The constructor returns once the first frame has arrived.

    Args:
        uri: name in messages, without passwords.
        open_capture: opens the capture; called for every attempt.
        settings: timeouts and pauses.
        reopen: whether a capture that ended or failed is reopened; if not, it ends the source.
        paced: delay every frame until its `media_s` has passed: a recording used as a camera.
        advice: what to do if no frame arrives; appended to the error.
        on_close: called when the source is closed, after the last capture.
    """

    live = True

    def __init__(
        self,
        uri: str,
        open_capture: OpenCapture,
        settings: SourceSettings,
        *,
        reopen: bool = True,
        paced: bool = False,
        advice: str = "",
        on_close: Callable[[], None] | None = None,
    ) -> None:
        self.uri = label(uri, settings)
        self._open_capture = adapted(open_capture, settings)
        self._settings = settings
        self._reopen = reopen
        self._paced = paced
        self._on_close = on_close
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._slot: Frame | None = None
        self._capture: Capture | None = None
        self._opened = False
        self._end: Exception | None = None
        self._last_reason = "nothing arrived"
        self._sequence = 0
        self._media_time = MediaTime()
        self._statistics = SourceStatistics()
        self._unreadable_before = 0
        self._lost_since_s: float | None = None
        self._pace_origin_s: float | None = None
        self._advice = advice
        self._open_deadline_s = time.monotonic() + settings.open_timeout_s
        self._thread = threading.Thread(target=self._run, name=f"source {self.uri}", daemon=True)
        self._thread.start()
        self._wait_for_first_frame()

    def _wait_for_first_frame(self) -> None:
        timeout_s = self._settings.open_timeout_s
        with self._changed:
            self._changed.wait_for(
                lambda: self._opened or self._end is not None, timeout_s + _OPENING_GRACE_S
            )
            opened, end = self._opened, self._end or self._never_opened()
        if opened:
            return
        self.close()
        if isinstance(end, EndOfStream):
            raise NoFrameError(f"{self.uri}: ended before its first frame{f': {end}' if str(end) else ''}")
        if isinstance(end, SourceError) and not str(end).startswith(self.uri):
            raise type(end)(f"{self.uri}: {end}") from end
        raise end

    def _never_opened(self) -> SourceUnavailableError:
        advice = f"; {self._advice}" if self._advice else ""
        return SourceUnavailableError(
            f"{self.uri}: no frame within {self._settings.open_timeout_s:g} s: {self._last_reason}{advice}"
        )

    # --- called by the reader

    def read(self, timeout_s: float = 1.0) -> Frame | None:
        with self._changed:
            self._changed.wait_for(
                lambda: self._slot is not None or self._end is not None or self._stop.is_set(), timeout_s
            )
            if self._stop.is_set():
                raise EndOfStream
            frame, self._slot = self._slot, None
            if frame is not None:
                self._count(delivered=1)
                return frame
            if self._end is not None:
                raise self._end
            return None

    @property
    def statistics(self) -> SourceStatistics:
        with self._changed:
            return self._statistics

    def close(self) -> None:
        with self._changed:
            if self._stop.is_set():
                return
            self._stop.set()
            capture = self._capture
            self._changed.notify_all()
        if capture is not None:
            capture.interrupt()
        # A decoder in a network call returns at its own timeout, and must not outlive the interpreter.
        self._thread.join(max(self._settings.open_timeout_s, self._settings.read_timeout_s) + 1.0)
        if self._thread.is_alive():
            logger.warning("%s: the reading thread is still blocked in the driver after close", self.uri)
        if self._on_close is not None:
            self._on_close()

    def _count(self, *, delivered: int = 0, dropped: int = 0, reopened: int = 0) -> None:
        now = self._statistics
        self._statistics = replace(
            now,
            delivered=now.delivered + delivered,
            dropped=now.dropped + dropped,
            reopened=now.reopened + reopened,
        )

    # --- called by the thread

    def _run(self) -> None:
        try:
            self._read_forever()
        except EndOfStream as end:
            if str(end) and self._opened:
                logger.warning("%s: ended after %d frames: %s", self.uri, self._sequence, end)
            self._finish(end)
        except Exception as error:  # re-raised in `read`, not on the thread's standard error
            self._finish(error)

    def _finish(self, end: Exception) -> None:
        with self._changed:
            self._end = end
            self._changed.notify_all()

    def _read_forever(self) -> None:
        pause_s = self._settings.retry_min_s
        while not self._stop.is_set():
            was_running = False
            try:
                self._read_capture()
            except CaptureError as lost:
                was_running = self._lost_since_s is None and self._opened
                self._log_lost(str(lost))
            except EndOfStream as end:
                if not self._reopen:
                    raise
                was_running = self._lost_since_s is None and self._opened
                self._log_lost(str(end) or "it ended")
            except SourceError as error:
                if not self._opened or isinstance(error, CameraChangedError):
                    raise
                self._log_lost(str(error))
            if was_running:
                pause_s = self._settings.retry_min_s
            left_s = self._open_deadline_s - time.monotonic()
            if not self._opened and left_s <= 0.0:
                raise self._never_opened()
            self._stop.wait(pause_s if self._opened else min(pause_s, left_s))
            pause_s = min(pause_s * 2, self._settings.retry_max_s)

    def _log_lost(self, reason: str) -> None:
        if self._stop.is_set():
            return
        if not self._reopen:
            raise SourceError(f"{self.uri}: {reason}")
        with self._changed:
            self._last_reason = reason
        if self._opened and self._lost_since_s is None:
            self._lost_since_s = time.monotonic()
            logger.warning("%s: lost: %s; reopening", self.uri, reason)
        else:
            logger.debug("%s: reopening failed: %s", self.uri, reason)

    def _read_capture(self) -> None:
        capture = self._open_capture()
        self._pace_origin_s = None
        with self._changed:
            self._capture = capture
        try:
            if self._opened and capture.calibration != self.calibration:
                raise CameraChangedError(
                    f"{self.uri}: the camera returned with another lens or mount; open the source again"
                )
            self.calibration = capture.calibration
            self._pump(capture)
        finally:
            with self._changed:
                self._capture = None
                self._unreadable_before += capture.unreadable
            capture.close()

    def _pump(self, capture: Capture) -> None:
        settings = self._settings
        received_s = time.monotonic()
        warned_silent = False
        while not self._stop.is_set():
            raw = capture.read(_POLL_S)
            silent_s = time.monotonic() - received_s
            if raw is not None:
                if warned_silent:
                    logger.info("%s: recovered after %.1f s", self.uri, silent_s)
                warned_silent = False
                raw = self._media_time.of(raw, capture.interval_s)
                self._pace(raw)
                self._publish(raw, capture)
                received_s = time.monotonic()
            elif not self._opened and time.monotonic() > self._open_deadline_s:
                raise self._never_opened()
            elif silent_s > settings.read_timeout_s:
                if capture.silence_is_loss:
                    raise CaptureError(f"no data for {silent_s:.1f} s")
                if self._opened and self._lost_since_s is None and not warned_silent:
                    logger.warning("%s: no data for %.1f s; waiting", self.uri, silent_s)
                    warned_silent = True

    def _pace(self, raw: RawFrame) -> None:
        if not self._paced or raw.media_s is None:
            return
        if self._pace_origin_s is None:
            self._pace_origin_s = time.monotonic() - raw.media_s
        wait_s = self._pace_origin_s + raw.media_s - time.monotonic()
        if wait_s > LONGEST_STEP_S:
            logger.info("%s: the next frame of the recording is due in %.0f s", self.uri, wait_s)
        self._stop.wait(max(wait_s, 0.0))

    def _publish(self, raw: RawFrame, capture: Capture) -> None:
        unreadable = self._unreadable_before + capture.unreadable
        self._sequence += raw.skipped + unreadable - self._statistics.unreadable
        frame = raw.numbered(self._sequence)
        self._sequence += 1
        if self._settings.on_frame is not None:
            self._settings.on_frame(frame)
        recovered_after_s = None
        with self._changed:
            if not self._opened:
                self._opened = True
                self.total_frames = capture.total_frames
            elif self._lost_since_s is not None:
                recovered_after_s = time.monotonic() - self._lost_since_s
                self._lost_since_s = None
                self._count(reopened=1)
            self._count(dropped=raw.skipped + (self._slot is not None))
            self._statistics = replace(self._statistics, unreadable=unreadable)
            self._slot = frame
            self._changed.notify_all()
        if recovered_after_s is not None:
            logger.warning("%s: recovered after %.1f s", self.uri, recovered_after_s)
