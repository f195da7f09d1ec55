"""The ranges of a sensor that looks around: the nearest of level segments in each of 72 sectors of 5°."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

SECTORS = 72
SECTOR_RAD = math.tau / SECTORS
_EDGES = (np.arange(SECTORS) + 0.5) * SECTOR_RAD
# (72, 2) the border between each sector and the next
_BORDERS = np.column_stack([np.cos(_EDGES), np.sin(_EDGES)])


def nearest_in_sectors(segments: NDArray[np.float64]) -> NDArray[np.float64]:
    """(72,) metres to the nearest point of any segment within each sector of 5°, inf where there is none.

    Args:
        segments: (S, 2, 2) ends of each, metres forward and to the right of the sensor. Sector 0 is centred
            ahead, the others follow clockwise (seen from above).

    Within a sector the nearest point of a segment is its foot or an end, if in the sector, or on a border.
    """
    starts, ends = segments[:, 0], segments[:, 1]
    spans = ends - starts
    found = np.full(SECTORS, math.inf)
    squares = np.maximum((spans * spans).sum(axis=1), 1e-18)
    share = np.clip(-(starts * spans).sum(axis=1) / squares, 0.0, 1.0)
    points = np.concatenate([starts, ends, starts + share[:, None] * spans])
    bearings = np.arctan2(points[:, 1], points[:, 0])
    sectors = np.floor(bearings / SECTOR_RAD + 0.5).astype(np.intp) % SECTORS
    np.minimum.at(found, sectors, np.hypot(points[:, 0], points[:, 1]))
    # where each border (rows) meets each segment (columns): border · distance = start + share · span
    across = _BORDERS[:, :1] * spans[:, 1] - _BORDERS[:, 1:] * spans[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (starts[:, 0] * spans[:, 1] - starts[:, 1] * spans[:, 0]) / across
        share = (starts[:, 0] * _BORDERS[:, 1:] - starts[:, 1] * _BORDERS[:, :1]) / across
        met = (distance > 0.0) & (share >= 0.0) & (share <= 1.0)
    borders = np.where(met, distance, math.inf).min(axis=1, initial=math.inf)
    nearest: NDArray[np.float64] = np.minimum(found, np.minimum(borders, np.roll(borders, 1)))
    return nearest
