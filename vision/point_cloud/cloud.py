"""Points in space with their frame, and how a depth image becomes them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.camera_model import MIN_COSINE, CameraModel, CameraMount

CloudFrame = Literal["camera", "body", "ned"]
FRAMES: tuple[CloudFrame, ...] = ("camera", "body", "ned")
_PACKED = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3), ("a", "u1")])
# Of a square of pixels that is averaged: those of one surface, and the least share of them.
_SAME_SURFACE, _LEAST_SHARE = 0.1, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points of one moment.

    Attributes:
        points: (N, 3) float32 metres, all finite.
        colours: (N, 3) uint8, RGB; None: without colour.
        frame: axes and origin: `camera` is optical (right, down, forward) from the lens, `body` is FRD and
            `ned` is north, east, down, both from the vehicle.
        stamp_ns: CLOCK_MONOTONIC nanoseconds of the capture; 0: unknown.
    """

    points: NDArray[np.float32]
    colours: NDArray[np.uint8] | None = None
    frame: CloudFrame = "camera"
    stamp_ns: int = 0

    def __post_init__(self) -> None:
        points, colours = self.points, self.colours
        if points.ndim != 2 or points.shape[1] != 3 or points.dtype != np.float32:
            raise ValueError(f"points must be (N, 3) float32, got {points.shape} {points.dtype}")
        if not np.isfinite(points).all():
            raise ValueError("points must be finite: remove those with NaN or infinity first")
        if colours is not None and (colours.shape != points.shape or colours.dtype != np.uint8):
            raise ValueError(f"colours must be {points.shape} uint8, got {colours.shape} {colours.dtype}")
        if self.frame not in FRAMES:
            raise ValueError(f"frame must be one of {', '.join(FRAMES)}, got {self.frame!r}")

    def __len__(self) -> int:
        return len(self.points)

    def select(self, chosen: NDArray[Any]) -> PointCloud:
        """The points of a (N,) mask or of (M,) indices."""
        colours = None if self.colours is None else self.colours[chosen]
        return replace(self, points=self.points[chosen], colours=colours)

    def transformed(
        self,
        rotation: NDArray[np.float64],
        translation_m: NDArray[np.float64],
        frame: CloudFrame | None = None,
    ) -> PointCloud:
        """The points `rotation @ p + translation_m`, which are in `frame` (None: the same)."""
        moved = self.points @ np.asarray(rotation).T.astype(np.float32) + np.asarray(
            translation_m, np.float32
        )
        return replace(self, points=moved, frame=frame or self.frame)

    def in_body(self, mount: CameraMount) -> PointCloud:
        """A cloud of the camera in the body's frame. Raises ValueError for another frame, or on a gimbal."""
        self._require("camera")
        return self.transformed(mount.body_from_optical, mount.position_frd_m, "body")

    def in_ned(self, ned_from_body: NDArray[np.float64]) -> PointCloud:
        """A cloud of the body in NED, for its (3, 3) attitude. Raises ValueError for another frame."""
        self._require("body")
        return self.transformed(ned_from_body, np.zeros(3), "ned")

    def packed(self) -> bytes:
        """16 bytes for each point: x, y, z as little-endian float32, then red, green, blue, 255."""
        values = np.full(len(self), 255, _PACKED)
        values["xyz"] = self.points
        if self.colours is not None:
            values["rgb"] = self.colours
        return values.tobytes()

    def _require(self, frame: CloudFrame) -> None:
        if self.frame != frame:
            raise ValueError(f"expected points in the frame {frame!r}, got {self.frame!r}")


def cloud_from_depth(
    depth_m: NDArray[np.float32],
    camera: CameraModel,
    *,
    image: NDArray[np.uint8] | None = None,
    frame: CloudFrame = "camera",
    mount: CameraMount | None = None,
    ned_from_body: NDArray[np.float64] | None = None,
    range_m: tuple[float, float] = (0.0, np.inf),
    average: int = 1,
    stamp_ns: int = 0,
) -> PointCloud:
    """The points of a depth image, without the pixels of unknown depth.

    Args:
        depth_m: (H, W) float32, metres along the optical axis; NaN, infinite or not above zero where unknown.
        camera: model of the depth image's size; its distortion is removed.
        image: (H, W, 3) uint8 BGR, the points' colours.
        frame: of the points. mount: needed for `body` and `ned`.
        ned_from_body: (3, 3) attitude at the capture, for `ned`.
        range_m: depths below the first and above the second count as unknown.
        average: make one point of n x n pixels: the mean of their inverse depth, in which a stereo camera's
            noise is uniform. Pixels more than a tenth from the mean are left out, and squares with fewer than
            half of their pixels left.

    Raises:
        ValueError: sizes differ, `average` is not 1 to the image's size, or `frame` needs a mount or an
            attitude that is missing.
    """
    size = (camera.height, camera.width)
    if depth_m.shape != size:
        raise ValueError(f"depth must have the camera's size {size}, got {depth_m.shape}")
    if image is not None and image.shape != (*size, 3):
        raise ValueError(f"the image must have the camera's size {(*size, 3)}, got {image.shape}")
    rotation, translation = _pose(frame, mount, ned_from_body)
    if not 1 <= average <= min(size):
        raise ValueError(f"average must be 1 to {min(size)} pixels, got {average}")
    if average > 1:
        depth_m, image, camera = _averaged(depth_m, image, camera, average)
    depth = depth_m.ravel()
    with np.errstate(invalid="ignore"):
        known = (depth > max(range_m[0], 0.0)) & (depth <= range_m[1]) & (depth < np.inf)
    rays = _rays(camera)
    pixels = np.flatnonzero(known & np.isfinite(rays[0]))
    along = depth[pixels]
    optical = [ray[pixels] * along for ray in rays]
    points = np.empty((len(pixels), 3), np.float32)
    for axis, row in enumerate(rotation.astype(np.float32)):
        points[:, axis] = row[0] * optical[0] + row[1] * optical[1] + row[2] * optical[2]
    points += translation.astype(np.float32)
    colours = None
    if image is not None:
        bgr = image.reshape(-1, 3)[pixels]
        colours = np.ascontiguousarray(bgr[:, ::-1])
    return PointCloud(points, colours, frame, stamp_ns)


def _pose(
    frame: CloudFrame, mount: CameraMount | None, ned_from_body: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation and translation from the optical frame to `frame`."""
    if frame == "camera":
        return np.eye(3), np.zeros(3)
    if mount is None:
        raise ValueError(f"points in the frame {frame!r} need the camera's mount")
    if frame == "body":
        return mount.body_from_optical, mount.position_frd_m
    if ned_from_body is None:
        raise ValueError("points in the frame 'ned' need the vehicle's attitude")
    return mount.ned_from_optical(ned_from_body), ned_from_body @ mount.position_frd_m


def _averaged(
    depth_m: NDArray[np.float32], image: NDArray[np.uint8] | None, camera: CameraModel, side: int
) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None, CameraModel]:
    """Depth, image and camera, `side` times smaller; a rest at the right and lower edge is cut off."""
    columns, rows = camera.width // side, camera.height // side
    depth_m = depth_m[: rows * side, : columns * side]
    with np.errstate(invalid="ignore"):
        known = ((depth_m > 0.0) & (depth_m < np.inf)).astype(np.float32)
    inverse = np.zeros(depth_m.shape, np.float32)
    np.divide(1.0, depth_m, out=inverse, where=known > 0.0)

    def mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA).astype(
            np.float32, copy=False
        )

    with np.errstate(invalid="ignore", divide="ignore"):
        middle = mean(inverse) / mean(known)
        middle = np.repeat(np.repeat(middle, side, axis=0), side, axis=1)
        known *= np.abs(inverse - middle) <= _SAME_SURFACE * middle
        inverse *= known
        share = mean(known)
        smaller_m = np.where(share >= _LEAST_SHARE, share / mean(inverse), np.float32(np.nan))
    if image is not None:
        cropped = image[: rows * side, : columns * side]
        image = cv2.resize(cropped, (columns, rows), interpolation=cv2.INTER_AREA).astype(
            np.uint8, copy=False
        )
    cropped_camera = replace(camera, width=columns * side, height=rows * side)
    return smaller_m, image, cropped_camera.scaled(columns, rows)


@lru_cache(maxsize=2)
def _rays(camera: CameraModel) -> NDArray[np.float32]:
    """(3, N) float32 rays of the pixels with z = 1; read-only. NaN across a fisheye's axis and beyond."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    unit = camera.rays(np.column_stack([columns.ravel(), rows.ravel()]))
    unit[~(unit[:, 2] > MIN_COSINE)] = np.nan
    rays = np.ascontiguousarray((unit / unit[:, 2:]).T, np.float32)
    rays.flags.writeable = False
    return rays
