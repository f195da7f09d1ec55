"""Depth of a camera of its own, as the colour camera beside it sees it: registration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vision.camera_model import CameraModel, scaled_to_frames

Array = NDArray[np.float32]

# A point of a depth pixel's ray moves along a curve in the colour image. It is a parabola in the inverse
# depth through its points at these, 1/m: to 0.02 px from 0.4 m on, and to 0.4 px at 0.25 m, for two cameras
# 5 cm apart with the lenses of `mavlink-sim board`.
_INVERSE_DEPTHS = (0.0, 1.25, 2.5)
# A depth pixel covers this much more than its own size, so that surfaces seen from the side have no gaps.
_LARGER = 0.25
# Of a pixel's own point and the nearest one that covers it, the latter is taken if the former is farther by
# this factor: it is behind. Otherwise the own one, since the nearest of a slope is biased.
_BEHIND = 1.1
_LARGEST_PX = 8


@dataclass(frozen=True, eq=False)
class DepthCalibration:
    """A depth camera and a colour camera, fixed to each other.

    Attributes:
        depth, colour: their lenses.
        rotation, position_m: (3, 3) and (3,) metres, a point of the depth camera's optical frame in the
            colour camera's: `rotation @ point + position_m`.
    """

    depth: CameraModel
    colour: CameraModel
    rotation: NDArray[np.float64]
    position_m: NDArray[np.float64]

    def register(self, depth_m: Array, width: int, height: int) -> Array:
        """The depth of the colour camera's pixels.

        Where several points fall on one pixel it has the nearest.

        Args:
            depth_m: (h, w) metres along the depth camera's optical axis, of any size of its lens's aspect;
                NaN, infinite or not above zero if unknown.
            width, height: of the colour image.

        Returns:
            (height, width) metres along the colour camera's optical axis, NaN if unknown.

        Raises:
            ValueError: a size has another aspect than its lens.
        """
        table = _table(self, (depth_m.shape[1], depth_m.shape[0]), (width, height))
        return table.register(depth_m)


class _Table:
    """The curves of all depth pixels in colour images of one size."""

    def __init__(self, calibration: DepthCalibration, size: tuple[int, int], colour: tuple[int, int]) -> None:
        depth = scaled_to_frames(calibration.depth, *size)
        lens = scaled_to_frames(calibration.colour, *colour)
        self._size = colour
        columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        rays = depth.rays(np.column_stack([columns.ravel(), rows.ravel()]))
        # At a depth of 1: depth is measured along the axis.
        rays = (rays / np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan)) @ calibration.rotation.T
        first, second, third = (
            lens.project(rays + inverse * calibration.position_m) for inverse in _INVERSE_DEPTHS
        )
        step = _INVERSE_DEPTHS[1]
        square = (first - 2 * second + third) / (2 * step**2)
        linear = (second - first) / step - square * step
        self._curves = tuple(each.T.astype(np.float32) for each in (first, linear, square))
        self._forward = rays[:, 2].astype(np.float32)
        self._forward_m = np.float32(calibration.position_m[2])
        # Pixels of the colour image that a depth pixel covers, in both directions.
        by_row = first.reshape(*size[::-1], 2)
        apart = np.abs(np.diff(by_row, axis=1)).max(axis=2)
        larger = float(np.nanmedian(apart)) if np.isfinite(apart).any() else 1.0
        self._covered = min(max(math.ceil(larger + _LARGER), 1), _LARGEST_PX)

    def register(self, depth_m: Array) -> Array:
        width, height = self._size
        margin = self._covered
        depth = np.asarray(depth_m, np.float32).ravel()
        with np.errstate(all="ignore"):
            inverse = np.float32(1.0) / depth
            first, linear, square = self._curves
            column, row = first + inverse * (linear + inverse * square)
            ahead_m = depth * self._forward + self._forward_m
            column += np.float32(margin + 0.5)
            row += np.float32(margin + 0.5)
            used = (depth > 0.0) & (depth < np.inf) & (ahead_m > 0.0)
            used &= (column >= 1.0) & (column < width + margin) & (row >= 1.0) & (row < height + margin)
        column, row, ahead_m = column[used], row[used], ahead_m[used]
        shape = height + 2 * margin, width + 2 * margin
        own_m = np.full(shape[0] * shape[1], np.inf, np.float32)
        nearest_m = own_m.copy()
        np.minimum.at(own_m, row.astype(np.intp) * shape[1] + column.astype(np.intp), ahead_m)
        first_of = np.float32((self._covered - 1) / 2)
        pixels = (row - first_of).astype(np.intp) * shape[1] + (column - first_of).astype(np.intp)
        for down in range(self._covered if self._covered > 1 else 0):
            for right in range(self._covered):
                np.minimum.at(nearest_m, pixels + (down * shape[1] + right), ahead_m)
        registered = np.where(own_m <= nearest_m * np.float32(_BEHIND), own_m, nearest_m).reshape(shape)
        registered = registered[margin : margin + height, margin : margin + width]
        registered[np.isinf(registered)] = np.nan
        return registered


_table = lru_cache(maxsize=4)(_Table)
