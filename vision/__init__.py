"""Frames to targets: sources, detection, tracking, geometry. Knows no MAVLink, no asyncio, no zenoh.

>>> import numpy as np
>>> from vision import Detector
>>> detector = Detector(classes=["car"], image_size=320)
>>> detections = detector.detect(np.zeros((240, 320, 3), np.uint8))     # BGR, rows × columns × 3
>>> len(detections)
0

>>> from vision import CameraModel, MarkerDetector
>>> from vision.markers import MarkerKind
>>> camera = CameraModel.from_horizontal_fov(320, 240, 1.2)
>>> MarkerDetector(MarkerKind("4X4_50", size_m=0.2)).detect(np.zeros((240, 320, 3), np.uint8), camera)
()

Names are imported lazily, so `import vision` alone is cheap.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vision.camera_model import CameraModel, CameraMount
    from vision.detections import Detections
    from vision.detector import Detector
    from vision.frame import Frame
    from vision.markers import MarkerDetector
    from vision.object_detector import DetectorSettings, ObjectDetector
    from vision.pipeline import PerceptionResult, Pipeline
    from vision.sources.opening import open_source
    from vision.sources.source import Source, SourceError, SourceSettings
    from vision.tracking.byte_track import Tracker

_MODULES = {
    "CameraModel": "vision.camera_model",
    "CameraMount": "vision.camera_model",
    "Detections": "vision.detections",
    "Detector": "vision.detector",
    "DetectorSettings": "vision.object_detector",
    "Frame": "vision.frame",
    "MarkerDetector": "vision.markers",
    "ObjectDetector": "vision.object_detector",
    "PerceptionResult": "vision.pipeline",
    "Pipeline": "vision.pipeline",
    "Source": "vision.sources.source",
    "SourceError": "vision.sources.source",
    "SourceSettings": "vision.sources.source",
    "Tracker": "vision.tracking.byte_track",
    "open_source": "vision.sources.opening",
}

__all__ = [
    "CameraModel",
    "CameraMount",
    "Detections",
    "Detector",
    "DetectorSettings",
    "Frame",
    "MarkerDetector",
    "ObjectDetector",
    "PerceptionResult",
    "Pipeline",
    "Source",
    "SourceError",
    "SourceSettings",
    "Tracker",
    "__version__",
    "open_source",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562); also `__version__`."""
    if name == "__version__":
        from importlib.metadata import version

        return version("mavlink-companion")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
