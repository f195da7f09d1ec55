"""The colour of an object by the pixels in the middle of its box."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

COLOURS = ("black", "white", "grey", "red", "orange", "yellow", "green", "blue", "purple", "pink", "brown")

# OpenCV's hue is in steps of two degrees. Upper bound of each name; above the last one it is red again.
_HUE_ENDS = np.array([8, 20, 34, 85, 130, 150, 170])
_HUE_NAMES = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "red")
_MIDDLE = 0.5  # of each side of the box: less of the background
_MIN_SATURATION, _MIN_VALUE = 70, 45
_BLACK_VALUE, _WHITE_VALUE = 60, 180
_BROWN_VALUE = 130
# A car has windows and tyres: so large a coloured share of the pixels names it.
_COLOURED_SHARE = 0.35
_MIN_PIXELS = 12


def colour_of(image: NDArray[np.uint8], xyxy: Sequence[float]) -> str | None:
    """The name of a box's colour, one of COLOURS.

    Args:
        image: (height, width, 3), BGR.
        xyxy: the box's left, top, right and bottom edge, pixels.

    Returns:
        None where the middle of the box has fewer than 12 pixels in the image.
    """
    left, top, right, bottom = xyxy
    x, y = (left + right) / 2, (top + bottom) / 2
    half_x, half_y = (right - left) * _MIDDLE / 2, (bottom - top) * _MIDDLE / 2
    height, width = image.shape[:2]
    columns = slice(max(round(x - half_x), 0), min(round(x + half_x), width))
    rows = slice(max(round(y - half_y), 0), min(round(y + half_y), height))
    middle = image[rows, columns]
    if middle.shape[0] * middle.shape[1] < _MIN_PIXELS:
        return None
    hue, saturation, value = cv2.cvtColor(middle, cv2.COLOR_BGR2HSV).reshape(-1, 3).T
    coloured = (saturation >= _MIN_SATURATION) & (value >= _MIN_VALUE)
    if coloured.mean() < _COLOURED_SHARE:
        level = float(np.median(value))
        return "black" if level < _BLACK_VALUE else "white" if level >= _WHITE_VALUE else "grey"
    counts = dict.fromkeys(_HUE_NAMES, 0)
    bins = np.searchsorted(_HUE_ENDS, hue[coloured], side="right")
    for index, count in enumerate(np.bincount(bins, minlength=len(_HUE_NAMES))):
        counts[_HUE_NAMES[index]] += int(count)
    name = max(counts, key=lambda each: counts[each])
    dark = float(np.median(value[coloured])) < _BROWN_VALUE
    return "brown" if name == "orange" and dark else name
