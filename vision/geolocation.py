"""From a pixel to a direction to a place on the ground, in the world's NED frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.camera_model import CameraModel, CameraMount


def direction_ned(
    camera: CameraModel,
    mount: CameraMount,
    ned_from_body: NDArray[np.float64],
    pixels: NDArray[Any],
) -> NDArray[np.float64]:
    """(N, 2) pixels → (N, 3) unit directions in NED, given the vehicle's attitude when they were captured."""
    directions: NDArray[np.float64] = camera.rays(pixels) @ mount.ned_from_optical(ned_from_body).T
    return directions


def point_at_depth(
    camera: CameraModel,
    mount: CameraMount,
    ned_from_body: NDArray[np.float64],
    pixels: NDArray[Any],
    depth_m: NDArray[Any],
) -> NDArray[np.float64]:
    """(N, 3) NED offsets from the vehicle of points seen at `pixels` with a depth along the optical axis."""
    rays = camera.rays(pixels)
    points = rays / rays[:, 2:] * np.asarray(depth_m, np.float64).reshape(-1, 1)
    offsets: NDArray[np.float64] = (
        points @ mount.ned_from_optical(ned_from_body).T + ned_from_body @ mount.position_frd_m
    )
    return offsets


def point_on_ground(
    camera: CameraModel,
    mount: CameraMount,
    ned_from_body: NDArray[np.float64],
    pixels: NDArray[Any],
    height_m: float,
    min_depression_rad: float = 0.02,
) -> NDArray[np.float64]:
    """(N, 3) NED offsets from the vehicle of where the pixels' rays meet level ground.

    Args:
        height_m: of the vehicle above that ground.
        min_depression_rad: rays that point down by less than this give NaN: near the horizon a small error of
            attitude is a large error of range.
    """
    directions = direction_ned(camera, mount, ned_from_body, pixels)
    camera_offset = ned_from_body @ mount.position_frd_m
    drop = height_m - camera_offset[2]
    points = np.full((len(directions), 3), np.nan)
    down = directions[:, 2] > np.sin(min_depression_rad)
    if drop > 0.0:
        points[down] = camera_offset + directions[down] / directions[down, 2:] * drop
    return points


def foot_of_upright(
    camera: CameraModel,
    mount: CameraMount,
    ned_from_body: NDArray[np.float64],
    top_and_foot: NDArray[Any],
    height_m: float,
    min_spread: float = 0.005,
) -> NDArray[np.float64]:
    """(3,) NED offset from the vehicle of the foot of something upright that is `height_m` tall.

    Its top and its foot are in one direction and as far away: that distance is the height, divided by the
    difference of the tangents of their elevations. What is as deep as it is tall seems taller from above, and
    so nearer.

    Args:
        top_and_foot: (2, 2) pixels.
        min_spread: the difference of the tangents below which the answer is NaN: it is too small to measure.
    """
    directions = direction_ned(camera, mount, ned_from_body, top_and_foot)
    level = np.hypot(directions[:, 0], directions[:, 1])
    # Nearly straight above something its height is not seen.
    if level.min() < 0.1:
        return np.full(3, np.nan)
    tangents = -directions[:, 2] / level
    spread = tangents[0] - tangents[1]
    if not spread > min_spread:
        return np.full(3, np.nan)
    foot: NDArray[np.float64] = ned_from_body @ mount.position_frd_m + directions[1] / level[1] * (
        height_m / spread
    )
    return foot
