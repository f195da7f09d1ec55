"""The lowest layer of a source: an open device, file or stream that delivers frames until it ends."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vision.camera_model import CameraCalibration
from vision.frame import Frame
from vision.orientation import Orientation
from vision.redaction import redacted, without_password
from vision.sources.depth_images import to_metres
from vision.sources.source import EndOfStream, SourceError, SourceSettings

LONGEST_STEP_S = 5.0
"""A larger step of a recording's or stream's stamps is a discontinuity, not a pause."""
_LONGEST_LAG_S = 1.0  # of stamps behind the media time that may catch up with it


class CaptureError(Exception):
    """The capture stopped or could not be opened; another attempt may succeed."""

    def __init__(self, text: str = "") -> None:
        super().__init__(redacted(text))


@dataclass(frozen=True, slots=True, eq=False)
class RawFrame:
    """One decoded frame of a capture.

    Attributes:
        image: (height, width, 3) uint8, BGR.
        captured_ns: CLOCK_MONOTONIC nanoseconds; None for a file, whose frames are captured when read.
        depth_m: (height, width) float32 metres along the optical axis, or None.
        media_s: the recording's own stamp, seconds, as it is (`MediaTime` makes the media time of it); None
            where there is no such time.
        skipped: frames that the writer overwrote since the previous one.
        decode_ms: decoding time, milliseconds, as far as the library exposes it.
        file_name: of the image or video, without folder; empty if the frame is not from a file.
    """

    image: NDArray[np.uint8]
    captured_ns: int | None = None
    depth_m: NDArray[np.float32] | None = None
    media_s: float | None = None
    skipped: int = 0
    decode_ms: float = 0.0
    file_name: str = ""

    def numbered(self, sequence: int) -> Frame:
        """The frame to deliver, ready now; one of a file is captured now."""
        now_ns = time.monotonic_ns()
        captured_ns = now_ns if self.captured_ns is None else self.captured_ns
        return Frame(
            self.image,
            captured_ns,
            sequence,
            self.depth_m,
            now_ns,
            self.decode_ms,
            self.media_s,
            self.file_name,
        )


class Capture(ABC):
    """An open device, file or stream that delivers frames in order. Reopening creates a new one.

    Attributes:
        total_frames: number of frames, if known.
        unreadable: frames that could not be decoded so far.
        silence_is_loss: whether reopening may help when no data arrives for a while.
        interval_s: frame interval of a recording, seconds, used where stamps do not give one.
        calibration: the camera's lens and mount, if it provides them.
    """

    total_frames: int | None = None
    unreadable: int = 0
    silence_is_loss: bool = True
    interval_s: float = 1 / 30
    calibration: CameraCalibration | None = None

    @abstractmethod
    def read(self, timeout_s: float) -> RawFrame | None:
        """The next frame, or None if none arrived within about `timeout_s`.

        Raises:
            EndOfStream: regular end.
            CaptureError: the connection, device or data failed.
        """

    @abstractmethod
    def close(self) -> None:
        """Release it. Called once, by the thread that reads."""

    def interrupt(self) -> None:  # noqa: B027 - most captures return soon enough without it
        """Make a blocked `read` return early; called from another thread."""


OpenCapture = Callable[[], Capture]
"""Opens a capture. Raises CaptureError if another attempt may help, SourceError if not."""


class MediaTime:
    """The media time of a source, from the stamps of a recording or stream, which are not trusted.

    It begins at the first stamp, or at 0 if that is negative or late, and increases with every frame. A stamp
    that jumps, repeats or goes back counts as one interval; the following ones continue from there.
    """

    def __init__(self) -> None:
        self._media_s: float | None = None
        self._stamp_s = 0.0
        self._offset_s = 0.0

    def of(self, raw: RawFrame, interval_s: float) -> RawFrame:
        """The frame with its media time as `media_s`."""
        if raw.media_s is None:
            return raw
        return replace(raw, media_s=self.advance(raw.media_s, interval_s))

    def advance(self, stamp_s: float, interval_s: float) -> float:
        """Seconds since the start at the next frame. `interval_s`: where the stamp does not give a step."""
        before_s, longest_s = self._media_s, max(LONGEST_STEP_S, 3 * interval_s)
        media_s = stamp_s + self._offset_s
        if before_s is None:
            if not 0.0 <= media_s <= longest_s:
                media_s = 0.0
                self._continue_from(media_s, stamp_s)
        elif not 0.0 < media_s - before_s <= longest_s:
            jumped = not -_LONGEST_LAG_S <= media_s - before_s <= 0.0
            went_back = stamp_s < self._stamp_s - 3 * interval_s
            media_s = before_s + interval_s
            # A repeated stamp, or two in the wrong order, is followed by right ones.
            if jumped or went_back:
                self._continue_from(media_s, stamp_s)
        self._media_s, self._stamp_s = media_s, stamp_s
        return media_s

    def _continue_from(self, media_s: float, stamp_s: float) -> None:
        if math.isfinite(stamp_s):
            self._offset_s = media_s - stamp_s


class LoopingCapture(Capture):
    """A file that restarts at its end."""

    def __init__(self, open_capture: OpenCapture) -> None:
        self._open_capture = open_capture
        self._capture = open_capture()
        self._unreadable_before = 0
        self._frames = 0

    def read(self, timeout_s: float) -> RawFrame | None:
        try:
            raw = self._capture.read(timeout_s)
        except EndOfStream:
            if self._frames == 0:
                raise
            self._restart()
            raw = self._capture.read(timeout_s)
        self.unreadable = self._unreadable_before + self._capture.unreadable
        self.interval_s = self._capture.interval_s
        self._frames += raw is not None
        return raw

    def _restart(self) -> None:
        self._capture.close()
        self._unreadable_before += self._capture.unreadable
        self._capture = self._open_capture()
        self._frames = 0

    def close(self) -> None:
        self._capture.close()


class OrientedCapture(Capture):
    """A capture whose images, depth and calibration are mirrored and rotated."""

    def __init__(self, capture: Capture, orientation: Orientation) -> None:
        self._capture = capture
        self._orientation = orientation
        self.total_frames = capture.total_frames
        self.silence_is_loss = capture.silence_is_loss
        if capture.calibration is not None:
            self.calibration = orientation.calibration(capture.calibration)

    def read(self, timeout_s: float) -> RawFrame | None:
        raw = self._capture.read(timeout_s)
        self.unreadable = self._capture.unreadable
        self.interval_s = self._capture.interval_s
        if raw is None:
            return None
        depth_m = None if raw.depth_m is None else self._orientation.pixels(raw.depth_m)
        return replace(raw, image=self._orientation.pixels(raw.image), depth_m=depth_m)

    def close(self) -> None:
        self._capture.close()

    def interrupt(self) -> None:
        self._capture.interrupt()


class DepthCapture(Capture):
    """A capture of depth images (uint16 or float), which it converts to metres; the image is black.

    One that has depth in metres beside its image (shared memory) is passed on.
    """

    def __init__(self, capture: Capture, scale_m: float | None) -> None:
        self._capture = capture
        self._scale_m = scale_m
        self.total_frames = capture.total_frames
        self.silence_is_loss = capture.silence_is_loss
        self.calibration = capture.calibration

    def read(self, timeout_s: float) -> RawFrame | None:
        raw = self._capture.read(timeout_s)
        self.unreadable = self._capture.unreadable
        self.interval_s = self._capture.interval_s
        if raw is None or raw.depth_m is not None:
            return raw
        if raw.image.ndim != 2:
            raise SourceError("it delivers colour images, not depth")
        depth_m = to_metres(raw.image, self._scale_m)
        return replace(raw, image=np.zeros((*depth_m.shape, 3), np.uint8), depth_m=depth_m)

    def close(self) -> None:
        self._capture.close()

    def interrupt(self) -> None:
        self._capture.interrupt()


def adapted(open_capture: OpenCapture, settings: SourceSettings) -> OpenCapture:
    """Apply the settings that hold for every kind of source: depth in metres, then orientation."""
    orientation = settings.orientation

    def open_adapted() -> Capture:
        capture = open_capture()
        if settings.as_depth:
            capture = DepthCapture(capture, settings.depth_scale)
        return OrientedCapture(capture, orientation) if orientation else capture

    return open_adapted


def label(uri: str, settings: SourceSettings) -> str:
    """A source in messages: its address without secrets, after its name if it has one."""
    shown = without_password(uri)
    return shown if settings.name is None else f"{settings.name} ({shown})"
