"""The annotated video, written in a separate thread: encoding a frame can take longer than processing it."""

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

from vision.annotate import annotate_level
from vision.detections import Detections
from vision.extras import install_command
from vision.frame import Frame
from vision.levelling import Levelling
from vision.video_writer import VideoWriter, VideoWriterError

logger = logging.getLogger(__name__)

# Queue for the encoder: two seconds of frames, so that a short load peak leaves no gap, but not more than
# this memory, and a few frames in any case. A permanently slow encoder cannot catch up.
_QUEUED_S, _QUEUED_BYTES, _LEAST_QUEUED = 2.0, 48_000_000, 4
# `close` does not wait longer than this; frames still queued are then dropped and logged.
_FINISHING_S = 2.0
# The network, in the same process, has priority.
_NICER = 5


@dataclass(frozen=True, slots=True)
class _QueuedFrame:
    frame: Frame
    detections: Detections
    lines: tuple[str, ...]
    highlight: str | None


class Recording:
    """Records frames at the video's rate, with detections and text lines.

    A recording that fails (a full disk) logs the error once and ends; `write` remains safe to call.

    Attributes:
        lines: text to draw on the next frames.
        highlight: class whose most confident detection is highlighted, or None.
        level: levels the images; None: they stay as they are. Called in the recording's thread.
        skipped: frames the encoder had no time for; the previous frame is repeated.
    """

    def __init__(self, path: Path | str, rate_hz: float) -> None:
        """
        Args:
            path: ends in `.webm`.
            rate_hz: frames per second of the video.

        Raises:
            VideoWriterError: the file cannot be created.
        """
        self.lines: tuple[str, ...] = ()
        self.highlight: str | None = None
        self.level: Levelling | None = None
        self.skipped = 0
        self._path = Path(path)
        self._period_ns = 1e9 / rate_hz
        self._rate_hz = rate_hz
        self._first_ns: int | None = None
        self._next_slot = 0
        self._refused_slot: int | None = None
        self._queue: queue.Queue[_QueuedFrame | None] = queue.Queue()
        self._failed = threading.Event()
        self._finished_by_s = math.inf
        # The frame size is known only with the first frame; check now that the file can be written.
        with VideoWriter(self._path, 16, 16, rate_hz):
            pass
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    def write(self, frame: Frame, detections: Detections) -> None:
        """Queue one frame. Never blocks."""
        if self._first_ns is None:
            self._first_ns = frame.captured_ns
        slot = round((frame.captured_ns - self._first_ns) / self._period_ns)
        if slot < self._next_slot or self._failed.is_set():
            return
        self._count_lost_before(slot)
        most = min(_QUEUED_S * self._rate_hz, _QUEUED_BYTES / frame.image.nbytes)
        if self._queue.qsize() >= max(_LEAST_QUEUED, most):
            # Not lost yet: a later frame may still fill this slot of the video.
            self._refused_slot = slot
        else:
            self._queue.put(_QueuedFrame(frame, detections, self.lines, self.highlight))
            self._refused_slot = None
            self._next_slot = slot + 1

    def _count_lost_before(self, slot: float) -> None:
        if self._refused_slot is not None and self._refused_slot < slot:
            self.skipped += 1

    def close(self) -> None:
        """Finish the file; no file is left if there was no frame. A second call does nothing.

        The encoder gets two seconds for queued frames; the video is valid even if some are dropped.
        """
        if not self._thread.is_alive():
            return
        self._finished_by_s = time.monotonic() + _FINISHING_S
        self._queue.put(None)
        self._thread.join()
        self._count_lost_before(math.inf)
        if self.skipped:
            logger.warning(
                "%s: %d frames are missing, the encoder was too slow; lower rate_hz%s",
                self._path,
                self.skipped,
                "" if find_spec("av") else f", or {install_command('av')} for a faster encoder",
            )

    def _run(self) -> None:
        nice = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), min(nice + _NICER, 19))
        writer: VideoWriter | None = None
        while (queued := self._queue.get()) is not None:
            if self._failed.is_set():
                continue
            if time.monotonic() > self._finished_by_s:
                self.skipped += 1
                continue
            try:
                if writer is None:
                    writer = VideoWriter(self._path, queued.frame.width, queued.frame.height, self._rate_hz)
                _add(writer, queued, self.level)
            except Exception as error:
                self._fail(error)
        try:
            if writer is not None:
                writer.close()
            elif not self._failed.is_set():
                self._path.unlink(missing_ok=True)  # no frame: no video
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        if self._failed.is_set():
            return
        self._failed.set()
        # A file error is logged in one line; an internal error with its traceback.
        fault = None if isinstance(error, VideoWriterError | OSError) else error
        logger.error("recording failed: %s", error, exc_info=fault)


def _add(writer: VideoWriter, queued: _QueuedFrame, level: Levelling | None) -> None:
    names = queued.detections.names
    highlight = names.index(queued.highlight) if queued.highlight in names else None
    drawn = annotate_level(queued.frame, queued.detections, level, lines=queued.lines, highlight=highlight)
    size = (writer.width, writer.height)
    if (queued.frame.width, queued.frame.height) != size:
        drawn = cv2.resize(drawn, size).astype(np.uint8, copy=False)
    writer.write(drawn, queued.frame.captured_ns)
