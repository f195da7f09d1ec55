"""Correlation filters that follow one rectangle of any content from image to image.

M. Danelljan et al., "Accurate Scale Estimation for Robust Visual Tracking", BMVC 2014 (DSST): one filter for
the translation over several feature channels and one for the scale, both learned while tracking, in the
Fourier domain. The loss test is the peak-to-sidelobe ratio of D. Bolme et al., "Visual Object Tracking using
Adaptive Correlation Filters", CVPR 2010 (MOSSE).

Differences from the paper: the channels are the gray value and a histogram of gradient directions in cells of
4 pixels (N. Dalal, B. Triggs, "Histograms of Oriented Gradients for Human Detection", CVPR 2005), normalized
by its surroundings; 17 scales instead of 33; an image with a low ratio is not learned.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]
Floats = NDArray[np.float32]
Box = tuple[float, float, float, float]
"""Left, top, right, bottom; pixels."""

CELL_PX, DIRECTIONS = 4, 9
# Search window in box sizes, and its side in cells.
PADDING, WINDOW_CELLS = 2.5, 24
# Expected response: one sigma as a fraction of the box (the paper's), in cells.
RESPONSE_SIGMA = WINDOW_CELLS / PADDING / 16.0
SCALES, SCALE_STEP, SCALE_CELLS = 17, 1.03, 6
SCALE_SIGMA = 0.25 * math.sqrt(SCALES)
LEARNING_RATE, REGULARIZATION = 0.025, 0.01
# Half a side of the square around the peak that is not part of the sidelobe, cells (5 of 64 in MOSSE).
PEAK_HALF = 4
_EPSILON = 1e-5


class Match(NamedTuple):
    """Where the rectangle was found.

    Attributes:
        box: left, top, right, bottom, pixels.
        ratio: peak-to-sidelobe ratio of the response: the peak's height above the mean, in standard
            deviations.
    """

    box: Box
    ratio: float


class CorrelationFilter:
    """Follows the content of one rectangle.

    >>> blocks = np.random.default_rng(1).integers(0, 255, (3, 4), np.uint8)
    >>> image = np.full((240, 320), 90, np.uint8)
    >>> image[100:130, 100:140] = np.kron(blocks, np.ones((10, 10), np.uint8))
    >>> follower = CorrelationFilter(image, (100, 100, 140, 130))
    >>> moved = np.roll(image, (3, 6), (0, 1))
    >>> match = follower.search(moved, (100, 100, 140, 130))
    >>> round(match.box[0]), round(match.box[1])
    (106, 103)

    Args:
        gray: (height, width) uint8.
        box: the rectangle in it.
    """

    def __init__(self, gray: Gray, box: Box) -> None:
        window = np.fft.rfft2(_window_features(gray, box), axes=(0, 1))
        scales = np.fft.rfft(_scale_features(gray, box), axis=0)
        self._seen = _Seen(window, scales)
        self._numerator, self._denominator = _translation_parts(window, 0.0, 0.0)
        self._scale_numerator, self._scale_denominator = _scale_parts(scales, 0.0)

    def search(self, gray: Gray, expected: Box) -> Match:
        """Find the rectangle near where it is expected: its position first, then its size."""
        window = np.fft.rfft2(_window_features(gray, expected), axes=(0, 1))
        response = np.fft.irfft2(
            (self._numerator.conj() * window).sum(2) / (self._denominator + REGULARIZATION),
            s=(WINDOW_CELLS, WINDOW_CELLS),
        )
        row, column = (int(index) for index in np.unravel_index(int(response.argmax()), response.shape))
        across = _signed(column + _between(response[row], column))
        down = _signed(row + _between(response[:, column], row))
        x, y, width, height = _centre_and_sides(expected)
        x += across * width * PADDING / WINDOW_CELLS
        y += down * height * PADDING / WINDOW_CELLS
        scales = np.fft.rfft(_scale_features(gray, _box(x, y, width, height)), axis=0)
        response_of_scales = np.fft.irfft(
            (self._scale_numerator.conj() * scales).sum(1) / (self._scale_denominator + REGULARIZATION),
            n=SCALES,
        )
        best = int(response_of_scales.argmax())
        steps = best - SCALES // 2 + _between(response_of_scales, best)
        factor = SCALE_STEP**steps
        self._seen = _Seen(window, scales, across, down, steps)
        return Match(_box(x, y, width * factor, height * factor), _ratio(response, row, column))

    def learn(self) -> None:
        """Update both filters with the last match.

        The samples of the search are used again, with the expected response where the match was: to extract
        them once more around the match would take as long as the search.
        """
        seen = self._seen
        numerator, denominator = _translation_parts(seen.window, seen.across, seen.down)
        self._numerator += LEARNING_RATE * (numerator - self._numerator)
        self._denominator += LEARNING_RATE * (denominator - self._denominator)
        numerator, denominator = _scale_parts(seen.scales, seen.steps)
        self._scale_numerator += LEARNING_RATE * (numerator - self._scale_numerator)
        self._scale_denominator += LEARNING_RATE * (denominator - self._scale_denominator)


class _Seen(NamedTuple):
    """The samples of a search in the Fourier domain, and where the match was in them, in cells and scales."""

    window: NDArray[np.complex128]
    scales: NDArray[np.complex128]
    across: float = 0.0
    down: float = 0.0
    steps: float = 0.0


def _translation_parts(
    window: NDArray[np.complex128], across: float, down: float
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Numerator (per channel) and denominator of the optimal translation filter of one image."""
    shift = np.exp(-2j * math.pi * (_ROWS[:, None] * down + _COLUMNS * across))
    return (_EXPECTED * shift).conj()[:, :, None] * window, (np.abs(window) ** 2).sum(2)


def _scale_parts(
    scales: NDArray[np.complex128], steps: float
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    shift = np.exp(-2j * math.pi * _SCALE_FREQUENCIES * steps)
    return (_EXPECTED_SCALE * shift).conj()[:, None] * scales, (np.abs(scales) ** 2).sum(1)


def _window_features(gray: Gray, box: Box) -> Floats:
    """(cells, cells, channels) of the search window around a box, with a cosine window."""
    x, y, width, height = _centre_and_sides(box)
    patch = _patch(gray, x, y, PADDING * width, PADDING * height, WINDOW_CELLS * CELL_PX)
    features: Floats = _features(patch[None])[0] * _COSINE
    return features


def _scale_features(gray: Gray, box: Box) -> Floats:
    """(scales, values): the box at every scale, weighted by a window over the scales."""
    x, y, width, height = _centre_and_sides(box)
    side = SCALE_CELLS * CELL_PX
    patches = np.stack([_patch(gray, x, y, width * s, height * s, side) for s in _SCALE_FACTORS])
    features: Floats = _features(patches).reshape(SCALES, -1) * _SCALE_WINDOW
    return features


def _patch(gray: Gray, x: float, y: float, width: float, height: float, side: int) -> Gray:
    """(side, side): the rectangle around a centre; outside the image its edge is repeated."""
    while min(width, height) >= 4 * side:  # else every second pixel or fewer would be used
        gray = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        x, y, width, height = x / 2, y / 2, width / 2, height / 2
    across, down = width / side, height / side
    back = np.array([[across, 0.0, x - width / 2 + across / 2], [0.0, down, y - height / 2 + down / 2]])
    back[:, 2] -= 0.5  # from pixel edges to pixel centres
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(gray, back, (side, side), flags=flags, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[return-value]


def _features(patches: Gray) -> Floats:
    """(N, side / 4, side / 4, 1 + directions) of (N, side, side) patches."""
    count, side, _ = patches.shape
    cells = side // CELL_PX
    values = patches.astype(np.float32) / 255.0
    across, down = np.zeros_like(values), np.zeros_like(values)
    across[:, :, 1:-1] = values[:, :, 2:] - values[:, :, :-2]
    down[:, 1:-1] = values[:, 2:] - values[:, :-2]
    size, direction = cv2.cartToPolar(across.reshape(-1, side), down.reshape(-1, side))
    position = direction.ravel() * (DIRECTIONS / math.pi)
    lower = position.astype(np.int32)
    share = position - lower
    cell = _cell_index(count, side) * DIRECTIONS
    weights = size.ravel()
    length = count * cells * cells * DIRECTIONS
    sums = np.bincount(cell + lower % DIRECTIONS, weights * (1.0 - share), length)
    sums += np.bincount(cell + (lower + 1) % DIRECTIONS, weights * share, length)
    histogram: Floats = sums.reshape(count, cells, cells, DIRECTIONS).astype(np.float32)
    energy = (histogram**2).sum(3)
    around = np.stack([cv2.blur(one, (3, 3)) for one in energy])
    histogram /= np.sqrt(around + _EPSILON)[..., None] + 0.05
    mean = values.reshape(count, cells, CELL_PX, cells, CELL_PX).mean((2, 4))
    mean -= mean.mean((1, 2), keepdims=True)
    return np.concatenate([mean[..., None], histogram], axis=3)


@lru_cache(maxsize=2)
def _cell_index(count: int, side: int) -> NDArray[np.int64]:
    """The cell of every pixel, flat."""
    cells = side // CELL_PX
    one = np.arange(side) // CELL_PX
    grid = one[:, None] * cells + one[None]
    index: NDArray[np.int64] = (np.arange(count)[:, None, None] * cells**2 + grid).ravel()
    return index


def _ratio(response: NDArray[np.float64], row: int, column: int) -> float:
    """Peak-to-sidelobe ratio of a periodic response."""
    sidelobe = np.ones(response.shape, np.bool_)
    around = np.arange(-PEAK_HALF, PEAK_HALF + 1)
    sidelobe[np.ix_((row + around) % WINDOW_CELLS, (column + around) % WINDOW_CELLS)] = False
    outside = response[sidelobe]
    return float((response[row, column] - outside.mean()) / (outside.std() + _EPSILON))


def _between(values: NDArray[np.float64], best: int) -> float:
    """Offset of the maximum of a parabola through the best of periodic values and its neighbours."""
    before, peak, after = values[best - 1], values[best], values[(best + 1) % len(values)]
    bend = before - 2 * peak + after
    return 0.0 if bend >= 0.0 else float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))


def _signed(cells: float) -> float:
    """A shift in a periodic window: beyond its half it is negative."""
    return (cells + WINDOW_CELLS / 2) % WINDOW_CELLS - WINDOW_CELLS / 2


def _centre_and_sides(box: Box) -> tuple[float, float, float, float]:
    left, top, right, bottom = box
    return (left + right) / 2, (top + bottom) / 2, right - left, bottom - top


def _box(x: float, y: float, width: float, height: float) -> Box:
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def _periodic_distance(count: int) -> NDArray[np.float64]:
    index = np.arange(count)
    return np.minimum(index, count - index).astype(np.float64)


_far = _periodic_distance(WINDOW_CELLS)
_EXPECTED = np.fft.rfft2(np.exp(-0.5 * (_far[:, None] ** 2 + _far[None] ** 2) / RESPONSE_SIGMA**2))
_COSINE = np.outer(np.hanning(WINDOW_CELLS), np.hanning(WINDOW_CELLS)).astype(np.float32)[:, :, None]
_EXPECTED_SCALE = np.fft.rfft(np.exp(-0.5 * ((np.arange(SCALES) - SCALES // 2) / SCALE_SIGMA) ** 2))
_ROWS, _COLUMNS = np.fft.fftfreq(WINDOW_CELLS), np.fft.rfftfreq(WINDOW_CELLS)
_SCALE_FREQUENCIES = np.fft.rfftfreq(SCALES)
_SCALE_FACTORS = [SCALE_STEP ** (index - SCALES // 2) for index in range(SCALES)]
_SCALE_WINDOW = np.hanning(SCALES + 2)[1:-1].astype(np.float32)[:, None]
