"""Depth images: their summary, and the nearest surface point of a detected object in its box.

The point is in the optical frame, so that the attitude at the capture can rotate it into NED.
"Nearest" is horizontal: of a car seen from above, the bumper and not the roof. Noise makes some part of a
surface seem nearest, so the point is where the surface begins without the noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.camera_model import MIN_COSINE, CameraModel
from vision.tracking.association import overlaps

# With a smaller share of pixels with known depth, these may belong to something else.
MIN_KNOWN_FRACTION = 0.1
# A larger box is subsampled, and averaged into at most this many cells in each direction.
_MAX_PIXELS, _MAX_CELLS = 96, 24
# Cells average enough pixels to reduce their noise to this, but a box keeps this many in each direction.
_CELL_SIGMA_M, _MIN_CELLS = 0.15, 8
# Points lower than this above the ground count as ground: boxes are a few pixels too large. So do cells lower
# than so many sigma of their own noise: one of a steep view that stayed would be the nearest of its box.
GROUND_GAP_M, _GROUND_SIGMAS = 0.12, 3.0
# The ground is measured in a strip below the box, this share of its height.
_STRIP, _STRIP_MIN_PX = 0.15, 3
# This share of the remaining cells may be wrong. Less than a tenth of them, nearer than the others by half a
# metre, is another object in front of this one.
_NEAR_FRACTION, _OTHER_FRACTION, _OTHER_GAP_M = 0.01, 0.1, 0.5
# The front of an object: its nearest cells, to so many sigma of their noise behind the nearest one. It holds
# all cells of an upright surface.
_FRONT_SIGMAS = 5.0
# A surface begins before its first cell, because a cell is a mean and the wrong ones are left out: by the
# range that this share of the cells spans, at most so many metres and this share of the range.
_SPAN_FRACTION, _SPAN_MAX_M, _SPAN_MAX_SHARE = 0.05, 0.2, 0.1
# The ends of an object: the nearer cells, by this quantile, of this share of its box on each side. What is
# farther behind the nearest cell than so many widths is background.
_END_SHARE, _END_QUANTILE, _END_WIDTHS = 0.2, 0.2, 2.0
# The noise is measured by the smaller differences of neighbours, this share of them, the others may be edges;
# and the root mean square of that share of normal differences, in sigma.
_SMOOTH_SHARE, _SMOOTH_RMS, _SMOOTH_MIN = 0.8, 0.6616, 8

# A box may hide the object of another one if their IoU is less: NMS leaves several boxes of one object, up to
# an IoU of 0.7. What remains visible of the object needs this share of its box.
_HIDING_IOU, _VISIBLE_SHARE = 0.3, 0.25

# The depth at the centre is the median of a square: its side as a share of the image's shorter one, and its
# least pixels.
_CENTRE, _CENTRE_MIN_PX = 0.02, 5
# What rounds to 65,536 mm does not fit into 16 bits.
_END_M = 65.5355

_Edges = tuple[int, int, int, int]  # left, top, right, bottom

# The numbers above were tuned on 450 rendered frames with a stereo camera's noise, rendered as in
# benchmarks/range_error.py but with other seeds than those of the published figures.


@dataclass(frozen=True, slots=True)
class DepthSummary:
    """A depth image in two numbers.

    Attributes:
        centre_m: along the optical axis at the image's centre, metres; NaN: unknown.
        valid_share: pixels with known depth, 0..1.
    """

    centre_m: float
    valid_share: float


def depth_summary(depth_m: NDArray[np.float32]) -> DepthSummary:
    """Summarize a depth image (height, width), float32 metres, NaN, infinite or not above zero if unknown."""
    known = np.count_nonzero((depth_m > 0.0) & (depth_m < np.inf))
    return DepthSummary(centre_depth(depth_m), known / depth_m.size)


def depth_millimetres(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Depth (height, width) as little-endian integers, as depth cameras deliver it and ROS has it (REP 118).

    0: unknown, or nearer than half a millimetre or farther than 65.535 m. `to_metres` of
    `vision.sources.depth_images` is the inverse: exact for depth that came in whole millimetres.
    """
    with np.errstate(invalid="ignore"):
        known = (depth_m > 0.0) & (depth_m < _END_M)
    return np.rint(np.where(known, depth_m, np.float32(0.0)) * np.float32(1000.0)).astype("<u2")


def centre_depth(depth_m: NDArray[np.float32]) -> float:
    """Median of the known depth at the image's centre, metres; NaN if most of it is unknown."""
    height, width = depth_m.shape
    side = max(_CENTRE_MIN_PX, round(_CENTRE * min(height, width)))
    top, left = max((height - side) // 2, 0), max((width - side) // 2, 0)
    square = depth_m[top : top + side, left : left + side]
    known = square[(square > 0.0) & (square < np.inf)]
    return float(np.median(known)) if 2 * known.size > square.size else math.nan


def nearest_points(
    depth_m: NDArray[np.float32],
    xyxy: NDArray[Any],
    camera: CameraModel,
    down: NDArray[np.float64],
    lens_height_m: float | None = None,
) -> NDArray[np.float32]:
    """The points of `surfaces`."""
    return surfaces(depth_m, xyxy, camera, down, lens_height_m)[0]


def surfaces(
    depth_m: NDArray[np.float32],
    xyxy: NDArray[Any],
    camera: CameraModel,
    down: NDArray[np.float64],
    lens_height_m: float | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The point of each object's visible surface that is horizontally nearest to the camera, and its middle.

    The box is averaged into cells of inverse depth, in which a stereo camera's noise is uniform. Ground and
    sky are excluded, and the remaining cells are sorted by horizontal range. The range of the nearest ones is
    their mean, less as much of their distance from the surface's beginning as their noise does not explain.

    Where boxes overlap, a point of the object in front, whose box ends lower in the image, is not one of the
    object behind: that one is measured where it is not hidden. A box that may be a second one of the same
    object, with an IoU from 0.3 or over the other box's centre, hides nothing. If less than a quarter of the
    box has known depth and is not hidden, the nearer point counts.

    Args:
        depth_m: (height, width) float32, metres along the optical axis; NaN, infinite or not above zero where
            unknown.
        xyxy: (N, 4) edges of the boxes in that image's pixels: left, top, right, bottom.
        camera: model of the depth image's size.
        down: (3,) unit vector of gravity in the optical frame, `ned_from_optical[2]`.
        lens_height_m: above the ground, for boxes cut off by the image's lower edge; for others the ground is
            measured below the box. None: unknown.

    Returns:
        (N, 3) float32 metres, optical frame (right, down, forward), and (N,) float32, the column of the
        middle between the object's ends: the nearer end looks larger, so it is not the box's centre. NaN
        where too little of the box has known depth.
    """
    boxes = np.asarray(xyxy, np.float64).reshape(-1, 4)
    found = np.empty((len(boxes), 4))
    for index, box in enumerate(boxes.tolist()):
        found[index] = _surface(depth_m, box, camera, down, lens_height_m)
    for index, hiding in _hidden(found[:, :3], boxes, camera):
        visible_m = depth_m.copy()
        for left, top, right, bottom in boxes[hiding].tolist():
            columns, rows = _pixels(left, right, camera.width), _pixels(top, bottom, camera.height)
            visible_m[slice(*rows), slice(*columns)] = np.nan
        left, top, right, bottom = boxes[index].tolist()
        columns, rows = _pixels(left, right, camera.width), _pixels(top, bottom, camera.height)
        visible = visible_m[slice(*rows), slice(*columns)]
        if np.count_nonzero((visible > 0.0) & (visible < np.inf)) < _VISIBLE_SHARE * visible.size:
            continue
        behind = _surface(visible_m, boxes[index].tolist(), camera, down, lens_height_m)
        if not np.isnan(behind).any():
            found[index] = behind
    points = found.astype(np.float32)
    return points[:, :3], points[:, 3]


def _hidden(
    points: NDArray[np.float64], boxes: NDArray[np.float64], camera: CameraModel
) -> Iterator[tuple[int, NDArray[np.bool_]]]:
    """Indices of objects whose point lies in the box of one in front; with each, (N,) the boxes in front."""
    if len(boxes) < 2:
        return
    centres = ((boxes[:, :2] + boxes[:, 2:]) / 2.0)[:, None]
    over_centre = ((centres > boxes[:, :2]) & (centres < boxes[:, 2:])).all(axis=2)
    same = over_centre | (overlaps(boxes, boxes) >= _HIDING_IOU)
    pixels = camera.project(points) + 0.5  # to edges
    inside = (pixels[:, None] >= boxes[:, :2]).all(axis=2) & (pixels[:, None] <= boxes[:, 2:]).all(axis=2)
    in_front = (boxes[:, 3] > boxes[:, 3, None]) & ~same
    for index in np.flatnonzero((inside & in_front).any(axis=1)).tolist():
        yield index, in_front[index]


def _surface(
    depth_m: NDArray[np.float32],
    box: list[float],
    camera: CameraModel,
    down: NDArray[np.float64],
    lens_height_m: float | None,
) -> NDArray[np.float64]:
    """(4,) the nearest point, and the column of the middle."""
    nothing = np.full(4, np.nan)
    if not all(map(math.isfinite, box)):
        return nothing
    height, width = depth_m.shape
    left, right = _pixels(box[0], box[2], width)
    top, bottom = _pixels(box[1], box[3], height)
    edges = (left, top, right, bottom)
    inverse, known = _inverse_depth(depth_m, edges)
    share = cv2.mean(known)[0]
    if not share or share < MIN_KNOWN_FRACTION:
        return nothing
    sigma = _pixel_sigma(inverse)
    side = _cell_side(inverse, sigma)
    shape = (_cells(inverse.shape[0], side), _cells(inverse.shape[1], side))
    rays, along_m = _averaged(inverse, known, shape, edges, camera)
    if not len(along_m):
        return nothing
    noise_m = along_m * along_m * (sigma * math.sqrt(shape[0] * shape[1] / inverse.size))
    drop = rays @ down
    ground_m = _ground(depth_m, edges, camera, down)
    if ground_m is None:
        ground_m = lens_height_m
    if ground_m is not None:
        gap_m = np.maximum(GROUND_GAP_M, _GROUND_SIGMAS * np.abs(drop) * noise_m)
        above = drop * along_m < ground_m - gap_m
        if np.count_nonzero(above) >= MIN_KNOWN_FRACTION * len(above):
            rays, along_m, drop, noise_m = rays[above], along_m[above], drop[above], noise_m[above]
    # Horizontal distance per metre along the optical axis.
    level = np.sqrt(np.maximum((rays * rays).sum(axis=1) - drop * drop, 0.0))
    ranges_m = level * along_m
    order = np.argsort(ranges_m, kind="stable")
    first = _first_of_object(ranges_m[order])
    first += int(_NEAR_FRACTION * (len(order) - first))
    index = order[first]
    range_m = _front(ranges_m[order[first:]], along_m[order[first:]], level[index] * noise_m[index])
    point: NDArray[np.float64] = rays[index] * (range_m / level[index] if level[index] else along_m[index])
    middle_px = _middle_px(rays[order[first:], 0], along_m[order[first:]], box, camera)
    return np.append(point, middle_px)


def _middle_px(
    x: NDArray[np.float64], along_m: NDArray[np.float64], box: list[float], camera: CameraModel
) -> float:
    """Column of the middle between the ends of an object; the box's centre where one of them is not seen.

    Args:
        x, along_m: of its cells, nearest first: rays' right over forward, and depth.
    """
    row = (box[1] + box[3]) / 2.0 - 0.5
    sides = camera.rays(np.array([[box[0] - 0.5, row], [box[2] - 0.5, row]]))
    first_x, last_x = np.where(sides[:, 2] > MIN_COSINE, sides[:, 0] / sides[:, 2], np.nan).tolist()
    wide = last_x - first_x
    centre, half = (box[0] + box[2]) / 2.0, (box[2] - box[0]) / 2.0
    ends = along_m[x < first_x + _END_SHARE * wide], along_m[x > last_x - _END_SHARE * wide]
    if not all(len(end) for end in ends):
        return centre
    farthest_m = float(along_m[0]) * (1.0 + _END_WIDTHS * wide)
    # The projection of the point halfway between the two.
    left_m, right_m = (min(_quantile(end, _END_QUANTILE), farthest_m) for end in ends)
    return float(centre + half * (right_m - left_m) / (right_m + left_m))


def _front(sorted_m: NDArray[np.float64], along_m: NDArray[np.float64], noise_m: float) -> float:
    """Where a surface begins whose cells have these ranges, nearest first, with this noise (one sigma).

    Args:
        along_m: depth of the same cells. Where it is the same, nothing is nearer than the nearest cell.
    """
    end = np.searchsorted(sorted_m, sorted_m[0] + _FRONT_SIGMAS * noise_m, side="right")
    front_m = sorted_m[:end]
    mean_m, variance, nearest_m = float(front_m.mean()), float(front_m.var()), float(sorted_m[0])
    first = slice(int(_SPAN_FRACTION * len(sorted_m)) + 1)
    span_m = min(float(np.ptp(sorted_m[first])), float(np.ptp(along_m[first])))
    begin_m = nearest_m - min(span_m, _SPAN_MAX_M, _SPAN_MAX_SHARE * nearest_m)
    explained = min(1.0, noise_m * noise_m / variance) if variance else float(noise_m > 0.0)
    return mean_m - math.sqrt(1.0 - explained) * (mean_m - begin_m)


def _pixels(first: float, last: float, size: int) -> tuple[int, int]:
    """The range of pixels between two edges, at least one where that is inside the image."""
    start, stop = math.floor(min(first, last) + 0.5), math.floor(max(first, last) + 0.5)
    stop = max(stop, start + 1)
    return max(start, 0), max(min(stop, size), 0)


def _inverse_depth(
    depth_m: NDArray[np.float32], edges: _Edges
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """1 / depth, 0 where unknown; and 1 where known, else 0. Large boxes are subsampled."""
    left, top, right, bottom = edges
    if right <= left or bottom <= top:
        return np.zeros((1, 1), np.float32), np.zeros((1, 1), np.float32)
    rows = slice(top, bottom, -(-(bottom - top) // _MAX_PIXELS))
    columns = slice(left, right, -(-(right - left) // _MAX_PIXELS))
    part = depth_m[rows, columns]
    known = ((part > 0.0) & (part < np.inf)).astype(np.float32)
    inverse = np.zeros(part.shape, np.float32)
    np.divide(known, part, out=inverse, where=known > 0.0)
    return inverse, known


def _pixel_sigma(inverse: NDArray[np.float32]) -> float:
    """Noise of one pixel of inverse depth, from neighbours, which differ by little else on a surface.

    Returns 0 where too few pixels are known.
    """
    rows, columns = (max(1, size // 32) for size in inverse.shape)
    first, second = inverse[::rows, :-1:columns], inverse[::rows, 1::columns]
    both = np.minimum(first, second) > 0.0
    differences = np.abs(first - second)[both]
    count = int(_SMOOTH_SHARE * differences.size)
    if count < _SMOOTH_MIN:
        return 0.0
    smallest = np.partition(differences, count)[:count]
    return math.sqrt(float(np.square(smallest).mean()) / 2.0) / _SMOOTH_RMS


def _cell_side(inverse: NDArray[np.float32], sigma: float) -> float:
    """Side of a cell in pixels for its noise to be small, at the depth of the box's centre."""
    high, wide = inverse.shape
    rows, columns = (max(1, size // 32) for size in inverse.shape)
    middle = inverse[high // 4 : high - high // 4 : rows, wide // 4 : wide - wide // 4 : columns]
    middle = middle[middle > 0.0]
    if not middle.size:
        return 1.0
    near = _quantile(middle, 0.75)
    side = min(sigma / (near * near * _CELL_SIGMA_M), min(high, wide) / _MIN_CELLS)
    return float(max(1.0, side))


def _cells(pixels: int, side: float) -> int:
    return max(1, min(_MAX_CELLS, round(pixels / side)))


def _averaged(
    inverse: NDArray[np.float32],
    known: NDArray[np.float32],
    shape: tuple[int, int],
    edges: _Edges,
    camera: CameraModel,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of the cells with depth: (M, 3) rays with z = 1, optical frame; (M,) depth, metres."""
    high, wide = shape
    sums = cv2.resize(inverse, (wide, high), interpolation=cv2.INTER_AREA)
    shares = cv2.resize(known, (wide, high), interpolation=cv2.INTER_AREA)
    rows, columns = np.nonzero(shares > 0.3)
    left, top, right, bottom = edges
    pixels = np.empty((len(rows), 2))
    pixels[:, 0] = left - 0.5 + (columns + 0.5) * ((right - left) / wide)
    pixels[:, 1] = top - 0.5 + (rows + 0.5) * ((bottom - top) / high)
    rays, along_m = camera.rays(pixels), (shares[rows, columns] / sums[rows, columns]).astype(np.float64)
    ahead = rays[:, 2] > MIN_COSINE  # a fisheye also has pixels without a ray, and rays across its axis
    return rays[ahead] / rays[ahead, 2:], along_m[ahead]


def _ground(
    depth_m: NDArray[np.float32], edges: _Edges, camera: CameraModel, down: NDArray[np.float64]
) -> float | None:
    """Height of the lens above the ground at the object, metres; None where it cannot be measured."""
    left, top, right, bottom = edges
    first = bottom + 1  # the row in between belongs partly to the object
    last = min(depth_m.shape[0], first + max(_STRIP_MIN_PX, round(_STRIP * (bottom - top))))
    if last - first < _STRIP_MIN_PX:
        return None
    below = (left, first, right, last)
    inverse, known = _inverse_depth(depth_m, below)
    shape = (min(2, inverse.shape[0]), min(8, inverse.shape[1]))
    rays, along_m = _averaged(inverse, known, shape, below, camera)
    if len(along_m) < 3:
        return None
    return _quantile((rays @ down) * along_m, 0.5)


def _quantile(values: NDArray[Any], share: float) -> float:
    """A quantile without interpolation, in a fifth of the time of `np.quantile`."""
    index = int(values.size * share)
    return float(np.partition(values, index)[index])


def _first_of_object(sorted_m: NDArray[np.float64]) -> int:
    """Index of the object's first range in its box: after a few cells that are clearly nearer."""
    few = sorted_m[: int(_OTHER_FRACTION * len(sorted_m)) + 2]
    gaps = np.flatnonzero(few[1:] - few[:-1] > _OTHER_GAP_M)
    return int(gaps[-1]) + 1 if len(gaps) else 0
