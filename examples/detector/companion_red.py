"""A detector plug-in: `--detector-kind red` detects red objects by colour, without a network."""

import cv2
import numpy as np
from numpy.typing import NDArray

from vision import Detections, DetectorSettings, ObjectDetector
from vision.object_detector import detector


@detector("red", "red objects larger than 30 pixels, by colour")
class RedDetector(ObjectDetector):
    class_names = ("blob",)

    def __init__(self, settings: DetectorSettings) -> None:
        self._scale = settings.image_size  # longer side of the processed image, pixels

    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections:
        scale = min(1.0, self._scale / max(image_bgr.shape[:2]))
        small = cv2.resize(image_bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        blue, green, red = cv2.split(small.astype(np.int16))
        redness = red - np.maximum(blue, green)  # 0..255, 255 for pure red
        _, labels, table, _ = cv2.connectedComponentsWithStats((redness > 60).astype(np.uint8))
        blobs = [index for index in range(1, len(table)) if table[index, cv2.CC_STAT_AREA] > 30]
        boxes = [(x, y, x + w, y + h) for x, y, w, h, _ in table[blobs]]
        confidence = [redness[labels == index].mean() / 255 for index in blobs]
        return Detections(
            np.array(boxes, np.float32).reshape(-1, 4) / np.float32(scale),
            np.array(confidence, np.float32),
            np.zeros(len(blobs), np.int64),
            self.class_names,
        )
