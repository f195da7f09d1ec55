"""Effect of camera rotation on boxes in the image, and the attitude history.

A pure rotation of the camera moves every pixel by the homography K R K⁻¹, independent of depth (Hartley,
Zisserman, Multiple View Geometry, 8.4). R comes from the vehicle's attitude.
"""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.attitude import Quaternion, slerp
from vision.camera_model import CameraModel
from vision.rotation import matrix_from_quaternion
from vision.tracking.kalman import BoxStates

Array = NDArray[np.float64]

HISTORY_S = 3.0
# Attitudes arrive late over a link: past the newest sample the rotation is extrapolated for this long.
MAX_AHEAD_S = 0.1
# Samples farther apart than this are not interpolated.
MAX_GAP_S = 0.5
# A box seen more obliquely than this (cosine to the optical axis) is outside every image.
MIN_COSINE = 0.17


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """Camera orientation when a frame was captured.

    Attributes:
        camera: the model at the frame's size.
        ned_from_optical: (3, 3) rotation from the optical frame to NED.
    """

    camera: CameraModel
    ned_from_optical: Array

    def turn_from(self, earlier: CameraView) -> Array:
        """(3, 3) rotation of directions in the earlier optical frame into this one."""
        turn: Array = self.ned_from_optical.T @ earlier.ned_from_optical
        return turn


def rotate_boxes(states: BoxStates, camera: CameraModel, turn: Array) -> tuple[BoxStates, NDArray[np.bool_]]:
    """Apply a pure camera rotation to the boxes.

    To first order about each box's centre: the homography moves the centre, rotates the velocity and scales
    the sides. Sides are not rotated: an upright object's box would grow with every roll and never shrink
    back.

    Args:
        turn: (3, 3), directions in the earlier optical frame into the later one.

    Returns:
        The boxes, and (N,) whether each can still be in view; boxes out of view are unchanged.
    """
    if not len(states):
        return states, np.ones(0, np.bool_)
    rays = camera.rays(states.mean[:, :2])
    rotated = rays @ turn.T
    moved = camera.project(rotated)
    # NaN: the lens has no ray for the pixel, or does not see the direction any more.
    ahead: NDArray[np.bool_] = (rotated[:, 2] > MIN_COSINE) & np.isfinite(moved).all(axis=1)
    # (N, 2, 2) derivative of the new pixel by the old one; lens distortion is neglected.
    focal = np.array([camera.fx, camera.fy])
    depth = np.where(ahead, rotated[:, 2], 1.0)[:, None, None]
    plane = rotated[:, :2, None] / depth
    slope = (turn[:2, :2] - plane * turn[2, :2]) * (rays[:, 2, None, None] / depth)
    slope *= focal[:, None] / focal
    slope[~ahead] = np.eye(2)
    # Polar decomposition: an image rotation by `roll` after a stretch; a side scales by the stretch.
    roll = np.arctan2(slope[:, 1, 0] - slope[:, 0, 1], slope[:, 0, 0] + slope[:, 1, 1])
    cosine, sine = np.cos(roll), np.sin(roll)
    step = np.zeros((len(states), 8, 8))
    step[:, 0:2, 0:2] = step[:, 4:6, 4:6] = slope
    step[:, 2, 2] = step[:, 6, 6] = cosine * slope[:, 0, 0] + sine * slope[:, 1, 0]
    step[:, 3, 3] = step[:, 7, 7] = cosine * slope[:, 1, 1] - sine * slope[:, 0, 1]
    mean = (step @ states.mean[:, :, None])[:, :, 0]
    mean[:, :2] = np.where(ahead[:, None], moved, states.mean[:, :2])
    return BoxStates(mean, step @ states.covariance @ step.transpose(0, 2, 1)), ahead


class AttitudeHistory:
    """The attitudes of the last few seconds. Thread-safe for one writer and one reader."""

    def __init__(self, keep_s: float = HISTORY_S) -> None:
        self._keep_ns = keep_s * 1e9
        self._lock = threading.Lock()
        self._samples: deque[tuple[int, Quaternion]] = deque()

    def add(self, stamp_ns: int, attitude_wxyz: Quaternion) -> None:
        """Add a sample: body FRD to NED, CLOCK_MONOTONIC nanoseconds. Older than the newest: ignored."""
        with self._lock:
            if self._samples and stamp_ns <= self._samples[-1][0]:
                return
            self._samples.append((stamp_ns, attitude_wxyz))
            while stamp_ns - self._samples[0][0] > self._keep_ns:
                self._samples.popleft()

    def at(self, stamp_ns: int) -> Array | None:
        """(3, 3) `ned_from_body` at `stamp_ns`, by slerp; None outside the history."""
        with self._lock:
            samples = list(self._samples)
        index = bisect_right(samples, stamp_ns, key=lambda sample: sample[0])
        if index == 0:
            return None
        if samples[index - 1][0] == stamp_ns:
            return matrix_from_quaternion(samples[index - 1][1])
        if index == len(samples):
            if stamp_ns - samples[-1][0] > MAX_AHEAD_S * 1e9:
                return None
            return self._extrapolate(samples, stamp_ns)
        (before_ns, before), (after_ns, after) = samples[index - 1], samples[index]
        if after_ns - before_ns > MAX_GAP_S * 1e9:
            return None
        return _between(before, before_ns, after, after_ns, stamp_ns)

    @staticmethod
    def _extrapolate(samples: list[tuple[int, Quaternion]], stamp_ns: int) -> Array | None:
        """Continue at the rate averaged over a longer interval: two adjacent samples are too noisy."""
        after_ns, after = samples[-1]
        for before_ns, before in reversed(samples[:-1]):
            if after_ns - before_ns > MAX_GAP_S * 1e9:
                return None
            if after_ns - before_ns >= MAX_AHEAD_S / 2 * 1e9:
                return _between(before, before_ns, after, after_ns, stamp_ns)
        return None


def _between(before: Quaternion, before_ns: int, after: Quaternion, after_ns: int, stamp_ns: int) -> Array:
    return matrix_from_quaternion(slerp(before, after, (stamp_ns - before_ns) / (after_ns - before_ns)))
