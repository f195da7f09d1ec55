"""`companion preview`: what a source delivers, as a status line and as pictures in a folder; no window."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.annotate import annotate
from vision.detections import Detections
from vision.frame import Frame
from vision.sources import Source

GREY_DIVISOR = 3
_RATE_WINDOW_S = 2.0


@dataclass(frozen=True, slots=True)
class PreviewOptions:
    """What is shown.

    Attributes:
        topic: where the service publishes this source's pictures.
        save: folder of the pictures, `<sequence>.jpg`; None: none are saved.
        grey: the picture in grey, a third as wide and high.
        period_s: interval of lines and pictures, seconds; 0: every frame.
        limit: number of lines after which it ends; None: with the source.
    """

    topic: str
    save: Path | None = None
    grey: bool = False
    period_s: float = 1.0
    limit: int | None = None


class RateMeter:
    """The rate of a source over the last two seconds, from stamps and sequence numbers: lost frames count."""

    def __init__(self) -> None:
        self._seen: deque[tuple[int, int]] = deque()

    def add(self, captured_ns: int, sequence: int) -> float | None:
        """Add a frame; returns the rate in Hz, None before the second frame."""
        self._seen.append((captured_ns, sequence))
        while captured_ns - self._seen[0][0] > _RATE_WINDOW_S * 1e9:
            self._seen.popleft()
        first_ns, first = self._seen[0]
        return (sequence - first) * 1e9 / (captured_ns - first_ns) if captured_ns > first_ns else None


def preview_source(source: Source, options: PreviewOptions, write: Callable[[str], None]) -> int:
    """Print a line, and save a picture, every `period_s` until the source ends.

    Returns:
        Number of lines.

    Raises:
        OSError: a picture cannot be written.
    """
    if options.save is not None:
        options.save.mkdir(parents=True, exist_ok=True)
    meter = RateMeter()
    shown, due_s = 0, time.monotonic()
    for frame in source:
        rate_hz = meter.add(frame.captured_ns, frame.sequence)
        # The first frame has no rate yet.
        if time.monotonic() < due_s or (rate_hz is None and options.period_s > 0.0 and shown == 0):
            continue
        due_s = time.monotonic() + options.period_s
        lines = status_lines(source, frame, rate_hz, options.topic)
        write("  ".join(lines))
        if options.save is not None:
            path = options.save / f"{frame.sequence:06d}.jpg"
            if not cv2.imwrite(str(path), picture(frame, lines, grey=options.grey)):
                raise OSError(f"cannot write {path}: check free disk space and write permission")
        shown += 1
        if shown == options.limit:
            break
    return shown


def status_lines(source: Source, frame: Frame, rate_hz: float | None, topic: str) -> tuple[str, ...]:
    """Device, topic, size and rate, stamp and losses."""
    age_ms = (time.monotonic_ns() - frame.captured_ns) / 1e6
    statistics = source.statistics
    rate = "" if rate_hz is None else f"  {rate_hz:.1f} Hz"
    return (
        source.uri,
        topic,
        f"{frame.width}x{frame.height}{rate}",
        f"stamp {frame.captured_ns / 1e9:.3f} s, {age_ms:.0f} ms ago",
        f"frame {frame.sequence}, {statistics.dropped} dropped, {statistics.unreadable} unreadable",
    )


def picture(frame: Frame, lines: tuple[str, ...], *, grey: bool) -> NDArray[np.uint8]:
    """The frame with its lines, (height, width, 3) BGR; with `grey` a third as wide and high."""
    image = frame.image
    if grey:
        size = (max(frame.width // GREY_DIVISOR, 1), max(frame.height // GREY_DIVISOR, 1))
        small = cv2.resize(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), size, interpolation=cv2.INTER_AREA)
        image = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR).astype(np.uint8, copy=False)
    return annotate(image, Detections.empty(()), lines=lines)
