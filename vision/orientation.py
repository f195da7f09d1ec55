"""Mirrors and rotates what a camera delivers: image, depth, lens model and mount.

The image is mirrored left to right first, and then rotated clockwise. Both only move pixels:

* Lens: focal lengths and principal point move with the pixels; by 90 or 270 degrees x and y are exchanged.
  The radial distortion stays, the tangential one (p1, p2) rotates as a vector does.
* Mount: the position stays. The optical frame turns about its own axis z, which is the mount's innermost
  angle: only roll changes, by `-rotate_deg`. Mirroring changes nothing: it undoes the mirror image that the
  source delivers (a mirror in front of the lens, a webcam's selfie image), of which no mount exists.

So a camera that is fixed upside down, with `rotate_deg=180`, has a roll of 0. What a person calibrates or
measures is that of the delivered image; only a calibration that the source brings is converted here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.camera_model import EQUIDISTANT, CameraCalibration, CameraModel, CameraMount

ROTATIONS_DEG = (0, 90, 180, 270)
_ROTATE_CODES = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


_Number = TypeVar("_Number", np.uint8, np.float32)


@dataclass(frozen=True, slots=True)
class Orientation:
    """Mirror left to right, then rotate by `rotate_deg` (0, 90, 180, 270) clockwise."""

    rotate_deg: int = 0
    mirror: bool = False

    def __post_init__(self) -> None:
        if self.rotate_deg not in ROTATIONS_DEG:
            raise ValueError(f"rotate_deg must be 0, 90, 180 or 270, got {self.rotate_deg}")

    def __bool__(self) -> bool:
        """Whether it changes anything."""
        return self.mirror or self.rotate_deg != 0

    def pixels(self, image: NDArray[_Number]) -> NDArray[_Number]:
        """An image (height, width, 3) or depth (height, width); 90 and 270 degrees exchange its sides."""
        if self.mirror:
            image = cv2.flip(image, 1).astype(image.dtype, copy=False)
        if self.rotate_deg:
            image = cv2.rotate(image, _ROTATE_CODES[self.rotate_deg]).astype(image.dtype, copy=False)
        return image

    def model(self, model: CameraModel) -> CameraModel:
        """The lens of the image that `pixels` returns."""
        if self.mirror:
            distortion = _with_tangential(model, lambda p1, p2: (p1, -p2))
            model = replace(model, cx=model.width - 1 - model.cx, distortion=distortion)
        for _ in range(self.rotate_deg // 90):
            # Clockwise by 90 degrees: the new x is the old -y, the new y the old x.
            model = replace(
                model,
                width=model.height,
                height=model.width,
                fx=model.fy,
                fy=model.fx,
                cx=model.height - 1 - model.cy,
                cy=model.cx,
                distortion=_with_tangential(model, lambda p1, p2: (p2, -p1)),
            )
        return model

    def mount(self, mount: CameraMount) -> CameraMount:
        """The mount of the image that `pixels` returns."""
        roll_rad = mount.roll_rad - math.radians(self.rotate_deg)
        return replace(mount, roll_rad=math.remainder(roll_rad, math.tau))

    def calibration(self, calibration: CameraCalibration) -> CameraCalibration:
        """Lens and mount of the image that `pixels` returns."""
        mount = None if calibration.mount is None else self.mount(calibration.mount)
        return CameraCalibration(self.model(calibration.model), mount)


def _with_tangential(
    model: CameraModel, change: Callable[[float, float], tuple[float, float]]
) -> tuple[float, ...]:
    """The distortion with other tangential coefficients; a fisheye has none."""
    if not model.distortion or model.distortion_model == EQUIDISTANT:
        return model.distortion
    k1, k2, p1, p2, *rest = model.distortion
    return (k1, k2, *change(p1, p2), *rest)
