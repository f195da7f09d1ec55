"""A colour source and a second source with its depth, paired by their stamps."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vision.depth_registration import DepthCalibration
from vision.frame import Frame
from vision.sources.capture import Capture, RawFrame
from vision.sources.latest import LatestSource
from vision.sources.sequential import SequentialSource
from vision.sources.source import EndOfStream, Source, SourceError, SourceSettings, SourceUnavailableError

logger = logging.getLogger(__name__)

TOLERANCE_S = 0.02
"""Largest difference of the stamps of a pair: cameras of 30 Hz that are not synchronized stay below it."""
_WAIT_S = 0.04  # for a depth image that arrives after its colour image
_KEPT = 8  # depth images of a live source
_LOST_WAITS = 3  # in vain and in a row: the depth source is lost


class DepthImages:
    """The newest depth images of a live source, as they arrive."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, NDArray[np.float32]]] = deque(maxlen=_KEPT)
        self._changed = threading.Condition()
        self._waits_in_vain = 0

    def add(self, frame: Frame) -> None:
        """`on_frame` of the depth source."""
        assert frame.depth_m is not None
        with self._changed:
            self._kept.append((frame.captured_ns / 1e9, frame.depth_m))
            self._waits_in_vain = 0
            self._changed.notify()

    def nearest(self, stamp_s: float) -> tuple[float, NDArray[np.float32]] | None:
        """The image with the nearest stamp; None before the first.

        Waits for it to arrive, but not while the depth source is lost: colour would be late for nothing.
        """
        with self._changed:
            if self._waits_in_vain < _LOST_WAITS:
                self._waits_in_vain += 1
                arrived = self._changed.wait_for(
                    lambda: self._kept and self._kept[-1][0] >= stamp_s - TOLERANCE_S / 2, _WAIT_S
                )
                if arrived:
                    self._waits_in_vain = 0
            return min(self._kept, key=lambda kept: abs(kept[0] - stamp_s), default=None)


class PairedCapture(Capture):
    """The frames of `colour` with the depth of `depth`. Both are open; the caller closes them.

    Live sources are paired by their capture stamps, recordings by their media time. Frames before the first
    pair are skipped; later ones without a partner are delivered without depth.

    Args:
        depth_images: `on_frame` of the depth source, for live ones.
        tolerance_s: largest difference of the stamps of a pair.
        registration: of depth to the colour image; None: it is registered.
    """

    silence_is_loss = False

    def __init__(
        self,
        colour: Source,
        depth: Source,
        depth_images: DepthImages,
        settings: SourceSettings,
        tolerance_s: float = TOLERANCE_S,
        registration: DepthCalibration | None = None,
    ) -> None:
        self._tolerance_s, self._registration = tolerance_s, registration
        self._colour, self._depth, self._depth_images = colour, depth, depth_images
        self._timeout_s = settings.open_timeout_s
        self._current: Frame | None = None
        self._next: Frame | None = None
        self._depth_ended = False
        self._paired = False
        self._smallest_gap_s = float("inf")
        self._first_s: float | None = None
        self._paired_s = 0.0
        self._next_sequence = 0
        self.total_frames = colour.total_frames
        self.calibration = colour.calibration

    def read(self, timeout_s: float) -> RawFrame | None:
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                frame = self._colour.read(max(deadline_s - time.monotonic(), 0.0))
            except EndOfStream:
                if not self._paired:
                    raise self._never_paired() from None
                raise
            if frame is None:
                return None
            depth_m = self._depth_of(frame)
            if depth_m is not None or self._paired:
                break
            if self._first_s is None:
                self._first_s = time.monotonic()
            if self._colour.live and time.monotonic() - self._first_s > self._timeout_s:
                raise self._never_paired()
        self._note_loss(depth_m is not None)
        unreadable = self._colour.statistics.unreadable
        skipped = frame.sequence - self._next_sequence - (unreadable - self.unreadable)
        self._next_sequence = frame.sequence + 1
        self.unreadable = unreadable
        captured_ns = frame.captured_ns if self._colour.live else None
        return RawFrame(
            frame.image,
            captured_ns,
            depth_m,
            frame.media_s,
            max(skipped, 0),
            frame.decode_ms,
            frame.file_name,
        )

    def _never_paired(self) -> SourceUnavailableError:
        gap = (
            f"the nearest is {self._smallest_gap_s:.3g} s away" if self._smallest_gap_s < 1e9 else "none came"
        )
        return SourceUnavailableError(
            f"no depth within {self._tolerance_s * 1000:.3g} ms of an image, {gap}; both sources need "
            f"the same clock, and recordings the same rate (source.rate_hz)"
        )

    def _depth_of(self, frame: Frame) -> NDArray[np.float32] | None:
        """The depth of a frame, None without a partner. Raises SourceError if it has another size."""
        found = self._live_depth(frame) if self._colour.live else self._recorded_depth(frame)
        if found is None:
            return None
        gap_s, depth_m = found
        self._smallest_gap_s = min(self._smallest_gap_s, gap_s)
        if gap_s > self._tolerance_s:
            return None
        if self._registration is not None:
            try:
                depth_m = self._registration.register(depth_m, frame.width, frame.height)
            except ValueError as error:
                raise SourceError(f"{self._depth.uri}: source.depth_calibration_file: {error}") from error
        if depth_m.shape != (frame.height, frame.width):
            raise SourceError(
                f"{self._depth.uri}: depth is {depth_m.shape[1]}x{depth_m.shape[0]}, the image "
                f"{frame.width}x{frame.height}: depth must be registered to the colour image and have its "
                "size, or source.depth_calibration_file must be set (companion calibrate lens --depth-source)"
            )
        self._paired = True
        return depth_m

    def _live_depth(self, frame: Frame) -> tuple[float, NDArray[np.float32]] | None:
        stamp_s = frame.captured_ns / 1e9
        nearest = self._depth_images.nearest(stamp_s)
        if not self._depth_ended:
            try:
                self._depth.read(0.0)  # raises its error
            except EndOfStream:
                self._depth_ended = True
            except SourceError as error:
                raise depth_error(error, self._depth.uri) from error
        return None if nearest is None else (abs(nearest[0] - stamp_s), nearest[1])

    def _recorded_depth(self, frame: Frame) -> tuple[float, NDArray[np.float32]] | None:
        """Advance through the recording while its next image is nearer than the current one."""
        while not self._depth_ended:
            if self._next is None:
                try:
                    self._next = self._depth.read()
                except EndOfStream:
                    self._depth_ended = True
                except SourceError as error:
                    raise depth_error(error, self._depth.uri) from error
            if self._next is None:
                continue
            if self._current is not None and _gap_s(self._current, frame) < _gap_s(self._next, frame):
                break
            self._current, self._next = self._next, None
        if self._current is None or self._current.depth_m is None:
            return None
        return _gap_s(self._current, frame), self._current.depth_m

    def _note_loss(self, has_depth: bool) -> None:
        """Log once that depth is missing, and once that it is back."""
        now_s = time.monotonic()
        if has_depth:
            if self._paired_s < 0.0:
                logger.warning("%s: depth is back", self._depth.uri)
            self._paired_s = now_s
        elif self._paired_s >= 0.0 and now_s - self._paired_s > 1.0:
            logger.warning("%s: no depth with the stamps of the images for 1 s", self._depth.uri)
            self._paired_s = -1.0

    def close(self) -> None:
        """The sources are closed by `open_paired`'s source."""


def depth_error(error: SourceError, uri: str) -> SourceError:
    """The error of a depth source, with its address."""
    return error if uri in str(error) else type(error)(f"source.depth {uri}: {error}")


def _gap_s(one: Frame, other: Frame) -> float:
    return abs((one.media_s or 0.0) - (other.media_s or 0.0))


def paired_source(
    colour: Source,
    depth: Source,
    depth_images: DepthImages,
    settings: SourceSettings,
    *,
    tolerance_s: float = TOLERANCE_S,
    registration: DepthCalibration | None = None,
) -> Source:
    """One source of both, which it closes.

    Raises:
        SourceError: one is live and the other a recording, their stamps never agree, or their sizes differ.
    """

    def close() -> None:
        colour.close()
        depth.close()

    try:
        if colour.live != depth.live:
            live, recorded = (colour, depth) if colour.live else (depth, colour)
            raise SourceError(
                f"{live.uri} is live and {recorded.uri} a recording: their images have no common time"
            )
    except SourceError:
        close()
        raise
    # Both are rotated already, and named.
    outer = replace(settings, depth=None, depth_calibration_file=None, rotate_deg=0, mirror=False, name=None)
    uri = f"{colour.uri} with depth of {depth.uri}"

    def open_capture() -> Capture:
        return PairedCapture(colour, depth, depth_images, settings, tolerance_s, registration)

    if colour.live or settings.realtime:
        paced = not colour.live
        return LatestSource(uri, open_capture, outer, reopen=False, paced=paced, on_close=close)
    return SequentialSource(uri, open_capture, outer, on_close=close)
