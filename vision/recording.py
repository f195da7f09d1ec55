"""The annotated video, in a thread of its own: to encode a frame can take longer than to look at it."""

from __future__ import annotations

import logging
import math
import os
import queue
import threading
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

from vision.annotate import annotate
from vision.detections import Detections
from vision.frame import Frame
from vision.video_writer import VideoWriter, VideoWriterError

logger = logging.getLogger(__name__)

# Frames that wait for the encoder: two seconds of them, so that a busy moment of the computer leaves no gap,
# but not more than this memory, and a few in any case. An encoder that is too slow stays too slow.
_QUEUED_S, _QUEUED_BYTES, _LEAST_QUEUED = 2.0, 48_000_000, 4
# Whoever ends the program is not kept waiting: what still waits then is given up, and that is said.
_FINISHING_S = 2.0
# The network, in the same process, comes first.
_NICER = 5


@dataclass(frozen=True, slots=True)
class _Picture:
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
        self._refused_slot: int | None = None
        self._queue: queue.Queue[_Picture | None] = queue.Queue()
        self._failed = threading.Event()
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
        self._note_lost_before(slot)
        most = min(_QUEUED_S * self._rate_hz, _QUEUED_BYTES / frame.image.nbytes)
        if self._queue.qsize() >= max(_LEAST_QUEUED, most):
            # Not lost yet: a later frame may still take this picture's place in the film.
            self._refused_slot = slot
        else:
            self._queue.put(_Picture(frame, detections, self.lines, self.highlight))
            self._refused_slot = None
            self._next_slot = slot + 1

    def _note_lost_before(self, slot: float) -> None:
        if self._refused_slot is not None and self._refused_slot < slot:
            self.skipped += 1

    def close(self) -> None:
        """Finish the file; no file is left if it got no frame. A second call does nothing.

        The encoder gets two seconds for the few pictures that wait; a film that is shorter for it is whole.
        """
        if not self._thread.is_alive():
            return
        self._finished_by_s = time.monotonic() + _FINISHING_S
        self._queue.put(None)
        self._thread.join()
        self._note_lost_before(math.inf)
        if self.skipped:
            logger.warning(
                "%s: %d pictures are missing, the encoder was slow; a lower rate_hz suits this computer%s",
                self._path,
                self.skipped,
                "" if find_spec("av") else ", or pip install 'mavlink-companion[film]', which is faster",
            )

    def _run(self) -> None:
        nice = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), min(nice + _NICER, 19))
        writer: VideoWriter | None = None
        while (picture := self._queue.get()) is not None:
            if self._failed.is_set():
                continue
            if time.monotonic() > self._finished_by_s:
                self.skipped += 1
                continue
            try:
                if writer is None:
                    writer = VideoWriter(self._path, picture.frame.width, picture.frame.height, self._rate_hz)
                _add(writer, picture)
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
