"""The shadows of objects on the ground."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from mavlink_sim.camera.ground_view import View
from mavlink_sim.camera.object_view import (
    FAR_PX,
    NEAR_M,
    SUBPIXEL_BITS,
    PlacedObject,
    within_view,
)
from mavlink_sim.world.depth_sort import clip_polygon
from mavlink_sim.world.textures import Image

MAX_SHADOW_SOLIDS_AT_PX = 14.0
"""A shadow smaller than this is drawn as one outline, not as one per solid."""

Outlines = tuple[NDArray[np.float64], list[int]]
"""(P, 2) corners in pixels of all convex outlines, and the start of each and the end of the last."""


class Shadows:
    """The shadows of these objects."""

    def __init__(self, placed: Sequence[PlacedObject]) -> None:
        self._placed = list(placed)
        spheres = [_around(item) for item in self._placed]
        self._middles = np.array([middle for middle, _ in spheres]).reshape(-1, 3)
        self._radii = np.array([radius_m for _, radius_m in spheres])

    def cast(self, view: View, darkness: float, image: Image) -> None:
        """Darken the ground of `image` by `darkness`, 0..1, in the objects' shadows."""
        if darkness <= 0.0:
            return
        mask: Image | None = None
        left, top, right, bottom = view.width, view.height, 0, 0
        for placed in within_view(self._placed, self._middles, self._radii, view):
            outlines = _in_view(placed, view)
            if outlines is None:
                continue
            if mask is None:
                mask = np.zeros((view.height, view.width), np.uint8)
            points, first = outlines
            low = np.minimum.reduceat(points, first[:-1])
            high = np.maximum.reduceat(points, first[:-1])
            shown = (high >= 0.0).all(axis=1) & (low <= (view.width, view.height)).all(axis=1)
            if not shown.any():
                continue
            left, top = np.minimum((left, top), low[shown].astype(np.int64).min(axis=0)).tolist()
            right, bottom = np.maximum((right, bottom), high[shown].astype(np.int64).max(axis=0)).tolist()
            fixed = np.rint(np.clip(points, -FAR_PX, FAR_PX) * (1 << SUBPIXEL_BITS)).astype(np.int32)
            for index in np.flatnonzero(shown).tolist():
                outline = fixed[first[index] : first[index + 1]]
                cv2.fillConvexPoly(mask, outline, 255, cv2.LINE_8, SUBPIXEL_BITS)
        left, top = max(left - 4, 0), max(top - 4, 0)
        right, bottom = min(right + 5, view.width), min(bottom + 5, view.height)
        if mask is None or right <= left or bottom <= top:
            return
        soft = cv2.blur(mask[top:bottom, left:right], (5, 5))
        factor = cv2.cvtColor(255 - cv2.convertScaleAbs(soft, alpha=darkness), cv2.COLOR_GRAY2BGR)
        part = image[top:bottom, left:right]
        cv2.multiply(part, factor, dst=part, scale=1 / 255)


def _around(placed: PlacedObject) -> tuple[NDArray[np.float64], float]:
    """Centre (3,) NED and radius in metres of a sphere around a shadow, without its outlines.

    The outlines of moving objects are computed for each frame, only for those that may be in view.
    """
    lean = placed.sun[:2] / max(-float(placed.sun[2]), 0.05)
    height_m = max(max(float(placed.origin[2]), 0.0) - float(placed.middle[2]), 0.0)
    north_east = placed.middle[:2] - lean * height_m
    return np.array([*north_east, 0.0]), placed.radius_m * math.hypot(1.0, float(lean[0]), float(lean[1]))


def _in_view(placed: PlacedObject, view: View) -> Outlines | None:
    """A shadow's outlines, clipped at the near plane, one for all where it is small; None if out of view."""
    corners, first = placed.shadow
    projected = (corners - view.eye) @ view.pixel_from_ned.T
    depth = projected[:, 2]
    if float(depth.max()) < NEAR_M:
        return None
    if float(depth.min()) >= NEAR_M:
        points = projected[:, :2] / projected[:, 2:]
        low, high = points.min(axis=0), points.max(axis=0)
        if high[0] < 0 or high[1] < 0 or low[0] > view.width or low[1] > view.height:
            return None
        if float((high - low).max()) < MAX_SHADOW_SOLIDS_AT_PX:
            hull = cv2.convexHull(points.astype(np.float32)).reshape(-1, 2).astype(np.float64)
            return hull, [0, len(hull)]
        return points, first
    forward = np.array([0.0, 0.0, 1.0])
    cut: list[NDArray[np.float64]] = []
    ends = [0]
    for start, end in pairwise(first):
        piece = projected[start:end]
        nearest = float(piece[:, 2].min())
        kept = piece if nearest >= NEAR_M else clip_polygon(piece, forward, NEAR_M)
        if len(kept) >= 3:
            cut.append(kept[:, :2] / kept[:, 2:])
            ends.append(ends[-1] + len(kept))
    return (np.concatenate(cut), ends) if cut else None
