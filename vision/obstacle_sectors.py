"""Distance of the nearest obstacle in each of 72 directions about the vehicle, from one depth image.

The layout is that of MAVLink's OBSTACLE_DISTANCE (common, 330): sectors of 5°, here level and from north, so
that rotation of the vehicle after the capture does not rotate the obstacles. Only points in a band of heights
about the vehicle count; the ground is below it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.camera_model import MIN_COSINE, CameraModel, CameraMount

SECTORS = 72
SECTOR_RAD = math.tau / SECTORS
# The height band relative to the vehicle, metres above and below.
ABOVE_M, BELOW_M = 0.7, 0.8
# The band ends this far above the ground; a degree of attitude error raises it by 0.2 m, 10 m away.
GROUND_GAP_M = 0.35
# Percentile used as the nearest distance, against single wrong pixels that are too near.
NEAR_PERCENTILE = 5.0
LEAST_POINTS = 5
# With a smaller share of known depth a sector is unknown: a dark lens is not free space.
LEAST_KNOWN_SHARE = 0.1
# Most rows and columns that are sampled.
GRID_ROWS, GRID_COLUMNS = 120, 160


@dataclass(frozen=True, slots=True)
class ObstacleSectors:
    """Obstacle distances from one depth image.

    Attributes:
        captured_ns: CLOCK_MONOTONIC stamp of the image.
        distance_m: 72 horizontal distances from the vehicle, metres. Sector i is centred i · 5° clockwise
            from north. Infinite: observed and free. NaN: not observed, or without depth.
    """

    captured_ns: int
    distance_m: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.distance_m) != SECTORS:
            raise ValueError(f"distance_m must have {SECTORS} values, got {len(self.distance_m)}")


def obstacle_sectors(
    depth_m: NDArray[np.float32],
    captured_ns: int,
    camera: CameraModel,
    mount: CameraMount,
    ned_from_body: NDArray[np.float64],
    height_m: float | None = None,
) -> ObstacleSectors:
    """The nearest obstacle of each sector. Arguments and errors as of `nearest_ranges`."""
    distance = nearest_ranges(depth_m, camera, mount, ned_from_body, height_m, SECTORS)
    return ObstacleSectors(captured_ns, tuple(distance.tolist()))


def nearest_ranges(
    depth_m: NDArray[np.float32],
    camera: CameraModel,
    mount: CameraMount,
    ned_from_body: NDArray[np.float64],
    height_m: float | None,
    sectors: int,
) -> NDArray[np.float64]:
    """(sectors,) horizontal distances from the vehicle, metres, as `ObstacleSectors.distance_m`.

    Args:
        depth_m: (H, W) float32, metres along the optical axis; NaN, infinite or not above zero where unknown.
        camera: model of the depth image's size.
        ned_from_body: (3, 3) float64, the attitude at the capture, body FRD to NED.
        height_m: of the vehicle above the ground, which limits the band; None: unknown, and the vehicle must
            be higher than 0.8 m.
        sectors: equal parts of the circle, the first one centred on north.

    Raises:
        ValueError: the image's size differs from the camera's.
    """
    if depth_m.shape != (camera.height, camera.width):
        raise ValueError(
            f"depth must have the camera's size ({camera.height}, {camera.width}), got {depth_m.shape}"
        )
    rows = slice(None, None, max(1, math.ceil(camera.height / GRID_ROWS)))
    columns = slice(None, None, max(1, math.ceil(camera.width / GRID_COLUMNS)))
    depth = depth_m[rows, columns].ravel().astype(np.float32, copy=False)
    rays, ahead = _rays(camera, rows.step, columns.step)
    if ahead is not None:
        depth = depth[ahead]
    turn = mount.ned_from_optical(ned_from_body).astype(np.float32)
    lens = (ned_from_body @ mount.position_frd_m).astype(np.float32)

    north, east, down = turn @ rays
    sampled_sector = _sector(north, east, sectors)
    known = np.isfinite(depth) & (depth > 0.0)
    counted = np.bincount(sampled_sector, minlength=sectors)
    with_depth = np.bincount(sampled_sector[known], minlength=sectors)
    seen = (counted >= LEAST_POINTS) & (with_depth >= LEAST_KNOWN_SHARE * counted)

    # What is level with the vehicle is never ground, also below the place whose height is 0.
    below_m = BELOW_M if height_m is None else max(0.0, min(BELOW_M, height_m - GROUND_GAP_M))
    with np.errstate(invalid="ignore"):  # an unknown depth is NaN, and in no band
        below = down * depth + lens[2]
    in_band = known & (below > -ABOVE_M) & (below < below_m)
    away = depth[in_band]
    north, east = north[in_band] * away + lens[0], east[in_band] * away + lens[1]
    distance = np.full(sectors, np.nan)
    distance[seen] = np.inf
    _nearest_of_each(_sector(north, east, sectors), np.hypot(north, east), distance)
    return distance


def _nearest_of_each(
    sector: NDArray[np.int64], range_m: NDArray[np.float32], distance: NDArray[np.float64]
) -> None:
    """Write each sector's low percentile where it has enough points."""
    # One integer sort by sector, then by range: the bits of a positive float ascend with its value.
    ordered = np.sort((sector << 32) | range_m.view(np.int32))
    counts = np.bincount(sector, minlength=len(distance))
    firsts = np.concatenate(([0], np.cumsum(counts)[:-1]))
    enough = counts >= LEAST_POINTS
    indices = firsts + (counts * (NEAR_PERCENTILE / 100.0)).astype(np.int64)
    distance[enough] = ordered[indices[enough]].astype(np.int32).view(np.float32)


def _sector(north: NDArray[np.float32], east: NDArray[np.float32], sectors: int) -> NDArray[np.int64]:
    if not north.size:
        return np.zeros(0, np.int64)
    # Accurate to a hundredth of a degree, and many times faster than arctan2.
    scaled = cv2.phase(north, east).ravel() * np.float32(sectors / math.tau)
    sector: NDArray[np.int64] = np.rint(scaled).astype(np.int64)
    # A quarter of the time of a remainder. NaN became negative, and is in no band.
    sector[(sector < 0) | (sector >= sectors)] = 0
    return sector


_Rays = tuple[NDArray[np.float32], NDArray[np.intp] | None]
_cached: dict[tuple[CameraModel, int, int], _Rays] = {}


def _rays(camera: CameraModel, row_step: int, column_step: int) -> _Rays:
    """(3, N) float32 rays with z = 1 of the sampled pixels, and which these are, cached for one camera.

    None: all of them. A fisheye has pixels without a ray, and rays across its axis, along which there is no
    depth.
    """
    key = (camera, row_step, column_step)
    if key not in _cached:
        across, down = np.meshgrid(
            np.arange(0, camera.width, column_step), np.arange(0, camera.height, row_step)
        )
        rays = camera.rays(np.column_stack([across.ravel(), down.ravel()]))
        _cached.clear()
        ahead = np.flatnonzero(rays[:, 2] > MIN_COSINE)
        rays = rays[ahead]
        plane = np.ascontiguousarray((rays / rays[:, 2:]).T, np.float32)
        _cached[key] = (plane, ahead if len(ahead) < across.size else None)
    return _cached[key]
