"""Constant-velocity Kalman filter for many boxes at once.

A box's state is (x, y, width, height) and their rates: centre and sides in pixels, rates in pixels per
second. Noise is proportional to the box's size (geometric mean of its sides) and grows with time, not frames,
because cameras drop frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# One sigma of a detected box's centre and sides, in box sizes.
MEASURED = 0.05
# Process noise: random walk (sizes / √s) and velocity changes (sizes / s / √s). At 30 frames per second 0.27
# and 1.0 equal the 1/20 and 1/160 per frame of ByteTrack's own filter; uncompensated vehicle motion needs
# faster velocity changes (tuned on rendered sequences, flat from 1 to 3).
WALK = 0.27
ACCELERATION = 2.0
# One sigma of the initial velocity, sizes / s.
FIRST_SPEED = 2.0
# Smallest side, pixels: sizes must stay positive.
SMALLEST_PX = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class BoxStates:
    """Estimated states of N boxes.

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
        """These states followed by the other ones."""
        return BoxStates(
            np.concatenate([self.mean, other.mean]), np.concatenate([self.covariance, other.covariance])
        )

    @property
    def xyxy(self) -> Array:
        """(N, 4) pixels: left, top, right, bottom."""
        half = np.maximum(self.mean[:, 2:4], SMALLEST_PX) / 2
        return np.concatenate([self.mean[:, :2] - half, self.mean[:, :2] + half], axis=1)


def initiate(xyxy: NDArray[np.floating]) -> BoxStates:
    """States of boxes (N, 4) detected for the first time, with unknown rates."""
    measured = _measurement(xyxy)
    size = _size(measured)
    mean = np.concatenate([measured, np.zeros_like(measured)], axis=1)
    deviation = np.concatenate(
        [np.repeat(MEASURED * size, 4, 1), np.repeat(FIRST_SPEED * size, 4, 1)], axis=1
    )
    return BoxStates(mean, _diagonal(deviation**2))


def predict(states: BoxStates, elapsed_s: float) -> BoxStates:
    """Predict the states `elapsed_s` ahead."""
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


def correct(states: BoxStates, xyxy: NDArray[np.floating]) -> BoxStates:
    """Correct each state with its detected box, (N, 4)."""
    measured = _measurement(xyxy)
    spread = states.covariance[:, :4, :4] + _diagonal(np.repeat((MEASURED * _size(measured)) ** 2, 4, 1))
    gain = np.linalg.solve(spread, states.covariance[:, :4, :]).transpose(0, 2, 1)
    mean = states.mean + (gain @ (measured - states.mean[:, :4])[:, :, None])[:, :, 0]
    covariance = states.covariance - gain @ states.covariance[:, :4, :]
    return BoxStates(mean, (covariance + covariance.transpose(0, 2, 1)) / 2)


def _measurement(xyxy: NDArray[np.floating]) -> Array:
    """(N, 4) xyxy → (N, 4) centre and sides."""
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
