"""A constant-velocity Kalman filter of boxes, many at once.

The state of one box is (x, y, width, height and their rates): pixels of its middle, pixels, and pixels a
second. Noise is in proportion to the box's own size (the geometric mean of its sides),
and grows with time, not with frames: cameras drop frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# One sigma of a detected box's middle and sides, in box sizes.
MEASURED = 0.05
# Where a box goes by itself: a random walk (sizes / √s) and changes of its speed (sizes / s / √s). At 30
# frames a second 0.27 and 1.0 are the 1/20 and 1/160 a frame of ByteTrack's own filter; the vehicle's motion,
# where it is not known, asks for quicker changes of speed (tuned on rendered sequences, flat from 1 to 3).
WALK = 0.27
ACCELERATION = 2.0
# What may be the speed of a box that was seen once, sizes / s.
FIRST_SPEED = 2.0
# No box is smaller than this, pixels: sizes must stay positive.
SMALLEST_PX = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class BoxStates:
    """N boxes as they are believed to be.

    Attributes:
        mean: (N, 8).
        covariance: (N, 8, 8).
    """

    mean: Array
    covariance: Array

    @classmethod
    def none(cls) -> BoxStates:
        return cls(np.zeros((0, 8)), np.zeros((0, 8, 8)))

    def __len__(self) -> int:
        return len(self.mean)

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> BoxStates:
        return BoxStates(self.mean[index], self.covariance[index])

    def joined(self, other: BoxStates) -> BoxStates:
        """These and then the others."""
        return BoxStates(
            np.concatenate([self.mean, other.mean]), np.concatenate([self.covariance, other.covariance])
        )

    @property
    def xyxy(self) -> Array:
        """(N, 4) pixels: left, top, right, bottom."""
        half = np.maximum(self.mean[:, 2:4], SMALLEST_PX) / 2
        return np.concatenate([self.mean[:, :2] - half, self.mean[:, :2] + half], axis=1)


def begun(xyxy: NDArray[np.floating]) -> BoxStates:
    """Boxes (N, 4) seen for the first time: of their rates nothing is known."""
    measured = _measurement(xyxy)
    size = _size(measured)
    mean = np.concatenate([measured, np.zeros_like(measured)], axis=1)
    deviation = np.concatenate(
        [np.repeat(MEASURED * size, 4, 1), np.repeat(FIRST_SPEED * size, 4, 1)], axis=1
    )
    return BoxStates(mean, _diagonal(deviation**2))


def predicted(states: BoxStates, elapsed_s: float) -> BoxStates:
    """Where the boxes are `elapsed_s` later."""
    if elapsed_s <= 0.0 or not len(states):
        return states
    forward = np.eye(8)
    forward[:4, 4:] = elapsed_s * np.eye(4)
    size = _size(states.mean)[:, 0]
    spread = ACCELERATION**2 * size**2
    noise = np.zeros_like(states.covariance)
    index = np.arange(4)
    noise[:, index, index] = (WALK**2 * size**2 * elapsed_s + spread * elapsed_s**3 / 3)[:, None]
    noise[:, index + 4, index + 4] = (spread * elapsed_s)[:, None]
    noise[:, index, index + 4] = noise[:, index + 4, index] = (spread * elapsed_s**2 / 2)[:, None]
    return BoxStates(states.mean @ forward.T, forward @ states.covariance @ forward.T + noise)


def corrected(states: BoxStates, xyxy: NDArray[np.floating]) -> BoxStates:
    """The same boxes after each was seen at `xyxy` (N, 4)."""
    measured = _measurement(xyxy)
    spread = states.covariance[:, :4, :4] + _diagonal(np.repeat((MEASURED * _size(measured)) ** 2, 4, 1))
    gain = np.linalg.solve(spread, states.covariance[:, :4, :]).transpose(0, 2, 1)
    mean = states.mean + (gain @ (measured - states.mean[:, :4])[:, :, None])[:, :, 0]
    covariance = states.covariance - gain @ states.covariance[:, :4, :]
    return BoxStates(mean, (covariance + covariance.transpose(0, 2, 1)) / 2)


def _measurement(xyxy: NDArray[np.floating]) -> Array:
    """(N, 4) xyxy → (N, 4) middle and sides."""
    boxes = np.asarray(xyxy, np.float64).reshape(-1, 4)
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], SMALLEST_PX)
    return np.concatenate([(boxes[:, :2] + boxes[:, 2:]) / 2, sides], axis=1)


def _size(values: Array) -> Array:
    """(N, 1) geometric mean of the sides in columns 2 and 3."""
    sides = np.maximum(values[:, 2:4], SMALLEST_PX)
    size: Array = np.sqrt(sides[:, :1] * sides[:, 1:])
    return size


def _diagonal(variances: Array) -> Array:
    matrices = np.zeros((*variances.shape, variances.shape[1]))
    index = np.arange(variances.shape[1])
    matrices[:, index, index] = variances
    return matrices
