"""Levels images by the attitude at their capture: the horizon is horizontal.

An image is only rotated about the optical centre, so distances do not matter. The direction of the optical
axis is kept. A fixed camera that looks steeply down, where no horizon is, is levelled as if the vehicle were
level; one on a gimbal stays as it is. With a rolling shutter every row has its own rotation (Forssén and
Ringaby 2010, "Rectifying rolling shutter video").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.camera_model import EQUIDISTANT, CameraModel, CameraMount
from vision.frame import Frame
from vision.rotation import BODY_FROM_OPTICAL, matrix_from_euler

Rotation = NDArray[np.float64]
# Levels the image of a frame, drawn on or not; None: the attitude at its capture is not known.
Levelling = Callable[[Frame, NDArray[np.uint8]], NDArray[np.uint8] | None]
# Mount and (3, 3) `ned_from_body` at a stamp (CLOCK_MONOTONIC ns); None: not known.
PoseAt = Callable[[int], tuple[CameraMount, Rotation] | None]

# The map is computed at every 8th pixel and interpolated: exact to 0.02 px at 80° across.
STEP_PX = 8
# Attitudes that are used for one readout, interpolated between.
READOUT_POSES = 9
# From this angle of the axis to the horizon on, a camera looks steeply up or down.
STEEP_RAD = math.radians(60.0)
# A pixel depends on the rotation of the row that it is read from.
_ROW_STEPS = 3
_OUTSIDE_PX = -1e6


def level_camera(camera: CameraModel) -> CameraModel:
    """The lens of the levelled image: without distortion, apart from a fisheye, which stays one."""
    if camera.distortion_model == EQUIDISTANT:
        return camera
    return replace(camera, distortion=(), distortion_model="plumb_bob")


def poses_of_readout(
    pose_at: PoseAt, captured_ns: int, readout_s: float
) -> list[tuple[CameraMount, Rotation]] | None:
    """The poses at equal intervals from the first row to the last one; one without a rolling shutter.

    Args:
        captured_ns: the stamp of the image, at the middle of its readout.
        readout_s: from the exposure of the first row to that of the last; 0: global shutter.

    Returns:
        None if one is not known.
    """
    shares = np.linspace(-0.5, 0.5, READOUT_POSES) if readout_s > 0.0 else (0.0,)
    poses = [pose_at(captured_ns + round(share * readout_s * 1e9)) for share in shares]
    return None if None in poses else [pose for pose in poses if pose is not None]


def level_rotations(poses: Sequence[tuple[CameraMount, Rotation]]) -> NDArray[np.float64]:
    """(N, 3, 3) rotations from the optical frame of each pose to that of the levelled image.

    Args:
        poses: as of `poses_of_readout`; the levelled image has the direction of the middle one.

    Raises:
        ValueError: a camera is on a gimbal and the gimbal's attitude is missing.
    """
    mount, ned_from_body = poses[len(poses) // 2]
    ned_from_optical = mount.ned_from_optical(ned_from_body)
    north, east, down = ned_from_optical[:, 2].tolist()
    # Of a fixed camera by its mount, so that it does not change in flight.
    if abs(down if mount.on_gimbal else float(mount.parent_from_optical[2, 2])) < math.sin(STEEP_RAD):
        elevation_rad = math.atan2(-down, math.hypot(north, east))
        ned_from_level = matrix_from_euler(0.0, elevation_rad, math.atan2(east, north)) @ BODY_FROM_OPTICAL
    elif mount.on_gimbal:
        ned_from_level = ned_from_optical
    else:
        ned_from_level = replace(mount, stabilized=True).ned_from_optical(ned_from_body)
    level_from_ned = ned_from_level.T
    return np.array([level_from_ned @ mount.ned_from_optical(attitude) for mount, attitude in poses])


def level_image(
    image: NDArray[np.uint8],
    camera: CameraModel,
    level_from_optical: NDArray[np.float64],
    rotate_deg: int = 0,
) -> NDArray[np.uint8]:
    """The image of the levelled camera, of the same size; black where the camera saw nothing.

    Args:
        image: (height, width) or (height, width, 3).
        camera: the lens of the image, with its size.
        level_from_optical: (3, 3); or (N, 3, 3) at equal intervals from the first row that was read to the
            last one, see `level_rotations`.
        rotate_deg: clockwise, by which the image was rotated after the readout (`source.rotate_deg`).

    Returns:
        With the lens `level_camera(camera)`.

    Raises:
        ValueError: the image has another size.
    """
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise ValueError(f"the lens is of {camera.width}x{camera.height}, the image has {width}x{height}")
    rays, lowest_z = _level_rays(camera)
    rotations = level_from_optical.reshape(-1, 3, 3)
    pixels = _project(camera, rays, rotations[len(rotations) // 2], lowest_z)
    if len(rotations) > 1:
        for _ in range(_ROW_STEPS):
            at = _share_read(camera, pixels, rotate_deg) * (len(rotations) - 1)
            before = np.minimum(at.astype(np.intp), len(rotations) - 2)
            share = (at - before)[:, None, None]
            mixed = (1.0 - share) * rotations[before] + share * rotations[before + 1]
            pixels = _project(camera, rays, mixed, lowest_z)
    columns, rows = _grid(camera)
    grid = np.nan_to_num(pixels, nan=_OUTSIDE_PX).reshape(len(rows), len(columns), 2).astype(np.float32)
    # At multiples of 1/8 the interpolation of `remap` is exact.
    across, down = np.meshgrid(
        np.arange(width, dtype=np.float32) / STEP_PX, np.arange(height, dtype=np.float32) / STEP_PX
    )
    map_x, map_y = (cv2.remap(plane, across, down, cv2.INTER_LINEAR) for plane in cv2.split(grid))
    levelled = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(levelled, np.uint8)


def _grid(camera: CameraModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Columns and rows of the points at which the map is computed."""
    return (
        np.arange(0.0, camera.width + STEP_PX, STEP_PX),
        np.arange(0.0, camera.height + STEP_PX, STEP_PX),
    )


@lru_cache(maxsize=4)
def _level_rays(camera: CameraModel) -> tuple[NDArray[np.float64], float]:
    """(N, 3) rays of the levelled image's grid, and the least z of a ray that the camera sees."""
    columns, rows = np.meshgrid(*_grid(camera))
    rays = level_camera(camera).rays(np.column_stack([columns.ravel(), rows.ravel()]))
    right, bottom = camera.width - 1.0, camera.height - 1.0
    corners = camera.rays(np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]]))
    rays.flags.writeable = False
    return rays, float(np.nanmin(corners[:, 2])) if np.isfinite(corners).all() else -1.0


def _project(
    camera: CameraModel, rays: NDArray[np.float64], level_from_optical: NDArray[np.float64], lowest_z: float
) -> NDArray[np.float64]:
    """(N, 2) pixels of rays of the levelled image; NaN beyond the corners, where a lens model may fold."""
    if level_from_optical.ndim == 2:
        seen = rays @ level_from_optical
    else:
        seen = np.einsum("ni,nij->nj", rays, level_from_optical)
    pixels = camera.project(seen)
    pixels[seen[:, 2] < lowest_z - 0.02] = np.nan
    return pixels


def _share_read(camera: CameraModel, pixels: NDArray[np.float64], rotate_deg: int) -> NDArray[np.float64]:
    """(N,) when a pixel was read: 0 with the first row, 1 with the last; a half where it is none."""
    if rotate_deg in (90, 270):
        share = pixels[:, 0] / (camera.width - 1)
    else:
        share = pixels[:, 1] / (camera.height - 1)
    if rotate_deg in (90, 180):  # the first row is now the right column, or the last row
        share = 1.0 - share
    return np.clip(np.nan_to_num(share, nan=0.5), 0.0, 1.0)
