"""The annotated video, in a thread of its own: to encode a frame can take longer than to look at it."""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from vision.annotate import annotate
from vision.detections import Detections
from vision.frame import Frame
from vision.video_writer import VideoWriter, VideoWriterError

logger = logging.getLogger(__name__)

# Pictures that wait for the encoder. More would only be memory: an encoder that is too slow stays too slow.
_WAITING_PICTURES = 4
# Whoever ends the program is not kept waiting: what waits then gets so long, and what would take longer is
# given up, and that is said. The last picture may take a second more, for the film to end with the flight.
_FINISHING_S = 2.0
_LAST_PICTURE_S = 1.0
# The network, in the same process, comes first.
_NICER = 5


@dataclass(frozen=True, slots=True)
class _Picture:
    slot: int  # its place in the film
    frame: Frame
    detections: Detections
    lines: tuple[str, ...]
    highlight: str | None


class Recording:
    """Every frame that the film's rate has room for, with what was seen in it and lines told from outside.

    A recording that fails (a full disk) says so once and ends; whoever gives it frames goes on.

    Attributes:
        lines: text to draw on the next frames.
        highlight: the class whose surest detection is drawn as the one that matters, or None.
        skipped: pictures of the film that the encoder had no time for; the one before stands in their place.
    """

    def __init__(self, path: Path | str, rate_hz: float) -> None:
        """
        Args:
            path: ends in `.webm`.
            rate_hz: frames a second of the film.

        Raises:
            VideoWriterError: no file can be made there.
        """
        self.lines: tuple[str, ...] = ()
        self.highlight: str | None = None
        self.skipped = 0
        self._path = Path(path)
        self._period_ns = 1e9 / rate_hz
        self._rate_hz = rate_hz
        self._first_ns: int | None = None
        self._next_slot = 0
        self._waiting: deque[_Picture] = deque()
        self._changed = threading.Condition()
        self._failed = threading.Event()
        self._closing = False
        self._finished_by_s = math.inf
        # A size is known only with the first frame; that nothing can be written there is known now.
        with VideoWriter(self._path, 16, 16, rate_hz):
            pass
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    def write(self, frame: Frame, detections: Detections) -> None:
        """Give it one frame. Never waits."""
        if self._first_ns is None:
            self._first_ns = frame.captured_ns
        slot = round((frame.captured_ns - self._first_ns) / self._period_ns)
        if slot < self._next_slot or self._failed.is_set():
            return
        picture = _Picture(slot, frame, detections, self.lines, self.highlight)
        with self._changed:
            if len(self._waiting) < _WAITING_PICTURES:
                self._waiting.append(picture)
            else:  # the newest is kept, whatever the encoder cannot draw before it
                self._waiting[-1] = picture
                self.skipped += 1
            self._changed.notify()
        self._next_slot = slot + 1

    def close(self) -> None:
        """Finish the file; no file is left if it got no frame. A second call does nothing.

        The encoder gets two seconds for the few pictures that wait; a film that is shorter for it is whole.
        """
        if not self._thread.is_alive():
            return
        with self._changed:
            self._finished_by_s = time.monotonic() + _FINISHING_S
            self._closing = True
            self._changed.notify()
        self._thread.join()
        if self.skipped:
            logger.warning(
                "%s: %d pictures are missing, the encoder was slow; a lower rate_hz suits this computer",
                self._path,
                self.skipped,
            )

    def _next(self) -> _Picture | None:
        """The picture to draw next, when there is one; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing)
            return self._waiting.popleft() if self._waiting else None

    def _fits(self, picture: _Picture, writer: VideoWriter, spent_s: float) -> bool:
        """Whether there is time for it. Places before it that are empty take theirs, too."""
        left_s = self._finished_by_s - time.monotonic()
        if not self._waiting:
            left_s = max(left_s, _LAST_PICTURE_S)
        return (picture.slot + 1 - writer.frames) * spent_s / writer.frames <= left_s

    def _run(self) -> None:
        nice = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), min(nice + _NICER, 19))
        writer: VideoWriter | None = None
        spent_s = 0.0
        while (picture := self._next()) is not None:
            if self._failed.is_set():
                continue
            try:
                if writer is None:
                    writer = VideoWriter(self._path, picture.frame.width, picture.frame.height, self._rate_hz)
                elif not self._fits(picture, writer, spent_s):
                    self.skipped += 1
                    continue
                started_s = time.monotonic()
                _add(writer, picture)
                spent_s += time.monotonic() - started_s
            except Exception as error:
                self._fail(error)
        try:
            if writer is not None:
                writer.close()
            elif not self._failed.is_set():
                self._path.unlink(missing_ok=True)  # a film without a frame is none
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        if self._failed.is_set():
            return
        self._failed.set()
        # What is wrong with a file is said in a line; of a fault of ours one wants to know where.
        fault = None if isinstance(error, VideoWriterError | OSError) else error
        logger.error("the recording has failed: %s", error, exc_info=fault)


def _add(writer: VideoWriter, picture: _Picture) -> None:
    names = picture.detections.names
    highlight = names.index(picture.highlight) if picture.highlight in names else None
    drawn = annotate(picture.frame.image, picture.detections, lines=picture.lines, highlight=highlight)
    size = (writer.width, writer.height)
    if (picture.frame.width, picture.frame.height) != size:
        drawn = cv2.resize(drawn, size).astype(np.uint8, copy=False)
    writer.write(drawn, picture.frame.captured_ns)
