"""An image of a point cloud from behind and above, without a window."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.annotate import class_colour
from vision.camera_model import CameraModel
from vision.point_cloud.cloud import PointCloud
from vision.point_cloud.clusters import Cluster

_BACKGROUND, _LIGHT = (34, 30, 28), (235, 235, 235)
_FOV_RAD = math.radians(60.0)
# The image looks down by this much, from where this share of the points is inside.
_DEPRESSION_RAD, _INSIDE_PERCENT = math.radians(32.0), 99.5
_LARGEST_PX = 9
# Of the corners of a box, numbered by bits: pairs that differ in one bit.
_EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]


def draw_cloud(
    cloud: PointCloud,
    down: NDArray[np.float64],
    *,
    clusters: Sequence[Cluster] = (),
    point_m: float = 0.05,
    width: int = 960,
    height: int = 540,
) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 BGR image of the points, seen from behind and above their origin.

    Points without colours are coloured by their height. Nearer points cover farther ones. Boxes are those of
    the clusters, oriented, with the horizontal distance of their centre from the origin.

    Args:
        down: (3,) unit vector of gravity in the cloud's frame.
        point_m: side of a point.
    """
    image = np.full((height, width, 3), _BACKGROUND, np.uint8)
    if not len(cloud):
        return image
    camera = CameraModel.from_horizontal_fov(width, height, _FOV_RAD)
    rotation, eye = _view(cloud.points, down, camera)
    seen = (cloud.points - eye) @ rotation.T
    _splat(image, seen, _colours(cloud, down), camera, point_m)
    for number, cluster in enumerate(clusters):
        corners = camera.project((cluster.corners_m() - eye) @ rotation.T)
        if not np.isfinite(corners).all():
            continue  # partly behind the eye
        pixels = np.rint(corners).astype(int).tolist()
        for first, second in _EDGES:
            cv2.line(image, pixels[first], pixels[second], class_colour(number), 1, cv2.LINE_AA)
        along = cluster.centre_m - (cluster.centre_m @ down) * down
        top = min(pixels, key=lambda pixel: int(pixel[1]))
        text = f"{float(np.linalg.norm(along)):.1f} m"
        cv2.putText(image, text, (top[0], top[1] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _LIGHT, 1, cv2.LINE_AA)
    return image


def _view(
    points: NDArray[np.float32], down: NDArray[np.float64], camera: CameraModel
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(3, 3) rotation to the optical frame of the image, and (3,) the eye's position."""
    middle = np.median(points, axis=0).astype(np.float64)
    ahead = middle - (middle @ down) * down
    if np.linalg.norm(ahead) < 1e-3:  # points straight below
        ahead = np.roll(down, 1) - (np.roll(down, 1) @ down) * down
    ahead /= np.linalg.norm(ahead)
    forward = math.cos(_DEPRESSION_RAD) * ahead + math.sin(_DEPRESSION_RAD) * down
    right = np.cross(down, ahead)
    rotation = np.array([right, np.cross(forward, right), forward])
    along = (points - middle) @ rotation.T
    edge = np.array([camera.cx / camera.fx, camera.cy / camera.fy])
    needed_m = (np.abs(along[:, :2]) / edge).max(axis=1) - along[:, 2]
    return rotation, middle - forward * max(1.0, float(np.percentile(needed_m, _INSIDE_PERCENT)) * 1.03)


def _colours(cloud: PointCloud, down: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(N, 3) uint8 BGR."""
    if cloud.colours is not None:
        return cloud.colours[:, ::-1]
    heights = -(cloud.points @ down)
    low, high = np.percentile(heights, (2, 98))
    share = np.clip((heights - low) / max(float(high - low), 1e-6), 0.0, 1.0)
    mapped: NDArray[np.uint8] = cv2.applyColorMap(np.rint(share * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    return mapped.reshape(-1, 3)


def _splat(
    image: NDArray[np.uint8],
    seen: NDArray[np.float64],
    colours: NDArray[np.uint8],
    camera: CameraModel,
    point_m: float,
) -> None:
    """Draw each point as a square of its size, the farthest first."""
    pixels = camera.project(seen)
    with np.errstate(invalid="ignore", divide="ignore"):
        side = np.clip(np.ceil(point_m * camera.fx / seen[:, 2]), 1, _LARGEST_PX)
    parts = []
    for offset_y in range(_LARGEST_PX):
        for offset_x in range(_LARGEST_PX):
            index = np.flatnonzero((side > max(offset_x, offset_y)) & np.isfinite(pixels[:, 0]))
            half = (side[index] - 1) // 2
            column = np.rint(pixels[index, 0]) - half + offset_x
            row = np.rint(pixels[index, 1]) - half + offset_y
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            parts.append(np.column_stack([index, row, column])[inside].astype(np.int64))
    index, row, column = np.concatenate(parts).T
    order = np.argsort(-seen[index, 2], kind="stable")
    # Of several values for one pixel the last one stays.
    image[row[order], column[order]] = colours[index[order]]
