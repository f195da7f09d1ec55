"""The lowest layer of a source: one opened thing that gives pictures until it ends or is lost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vision.camera_model import CameraCalibration
from vision.sources.source import EndOfStream


class CaptureError(Exception):
    """The feed stopped or could not be opened this time; another attempt may succeed."""


@dataclass(frozen=True, slots=True, eq=False)
class RawFrame:
    """One decoded picture of a feed.

    Attributes:
        image: (height, width, 3) uint8, BGR.
        captured_ns: CLOCK_MONOTONIC nanoseconds; None for a file, whose frames are captured when read.
        depth_m: (height, width) float32 metres along the optical axis, or None.
        media_s: seconds since the start of the recording, for pacing; None where there is no such time.
        skipped: pictures that the writer overwrote since the one before.
        decode_ms: how long making a picture of its bytes took, milliseconds, as far as the library that does
            it lets us see.
    """

    image: NDArray[np.uint8]
    captured_ns: int | None = None
    depth_m: NDArray[np.float32] | None = None
    media_s: float | None = None
    skipped: int = 0
    decode_ms: float = 0.0


class Capture(ABC):
    """An opened thing that gives pictures in order. It is never reopened: its opener makes a new one.

    Attributes:
        total_frames: how many pictures there are, if known.
        unreadable: pictures that could not be decoded so far.
        silence_is_loss: whether opening it again may help when nothing comes for a while.
        interval_s: between two pictures of a recording, where there are no two to tell.
        calibration: the camera's lens and mount, where it brings them.
    """

    total_frames: int | None = None
    unreadable: int = 0
    silence_is_loss: bool = True
    interval_s: float = 1 / 30
    calibration: CameraCalibration | None = None

    @abstractmethod
    def read(self, timeout_s: float) -> RawFrame | None:
        """The next picture, or None if none came within about `timeout_s`.

        Raises:
            EndOfStream: there are no more, and that is in order.
            CaptureError: the connection, device or data broke.
        """

    @abstractmethod
    def close(self) -> None:
        """Release it. Called once, by the thread that reads."""

    def interrupt(self) -> None:  # noqa: B027 - most feeds return soon enough by themselves
        """Make a blocked `read` return early; called from another thread."""


OpenFeed = Callable[[], Capture]
"""Opens a feed. Raises CaptureError where trying again may help, SourceError where it cannot."""


class LoopingCapture(Capture):
    """A file that starts over at its end, its media time running on."""

    def __init__(self, open_capture: OpenFeed) -> None:
        self._open_feed = open_capture
        self._capture = open_capture()
        self._unreadable_before = 0
        self._pictures = 0
        self._offset_s = 0.0
        self._last_s = 0.0
        self._interval_s = 0.0

    def read(self, timeout_s: float) -> RawFrame | None:
        try:
            picture = self._capture.read(timeout_s)
        except EndOfStream:
            if self._pictures == 0:
                raise
            self._start_over()
            picture = self._capture.read(timeout_s)
        self.unreadable = self._unreadable_before + self._capture.unreadable
        if picture is None:
            return None
        self._pictures += 1
        if picture.media_s is None:
            return picture
        if self._pictures > 1:
            self._interval_s = max(picture.media_s - self._last_s, 0.0)
        self._last_s = picture.media_s
        return replace(picture, media_s=picture.media_s + self._offset_s)

    def _start_over(self) -> None:
        self._capture.close()
        self._unreadable_before += self._capture.unreadable
        # A single picture stands as long as any other: else it would be read as fast as the processor can.
        self._offset_s += self._last_s + (self._interval_s or self._capture.interval_s)
        self._capture = self._open_feed()
        self._last_s = self._interval_s = 0.0
        self._pictures = 0

    def close(self) -> None:
        self._capture.close()
