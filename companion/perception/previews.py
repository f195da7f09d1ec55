"""Images, depth images and point clouds for readers of the bus, encoded in threads of the worker."""

from __future__ import annotations

import logging
import math
import os
import threading
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import cv2
import numpy as np

from companion.perception.messages import CloudPreview, DepthPreview, Preview
from companion.settings import PreviewSection
from companion.settings.perception import CameraSection, cloud_voxel_m
from vision.annotate import annotate
from vision.depth import centre_depth, depth_millimetres
from vision.detections import Detections
from vision.frame import Frame
from vision.point_cloud import cloud_from_depth, voxel_grid

logger = logging.getLogger(__name__)

# In the worker the network has priority over preview images.
_PREVIEW_NICER = 5
JPEG_QUALITY = 80
# Bounds a point cloud: at most that many squares of pixels of a larger image.
MAX_CLOUD_POINTS = 20_000

_Encoded = TypeVar("_Encoded")


class _Encoder(ABC, Generic[_Encoded]):
    """Encodes frames in a thread, at most `rate_hz` a second; only the newest frame waits.

    Attributes:
        watched: whether the results are wanted; if not, a frame costs nothing.

    Args:
        deliver: called with each result, in the encoder's thread.
    """

    def __init__(self, name: str, rate_hz: float, deliver: Callable[[_Encoded], None]) -> None:
        self.watched = False
        self._rate_hz = rate_hz
        self._deliver = deliver
        self._due_ns = 0
        self._changed = threading.Condition()
        self._waiting: tuple[Frame, Detections] | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def write(self, frame: Frame, detections: Detections) -> None:
        """Queue a frame with the newest detections. Never waits."""
        if not self._wanted(frame) or frame.captured_ns < self._due_ns:
            return
        self._due_ns = frame.captured_ns + round(1e9 / self._rate_hz)
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
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), min(nice + _PREVIEW_NICER, 19))
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed or self._waiting is None:
                    return
                (frame, detections), self._waiting = self._waiting, None
            try:
                for encoded in self._encoded(frame, detections):
                    self._deliver(encoded)
            except Exception:  # a failed preview must not end the thread
                logger.exception("%s of %dx%d failed", self._thread.name, frame.width, frame.height)

    def _wanted(self, frame: Frame) -> bool:
        return self.watched

    @abstractmethod
    def _encoded(self, frame: Frame, detections: Detections) -> Iterator[_Encoded]:
        """Encode one frame."""


class PreviewEncoder(_Encoder[Preview | DepthPreview]):
    """Encodes preview images, and the depth images of the same frames: a replay needs both of a frame.

    Attributes:
        watched: whether images are wanted. depth: whether depth images are.
    """

    def __init__(self, settings: PreviewSection, deliver: Callable[[Preview | DepthPreview], None]) -> None:
        self.depth = False
        self._settings = settings
        super().__init__("preview", settings.rate_hz, deliver)

    def _wanted(self, frame: Frame) -> bool:
        return self.watched or (self.depth and frame.depth_m is not None)

    def _encoded(self, frame: Frame, detections: Detections) -> Iterator[Preview | DepthPreview]:
        if self.watched:
            yield self._image(frame, detections)
        if self.depth and frame.depth_m is not None:
            data = zlib.compress(depth_millimetres(frame.depth_m).tobytes(), 1)
            yield DepthPreview(frame.sequence, frame.captured_ns, frame.width, frame.height, data)

    def _image(self, frame: Frame, detections: Detections) -> Preview:
        image = frame.image
        if self._settings.annotate:
            centre_m = None if frame.depth_m is None else centre_depth(frame.depth_m)
            image = annotate(image, detections, centre_m=centre_m)
        if frame.width > self._settings.width:
            height = max(1, round(frame.height * self._settings.width / frame.width))
            smaller = cv2.resize(image, (self._settings.width, height), interpolation=cv2.INTER_AREA)
            image = smaller.astype(np.uint8, copy=False)
        _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return Preview(frame.sequence, frame.captured_ns, jpeg.tobytes())


class CloudEncoder(_Encoder[CloudPreview]):
    """Makes point clouds of frames with depth, in the camera's optical frame.

    Attributes:
        camera: its lens.
    """

    def __init__(
        self, settings: PreviewSection, camera: CameraSection, deliver: Callable[[CloudPreview], None]
    ) -> None:
        self.camera = camera
        self._settings = settings
        super().__init__("cloud", settings.cloud_rate_hz, deliver)

    def _wanted(self, frame: Frame) -> bool:
        return self.watched and frame.depth_m is not None

    def _encoded(self, frame: Frame, detections: Detections) -> Iterator[CloudPreview]:
        assert frame.depth_m is not None
        cloud = cloud_from_depth(
            frame.depth_m,
            self.camera.model(frame.width, frame.height),
            image=frame.image,
            range_m=(0.0, self._settings.cloud_range_m),
            average=math.ceil(math.sqrt(frame.width * frame.height / MAX_CLOUD_POINTS)),
        )
        reduced = voxel_grid(cloud, cloud_voxel_m(self._settings.cloud_range_m))
        yield CloudPreview(frame.sequence, frame.captured_ns, len(reduced), reduced.packed())
