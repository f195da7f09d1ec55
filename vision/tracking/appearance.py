"""What an object looks like, in a few numbers: colour histograms of three bands of its box.

It distinguishes a track's object from another after a gap, when the predicted box fits many objects.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Histograms are of this many pixels along each side of the inner part of a box, whatever its size.
_SIDE, _INNER = 18, 0.9
_BANDS = 3
# Number of bins and range of luma and of the two colour differences, ITU-R BT.601.
_LUMA = (8, 0.0, 256.0)
_CHROMA = (6, -40.0, 40.0)
_TO_YCC = np.array(
    [[0.114, 0.500, -0.081], [0.587, -0.331, -0.419], [0.299, -0.169, 0.500]], np.float32
)  # columns: Y, Cb, Cr of a BGR row


def appearances(image: NDArray[np.uint8], xyxy: NDArray[np.floating]) -> NDArray[np.float32]:
    """The appearance of each box: (N, 60) float32 of length 1. The product of two is their similarity, 0..1.

    It is the Bhattacharyya coefficient, averaged over luma and colour of the upper, middle and lower third.

    Args:
        image: (height, width, 3) uint8, BGR.
        xyxy: (N, 4) pixels; parts outside the image take its border's colour.
    """
    count = len(xyxy)
    height, width = image.shape[:2]
    share = (np.arange(_SIDE) + 0.5) / _SIDE * _INNER + (1 - _INNER) / 2
    across, down = (
        low + (high - low) * share for low, high in ((xyxy[:, :1], xyxy[:, 2:3]), (xyxy[:, 1:2], xyxy[:, 3:]))
    )
    columns = np.clip(across, 0, width - 1).astype(np.intp)
    rows = np.clip(down, 0, height - 1).astype(np.intp)
    pixels = image[rows[:, :, None], columns[:, None, :]].reshape(count * _BANDS, _SIDE * _SIDE // _BANDS, 3)
    luma, blue, red = np.moveaxis(pixels.astype(np.float32) @ _TO_YCC, 2, 0)
    parts = [_histograms(luma, *_LUMA), _histograms(blue, *_CHROMA), _histograms(red, *_CHROMA)]
    roots = np.sqrt(np.concatenate(parts, axis=1) / (len(parts) * _BANDS))
    return roots.reshape(count, _BANDS * roots.shape[1]).astype(np.float32)


def _histograms(values: NDArray[np.float32], bins: int, low: float, high: float) -> NDArray[np.float64]:
    """The histogram of each row, (rows, bins); a value counts for the two nearest bins."""
    place = np.clip((values - low) / (high - low) * bins - 0.5, 0.0, bins - 1.001)
    left = place.astype(np.intp)
    part = (place - left).ravel()
    index = (np.arange(len(values))[:, None] * bins + left).ravel()
    size = len(values) * bins
    counts = np.bincount(index, 1 - part, size) + np.bincount(index + 1, part, size)
    shares: NDArray[np.float64] = counts.reshape(len(values), bins) / values.shape[1]
    return shares
