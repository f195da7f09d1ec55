"""Available means of range estimation, checked before a behaviour flies to an object."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from companion.guidance.objects.from_detections import MIN_DEPRESSION_RAD
from vision.camera_model import CameraModel
from vision.class_names import fold_name


@dataclass(frozen=True, slots=True)
class RangeMeans:
    """Means of range estimation of the steering camera. The default has all.

    Attributes:
        depth: depth was received.
        ground: its image shows the ground when the vehicle is level above it.
        classes: those with a known height (`detector.class_heights_m`), as of `fold_name`.
    """

    depth: bool = True
    ground: bool = True
    classes: frozenset[str] = frozenset()

    def missing(self, class_names: Iterable[str]) -> str | None:
        """What is missing for the range of these classes, in words; None: nothing."""
        if self.depth or self.ground:
            return None
        unknown = [name for name in class_names if fold_name(name) not in self.classes]
        if not unknown:
            return None
        return (
            f"a range to a {' or a '.join(unknown)} (a camera with depth, one that sees the ground, "
            "or its height in detector.class_heights_m)"
        )


ALL_MEANS = RangeMeans()


def sees_ground(camera: CameraModel, pitch_rad: float) -> bool:
    """Whether the lower edge of the image points far enough down for ranges from the ground.

    Args:
        pitch_rad: of the camera above the horizon, with the vehicle level.
    """
    return _lower_edge_rad(camera) - pitch_rad > MIN_DEPRESSION_RAD


@lru_cache(maxsize=8)
def _lower_edge_rad(camera: CameraModel) -> float:
    """Angle of the lowest ray in the middle of the image below the camera's axis; -inf without any."""
    rows = np.linspace(camera.height - 1, 0, 64)
    rays = camera.rays(np.column_stack([np.full_like(rows, camera.cx), rows]))
    # A lens may have no rays near the edge.
    return next((math.atan2(down, forward) for _, down, forward in rays if math.isfinite(down)), -math.inf)
