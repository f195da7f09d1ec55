"""Images without losses: the processed frames of the cameras from shared memory, as PNG, with their depth."""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
import zlib
from collections.abc import Mapping
from typing import Protocol

import cv2

from companion.bus.topics import DEPTH_IMAGE, IMAGE
from vision.depth import depth_millimetres
from vision.shared_frame import SharedFrameReader

# Shared memory does not notify; a poll of one camera takes some microseconds.
_POLL_S = 0.005
_REOPEN_S = 0.5
# After a fault of ours: with its traceback.
_FAULT_S = 30.0

logger = logging.getLogger(__name__)


class FrameWriter(Protocol):
    """The part of `Recorder` that the encoder needs."""

    dropped_images: int

    @property
    def late(self) -> bool: ...
    def add(self, path: str, payload: bytes, attachment: bytes | None) -> None: ...


class FrameEncoder:
    """Encodes each new frame in a thread; a frame that is replaced by a newer one meanwhile is dropped.

    Args:
        frames: path of a camera's topic `image` → name of the shared memory.
    """

    def __init__(self, frames: Mapping[str, str], recorder: FrameWriter) -> None:
        self._cameras = [_Camera(path, name) for path, name in frames.items()]
        self._recorder = recorder
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="lossless images", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End after the frame that is being encoded."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        with contextlib.ExitStack() as stack:
            for camera in self._cameras:
                stack.callback(camera.close)
            while not self._closing.wait(_POLL_S):
                for camera in self._cameras:
                    camera.encode(self._recorder)


class _Camera:
    def __init__(self, path: str, name: str) -> None:
        self._path, self._name = path, name
        self._reader: SharedFrameReader | None = None
        self._open_due_s = 0.0
        self._after: int | None = None

    def encode(self, recorder: FrameWriter) -> None:
        """Pass the newest frame on, if it is new. Never raises: a frame that cannot be read is dropped."""
        try:
            self._encode(recorder)
        except Exception:
            logger.exception("%s: a frame could not be recorded", self._path)
            self._open_due_s = time.monotonic() + _FAULT_S
            self.close()

    def _encode(self, recorder: FrameWriter) -> None:
        reader = self._opened()
        try:
            frame = None if reader is None else reader.latest(self._after)
        except ValueError:  # the segment of a new writer cannot be read
            self.close()
            return
        if frame is None:
            return
        if self._after is not None:
            recorder.dropped_images += max(0, frame.sequence - self._after - 1)
        self._after = frame.sequence
        if recorder.late:
            recorder.dropped_images += 1
            return
        about = {"captured_ns": frame.captured_ns, "width": frame.width, "height": frame.height}
        attachment = json.dumps(about).encode()
        if frame.depth_m is not None:
            data = zlib.compress(depth_millimetres(frame.depth_m).tobytes(), 0)  # the file is compressed
            recorder.add(self._path.removesuffix(IMAGE.name) + DEPTH_IMAGE.name, data, attachment)
        # OpenCV chooses zlib's fastest level with run lengths: half the time of the level 1 that can be
        # named, and smaller.
        _, png = cv2.imencode(".png", frame.image)
        recorder.add(self._path, png.tobytes(), attachment)

    def close(self) -> None:
        """Release the shared memory."""
        if self._reader is not None:
            self._reader.close()
        self._reader = None

    def _opened(self) -> SharedFrameReader | None:
        """The reader, once the camera has processed its first frame."""
        if self._reader is None and time.monotonic() >= self._open_due_s:
            self._open_due_s = time.monotonic() + _REOPEN_S
            with contextlib.suppress(OSError, ValueError):
                self._reader = SharedFrameReader(self._name)
        return self._reader
