"""The corners of a marker, as intersections of lines through the edges of its black square.

The lines average over the pixels of a side: on rendered images of at least 40 px a side the corners are 0.03
px off, one sigma, OpenCV's own 0.17 px, or several pixels where it takes an edge of the sheet around the
marker for the marker's.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.camera_model import CameraModel

# Noise of a corner along each image axis, one sigma, from which covariances follow. That of rendered images
# is smaller; a real lens is rarely calibrated better. That of lines whose fit does not settle: 0.27 px RMS on
# six rendered markers with blur and noise. That of OpenCV's corners, where lines do not fit.
CORNER_SIGMA_PX, UNSETTLED_SIGMA_PX, RAW_SIGMA_PX = 0.1, 0.5, 1.0
# Corner refinement: samples per side and the part of it they cover, so that the other sides do not disturb;
# half the length of a sample's profile across the side, as a share of it and in pixels; the farthest that a
# corner moves, the same way; the most passes, and the movement of a corner at which they end.
_SIDE_SAMPLES, _SIDE_PART = 24, (0.07, 0.93)
_PROFILE_SHARE, _PROFILE_PX, _FARTHEST_SHARE, _FARTHEST_PX = 0.06, (1.0, 4.0), 0.08, 1.5
_MOST_PASSES, _SETTLED_PX = 10, 0.02
# Edge points lie this near their line, RMS; on rendered images 0.12 px, beside an edge that is partly hidden
# over 1 px.
_SCATTER_PX = 0.5
# Before it, the black square is searched on profiles that begin and end at these modules from OpenCV's sides.
_SEARCHED_MODULES, _SEARCH_STEPS, _ROBUST_STEPS, _NEAR_PX = (-1.3, 0.7), 41, 6, 0.2
_INSIDE_PX = 32
_INSIDE_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) * _INSIDE_PX


def corners_on_edges(
    grey: NDArray[Any], corners_px: NDArray[Any], modules: int, camera: CameraModel
) -> tuple[NDArray[np.float64], float]:
    """(4, 2) intersections of lines through the edges of the black square, and their noise, pixels.

    The last fit if it does not settle; OpenCV's corners if lines do not fit.

    Args:
        corners_px: as OpenCV finds them. modules: of the marker's side, with its black border.
    """
    corners = np.asarray(corners_px, np.float64).reshape(4, 2)
    side_px = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
    start = _inner_square(grey, corners, modules, camera)
    start = found = start if np.isfinite(start).all() else corners
    reach_px = np.clip(_PROFILE_SHARE * _across_px(start), *_PROFILE_PX)
    for _ in range(_MOST_PASSES):
        before, found = found, _lines_met(grey, found, reach_px, camera)
        # NaN fails the comparison.
        if not np.abs(found - start).max() < max(_FARTHEST_PX, _FARTHEST_SHARE * side_px):
            return corners, RAW_SIGMA_PX
        if np.abs(found - before).max() < _SETTLED_PX:
            return found, CORNER_SIGMA_PX
    return found, UNSETTLED_SIGMA_PX


def _inner_square(
    grey: NDArray[Any], corners: NDArray[np.float64], modules: int, camera: CameraModel
) -> NDArray[np.float64]:
    """(4, 2) corners of the black square, to a pixel; NaN where its edges are not found.

    Where the background is brighter than the white margin around the marker (a sheet in shade), OpenCV may
    give the margin's outer edge on some sides, up to a module off. On each profile from inside the black
    border outwards, the first rise to the marker's own white is its edge.
    """
    across_px = _across_px(corners) / modules
    steps = np.linspace(*_SEARCHED_MODULES, _SEARCH_STEPS)
    bases, outward, profiles = _profiles(grey, corners, across_px[:, None] * steps)
    inside = cv2.warpPerspective(
        grey,
        cv2.getPerspectiveTransform(corners.astype(np.float32), _INSIDE_CORNERS),
        (_INSIDE_PX, _INSIDE_PX),
    )
    level = cv2.threshold(inside, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[0]
    rises = (profiles[:, :, :-1] < level) & (profiles[:, :, 1:] >= level)
    known, first = rises.any(axis=2), rises.argmax(axis=2)
    if (known.mean(axis=1) < 0.5).any():
        return np.full((4, 2), np.nan)
    place = across_px[:, None] * (steps[first] + steps[first + 1]) / 2.0
    return _intersections(
        bases + outward * place[..., None], np.asarray(known, np.float64), camera, _ROBUST_STEPS
    )


def _across_px(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4,) extent of a quadrilateral across each side: foreshortened, it is less than the adjacent sides."""
    lengths = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return np.asarray(cv2.contourArea(corners.astype(np.float32)) / np.maximum(lengths, 1e-9), np.float64)


def _lines_met(
    grey: NDArray[Any], corners: NDArray[np.float64], reach_px: NDArray[np.float64], camera: CameraModel
) -> NDArray[np.float64]:
    """(4, 2) intersections of the lines through the edges; NaN where there are none.

    On each side the edge is located on profiles across it, at the centroid of the increase from black to
    white.
    """
    steps = np.linspace(-1.0, 1.0, 2 * math.ceil(2.0 * reach_px.max()) + 1)
    bases, outward, profiles = _profiles(grey, corners, reach_px[:, None] * steps)
    rise = np.maximum(np.diff(profiles, axis=2), 0.0)
    weight = rise.sum(axis=2)
    place = reach_px[:, None] * (rise @ ((steps[:-1] + steps[1:]) / 2)) / np.maximum(weight, 1e-9)
    return _intersections(bases + outward * place[..., None], weight, camera)


def _profiles(
    grey: NDArray[Any], corners: NDArray[np.float64], offsets: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Profiles across the sides: (4, S, 2) points on the sides, (4, 1, 2) outward, (4, S, M) brightness.

    Args:
        offsets: (4, M) pixels outwards, for each side.
    """
    along = np.roll(corners, -1, axis=0) - corners
    outward = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1, keepdims=True)
    bases = corners[:, None] + along[:, None] * np.linspace(*_SIDE_PART, _SIDE_SAMPLES)[:, None]
    samples = bases[:, :, None] + outward[:, None, None] * offsets[:, None, :, None]
    maps = samples.reshape(4 * _SIDE_SAMPLES, -1, 2).astype(np.float32)
    profiles = cv2.remap(grey, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return bases, outward[:, None], profiles.reshape(samples.shape[:3]).astype(np.float64)


def _intersections(
    points_px: NDArray[np.float64], weight: NDArray[np.float64], camera: CameraModel, robust_steps: int = 0
) -> NDArray[np.float64]:
    """(4, 2) intersections of lines through (4, S, 2) weighted points of the sides; NaN where none are.

    Lines are fitted without the lens's distortion, which bends them.

    Args:
        robust_steps: of a fit to the absolute distances rather than to their squares.
    """
    rays = camera.rays(points_px.reshape(-1, 2))
    points = (rays[:, :2] / rays[:, 2:]).reshape(4, -1, 2)  # at unit depth
    if not np.isfinite(points).all():  # beyond the lens's rays
        return np.full((4, 2), np.nan)
    given = weight
    for _ in range(robust_steps + 1):
        share = (weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9))[..., None]
        centres = (points * share).sum(axis=1, keepdims=True)
        apart = points - centres
        spread = (apart * share).swapaxes(1, 2) @ apart
        # The axis of the smaller spread.
        angle = np.arctan2(2.0 * spread[:, 0, 1], spread[:, 0, 0] - spread[:, 1, 1]) / 2.0
        normals = np.column_stack([-np.sin(angle), np.cos(angle)])
        off = np.abs(apart @ normals[..., None])[..., 0]
        weight = given / np.maximum(off * camera.fx, _NEAR_PX)
    lines = np.column_stack([normals, -(normals * centres[:, 0]).sum(axis=1)])
    met = np.cross(np.roll(lines, 1, axis=0), lines)
    scatter = np.sqrt((share[..., 0] * np.square(off)).sum(axis=1)).max() * camera.fx
    if np.abs(met[:, 2]).min() < 1e-9 or (scatter > _SCATTER_PX and not robust_steps):
        return np.full((4, 2), np.nan)
    return camera.project(np.column_stack([met[:, :2] / met[:, 2:], np.ones(4)]))
