"""What an object looks like, in a few numbers: colour histograms of three bands of its box.

It distinguishes a track's object from another after a gap, when the predicted box fits many objects.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Histograms are of this many pixels along each side of the inner part of a box, whatever its size.
_SIDE, _INNER = 18, 0.9
_BANDS = 3
# Bins and range of the logarithm to base 2 of the luma relative to the image's median, and of the two colour
# differences relative to the luma.
_LUMA = (8, -3.0, 3.0)
_CHROMA = (6, -0.35, 0.35)
_LUMA_OF_BGR = np.array([0.114, 0.587, 0.299], np.float32)
# Every so many pixels of the image are a sample of its brightness and colour.
_SAMPLED = 16
# Darker values are noise.
_DARK, _DARK_CHROMA = 2.0, 16.0


def appearances(image: NDArray[np.uint8], xyxy: NDArray[np.floating]) -> NDArray[np.float32]:
    """The appearance of each box: (N, 60) float32 of length 1. The product of two is their similarity, 0..1.

    It is the Bhattacharyya coefficient, averaged over luma and colour of the upper, middle and lower third.
    The colours are balanced and the luma is relative to the whole image's (gray world), so that another
    exposure or white balance changes little.

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
    sample = image[_SAMPLED // 2 :: _SAMPLED, _SAMPLED // 2 :: _SAMPLED].reshape(-1, 3).astype(np.float32)
    balance = np.maximum(sample.mean(axis=0), 1.0)
    balance = balance.mean() / balance
    median = max(float(np.median(sample @ (_LUMA_OF_BGR * balance))), _DARK) if len(sample) else 1.0
    patches = image[rows[:, :, None], columns[:, None, :]]
    pixels = patches.reshape(count * _BANDS, _SIDE * _SIDE // _BANDS, 3).astype(np.float32) * balance
    luma = pixels @ _LUMA_OF_BGR
    relative = np.log2(np.maximum(luma, _DARK) / median)
    shade = np.maximum(luma, _DARK_CHROMA)
    parts = [_histograms(relative, *_LUMA)]
    parts += [_histograms((pixels[..., each] - luma) / shade, *_CHROMA) for each in (0, 2)]
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
