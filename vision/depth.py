"""How far an object is, from a depth image and the object's box."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Of the box, in each direction: its edges show more of what is behind the object than of the object.
CENTRAL_FRACTION = 0.5
# The near tenth: the object is what is nearest there (of a lorry seen askew, its corner), and single wrong
# near pixels do not decide.
NEAR_PERCENTILE = 10.0
# With fewer pixels of known depth than this share, what is known may well be something else.
MIN_KNOWN_FRACTION = 0.1
# A grid of about this many rows and columns is enough for a percentile, however large the box.
_GRID = 48


def range_of_boxes(depth_m: NDArray[np.float32], xyxy: NDArray[Any]) -> NDArray[np.float32]:
    """The range to the near surface of the object in each box.

    Args:
        depth_m: (height, width) float32, metres along the optical axis; NaN, infinite or not above zero where
            unknown.
        xyxy: (N, 4) boxes in that image's pixels: left, top, right, bottom.

    Returns:
        (N,) float32, metres along the optical axis; NaN where too little of the box has a known depth.
    """
    boxes = np.asarray(xyxy, np.float64).reshape(-1, 4)
    return np.array([_range_of_box(depth_m, *box) for box in boxes.tolist()], np.float32)


def _range_of_box(
    depth_m: NDArray[np.float32], left: float, top: float, right: float, bottom: float
) -> float:
    if not all(math.isfinite(edge) for edge in (left, top, right, bottom)):
        return math.nan
    rows = _central(top, bottom, depth_m.shape[0])
    columns = _central(left, right, depth_m.shape[1])
    central = depth_m[rows, columns]
    known = central[np.isfinite(central) & (central > 0)]
    if known.size == 0 or known.size < MIN_KNOWN_FRACTION * central.size:
        return math.nan
    return _near_percentile(known)


def _near_percentile(known: NDArray[np.float32]) -> float:
    """As `np.percentile`, which takes longer to look at what it was given than this takes."""
    place = (known.size - 1) * (NEAR_PERCENTILE / 100.0)
    below = int(place)
    above = min(below + 1, known.size - 1)
    ordered = np.partition(known, (below, above))
    first, second = float(ordered[below]), float(ordered[above])
    return first + (second - first) * (place - below)


def _central(first: float, last: float, size: int) -> slice:
    """The pixels of the central part of an interval, at least one where it is inside the image."""
    middle, half = (first + last) / 2, abs(last - first) * CENTRAL_FRACTION / 2
    start = math.floor(middle - half)
    stop = max(math.ceil(middle + half), start + 1)
    start, stop = max(start, 0), max(min(stop, size), 0)
    return slice(start, stop, max(1, (stop - start) // _GRID))
