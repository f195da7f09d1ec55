"""Whether it can be told at all how far away what is seen is, before something is flown to."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from companion.guidance.targets.from_detections import MIN_DEPRESSION_RAD
from vision.camera_model import CameraModel


@dataclass(frozen=True, slots=True)
class RangeMeans:
    """What the camera that steers has for it. By default everything: nothing is missing.

    Attributes:
        depth: it has given depth.
        ground: its picture shows ground, of a level vehicle above it.
        classes: whose height is known (`detector.class_heights_m`).
    """

    depth: bool = True
    ground: bool = True
    classes: frozenset[str] = frozenset()

    def missing(self, class_names: Iterable[str]) -> str | None:
        """What is missing before the range of these can be known, in words; None: nothing is."""
        if self.depth or self.ground:
            return None
        unknown = [name for name in class_names if name not in self.classes]
        if not unknown:
            return None
        return (
            f"a range to a {' or a '.join(unknown)} (a camera with depth, one that sees the ground, "
            "or its height in detector.class_heights_m)"
        )


ALL_MEANS = RangeMeans()


def sees_ground(camera: CameraModel, pitch_rad: float) -> bool:
    """Whether the lower edge of a picture looks far enough down for the ground to tell ranges.

    Args:
        pitch_rad: of the camera above the horizon, with the vehicle level.
    """
    below_axis_rad = math.atan2(camera.height - 1 - camera.cy, camera.fy)
    return below_axis_rad - pitch_rad > MIN_DEPRESSION_RAD
