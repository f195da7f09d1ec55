"""Preview images: the newest frame as JPEG, encoded in a thread, only while requested."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable

import cv2
import numpy as np

from companion.perception.messages import Preview
from companion.settings import PreviewSection
from vision.annotate import annotate
from vision.detections import Detections
from vision.frame import Frame

logger = logging.getLogger(__name__)

# The network, in the same process, has priority.
_NICER = 5


class PreviewEncoder:
    """Encodes at most `rate_hz` frames a second; only the newest frame waits.

    Attributes:
        watched: whether previews are wanted; if not, a frame costs nothing.

    Args:
        deliver: called with each preview, in the encoder's thread.
    """

    def __init__(self, settings: PreviewSection, deliver: Callable[[Preview], None]) -> None:
        self.watched = False
        self._settings = settings
        self._deliver = deliver
        self._due_ns = 0
        self._changed = threading.Condition()
        self._waiting: tuple[Frame, Detections] | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="preview", daemon=True)
        self._thread.start()

    def write(self, frame: Frame, detections: Detections) -> None:
        """Queue a frame with the newest detections. Never waits."""
        if not self.watched or frame.captured_ns < self._due_ns:
            return
        self._due_ns = frame.captured_ns + round(1e9 / self._settings.rate_hz)
        with self._changed:
            self._waiting = (frame, detections)
            self._changed.notify()

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        nice = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), min(nice + _NICER, 19))
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed or self._waiting is None:
                    return
                (frame, detections), self._waiting = self._waiting, None
            try:
                self._deliver(self._encoded(frame, detections))
            except Exception:  # a failed preview must not end the thread
                logger.exception("preview of %dx%d failed", frame.width, frame.height)

    def _encoded(self, frame: Frame, detections: Detections) -> Preview:
        image = annotate(frame.image, detections) if self._settings.annotate else frame.image
        if frame.width > self._settings.width:
            height = max(1, round(frame.height * self._settings.width / frame.width))
            smaller = cv2.resize(image, (self._settings.width, height), interpolation=cv2.INTER_AREA)
            image = smaller.astype(np.uint8, copy=False)
        _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._settings.quality])
        return Preview(frame.sequence, frame.captured_ns, jpeg.tobytes())
