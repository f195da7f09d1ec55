"""The pinhole camera with lens distortion, and how it is mounted on the vehicle.

Optical frame: x right, y down, z forward. Pixel (0, 0) is the centre of the top-left pixel.
Distortion is the Brown–Conrady model in OpenCV's order (k1, k2, p1, p2, k3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.rotation import BODY_FROM_OPTICAL, matrix_from_euler


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Intrinsics of one camera. Focal lengths and principal point in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0 or self.fx <= 0 or self.fy <= 0:
            raise ValueError(
                f"a camera needs a positive size and focal length, got {self.width}x{self.height}, "
                f"fx {self.fx}, fy {self.fy}"
            )
        if len(self.distortion) not in (0, 4, 5):
            raise ValueError(f"distortion must have 0, 4 or 5 coefficients, got {len(self.distortion)}")

    @classmethod
    def from_horizontal_fov(cls, width: int, height: int, fov_rad: float) -> CameraModel:
        """Square pixels, centred, no distortion, with a horizontal field of view `fov_rad`."""
        if not 0.0 < fov_rad < math.pi:
            raise ValueError(f"horizontal field of view must be in 0..π rad, got {fov_rad}")
        focal = width / 2 / math.tan(fov_rad / 2)
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) camera matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled(self, width: int, height: int) -> CameraModel:
        """The same camera at another image size."""
        sx, sy = width / self.width, height / self.height
        return CameraModel(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.distortion,
        )

    def project(self, points_optical: NDArray[Any]) -> NDArray[np.float64]:
        """(N, 3) points in the optical frame → (N, 2) pixels; NaN for points not in front of the camera."""
        points = np.asarray(points_optical, np.float64).reshape(-1, 3)
        pixels = np.full((len(points), 2), np.nan)
        ahead = points[:, 2] > 1e-9
        if ahead.any():
            plane = points[ahead, :2] / points[ahead, 2:]
            if self.distortion:
                plane = self._distort(plane)
            pixels[ahead] = plane * (self.fx, self.fy) + (self.cx, self.cy)
        return pixels

    def rays(self, pixels: NDArray[Any]) -> NDArray[np.float64]:
        """(N, 2) pixels → (N, 3) unit vectors in the optical frame."""
        points = np.asarray(pixels, np.float64).reshape(-1, 2)
        if self.distortion and len(points):
            plane = cv2.undistortPoints(
                points.reshape(-1, 1, 2), self.matrix, np.array(self.distortion)
            ).reshape(-1, 2)
        else:
            plane = (points - (self.cx, self.cy)) / (self.fx, self.fy)
        rays = np.ones((len(plane), 3))
        rays[:, :2] = plane
        rays /= np.sqrt((rays * rays).sum(axis=1, keepdims=True))
        return rays

    def _distort(self, plane: NDArray[np.float64]) -> NDArray[np.float64]:
        k1, k2, p1, p2, k3 = (*self.distortion, 0.0)[:5]
        x, y = plane[:, 0], plane[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )


@dataclass(frozen=True, slots=True)
class CameraMount:
    """Position of the camera on the body (FRD, metres) and rotation from the forward direction.

    A negative pitch looks down. With everything zero the camera looks along the body's forward axis.

    Attributes:
        stabilized: stabilized by a gimbal: roll and pitch are relative to the horizon, yaw to the vehicle's
            heading.
        on_gimbal: pointed by a gimbal: roll, pitch and yaw are relative to the gimbal's frame (FRD, x along
            its axis), whose attitude is given per frame, see `held`.
        ned_from_gimbal: (3, 3) gimbal attitude at one moment, gimbal FRD to NED; None: unknown.
    """

    forward_m: float = 0.0
    right_m: float = 0.0
    down_m: float = 0.0
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    stabilized: bool = False
    on_gimbal: bool = False
    ned_from_gimbal: NDArray[np.float64] | None = field(default=None, compare=False)

    def held(self, ned_from_gimbal: NDArray[np.float64]) -> CameraMount:
        """The mount of a camera on a gimbal at one moment, with the gimbal's (3, 3) attitude."""
        return replace(self, ned_from_gimbal=ned_from_gimbal)

    @property
    def position_frd_m(self) -> NDArray[np.float64]:
        """(3,) position of the optical centre in the body frame."""
        return np.array([self.forward_m, self.right_m, self.down_m])

    @property
    def body_from_optical(self) -> NDArray[np.float64]:
        """(3, 3) rotation from the optical frame to the body frame (FRD), for a stabilized one a level body.

        Read-only: cached and shared between equal mounts.

        Raises ValueError for a camera on a gimbal, where it is not constant.
        """
        if self.on_gimbal:
            raise ValueError("a camera on a gimbal has no fixed body_from_optical: use ned_from_optical")
        return self.parent_from_optical

    @property
    def parent_from_optical(self) -> NDArray[np.float64]:
        """(3, 3) rotation from the optical frame to the frame the camera is mounted on; read-only."""
        return _parent_from_optical(self.roll_rad, self.pitch_rad, self.yaw_rad)

    def ned_from_optical(self, ned_from_body: NDArray[np.float64]) -> NDArray[np.float64]:
        """(3, 3) rotation from the optical frame to NED, for the body's (3, 3) attitude.

        Raises ValueError for a camera on a gimbal without `ned_from_gimbal` (see `held`).
        """
        if self.on_gimbal:
            if self.ned_from_gimbal is None:
                raise ValueError("a camera on a gimbal needs the gimbal's attitude: use `held`")
            return self.ned_from_gimbal @ self.parent_from_optical
        if self.stabilized:
            heading_rad = math.atan2(float(ned_from_body[1, 0]), float(ned_from_body[0, 0]))
            ned_from_body = matrix_from_euler(0.0, 0.0, heading_rad)
        return ned_from_body @ self.parent_from_optical


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """Calibration published by a camera: its lens, and its mount (None: unknown)."""

    model: CameraModel
    mount: CameraMount | None = None


@lru_cache(maxsize=16)
def _parent_from_optical(roll_rad: float, pitch_rad: float, yaw_rad: float) -> NDArray[np.float64]:
    """Read-only and cached: needed several times per frame."""
    rotation: NDArray[np.float64] = matrix_from_euler(roll_rad, pitch_rad, yaw_rad) @ BODY_FROM_OPTICAL
    rotation.flags.writeable = False
    return rotation
