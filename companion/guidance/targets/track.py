"""Tracking of one object on the ground plane: a Kalman filter on its position, and data association.

The state is a position in local NED (north, east) with random-walk noise. A measurement is a bearing and, if
known, a range; its noise is an ellipse along the line of sight, so a bearing alone corrects only across it.
The same ellipse gates detections (Mahalanobis distance). Track ids of the image tracker have priority: an
object that was seen beside this one is never associated with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from companion.guidance.targets.target import RangeSource, Target
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle
from vision.geolocation import position_covariance

# Random walk of an object: 1 m in 1 s, one sigma, a walking person's pace.
RANDOM_WALK_M2_PER_S = 1.0
# Noise of one measurement across the line of sight, one sigma: a few pixels and a degree of attitude.
BEARING_SIGMA_RAD = 0.03
ACROSS_SIGMA_M = 0.25
# Along the line of sight, for targets without their own sigma: fixed, and per metre of range.
UNSTATED_SIGMA = (0.3, 0.12)
UNKNOWN_RANGE_SIGMA_M = 1e3
# χ² with two degrees of freedom, 99.9 %.
GATE = 13.8
NEAREST_M = 0.3


class ObjectTrack:
    """Filtered position of one object, initialized from a target with a known position."""

    def __init__(self, target: Target, vehicle: Vector3) -> None:
        if target.position_ned_m is None:
            raise ValueError(f"cannot initialize a track: {target.class_name!r} has no range")
        self._class_name = target.class_name
        self._position = np.array(target.position_ned_m[:2], np.float64)
        self._down_m = target.position_ned_m[2]
        self._covariance = measurement_noise(target, self._position - vehicle[:2])
        self._captured_ns = target.captured_ns
        self._newest = target
        self._track_id = target.track_id
        self._others: set[int] = set()
        self.confidence = target.confidence

    @property
    def captured_ns(self) -> int:
        """Capture stamp of the newest detection of this object."""
        return self._captured_ns

    @property
    def newest(self) -> Target:
        """The newest detection of this object."""
        return self._newest

    @property
    def track_id(self) -> int | None:
        """The image tracker's id of the object; None without one."""
        return self._track_id

    @property
    def position_ned_m(self) -> Vector3:
        """Local NED; down is that of the newest measurement."""
        return (float(self._position[0]), float(self._position[1]), self._down_m)

    def is_another(self, target: Target) -> bool:
        """Whether this was seen beside the object, so that it is a different one."""
        return target.track_id in self._others

    def restart(self, target: Target, vehicle: Vector3) -> ObjectTrack:
        """A new track of the same object, initialized at a target."""
        track = ObjectTrack(target, vehicle)
        track._others = self._others
        return track

    def update(self, targets: Sequence[Target], vehicle: Vector3) -> bool:
        """Associate a detection with this object, if any. True: there was a new one.

        Args:
            targets: of one frame (their stamps equal); a frame already seen changes nothing.
            vehicle: the vehicle's position, local NED.
        """
        fresh = [t for t in targets if t.class_name == self._class_name and t.captured_ns > self._captured_ns]
        if not fresh:
            return False
        fresh = self._same_identity(fresh)
        if not fresh:
            return False
        elapsed_s = (fresh[0].captured_ns - self._captured_ns) / 1e9
        predicted = self._covariance + np.eye(2) * RANDOM_WALK_M2_PER_S * elapsed_s
        best: tuple[float, Target, NDArray[np.float64], NDArray[np.float64]] | None = None
        for target in fresh:
            innovation, noise = self._innovation(target, vehicle)
            spread = predicted + noise
            squared = float(innovation @ np.linalg.solve(spread, innovation))
            if squared <= GATE and (best is None or squared < best[0]):
                best = (squared, target, innovation, spread)
        if best is None:
            return False
        _, target, innovation, spread = best
        gain = np.linalg.solve(spread, predicted).T
        self._position = self._position + gain @ innovation
        kept = (np.eye(2) - gain) @ predicted
        self._covariance = (kept + kept.T) / 2
        if target.position_ned_m is not None:
            self._down_m = target.position_ned_m[2]
        self._captured_ns, self.confidence = target.captured_ns, target.confidence
        self._newest = target
        if target.track_id is not None:
            self._track_id = target.track_id
        return True

    def _same_identity(self, targets: list[Target]) -> list[Target]:
        """Candidates: targets with the object's track id, else trusted ones with an unknown id."""
        own = [t for t in targets if t.track_id is not None and t.track_id == self._track_id]
        if own:
            # A second box on the object itself is not another object.
            self._others |= {
                t.track_id
                for t in targets
                if t.track_id not in (None, self._track_id)
                and abs(wrap_angle(t.bearing_rad - own[0].bearing_rad)) > BEARING_SIGMA_RAD
            }
            return own
        return [t for t in targets if t.trusted and not self.is_another(t)]

    def _innovation(
        self, target: Target, vehicle: Vector3
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if target.position_ned_m is not None:
            measured = np.array(target.position_ned_m[:2])
        else:
            # Bearing alone: a position in that direction at the estimated range.
            range_m = max(NEAREST_M, float(np.hypot(*(self._position - vehicle[:2]))))
            direction = np.array([math.cos(target.bearing_rad), math.sin(target.bearing_rad)])
            measured = np.array(vehicle[:2]) + direction * range_m
        return measured - self._position, measurement_noise(target, measured - vehicle[:2])


def measurement_noise(target: Target, line_of_sight: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 2) covariance of a measured position, given the vector from the vehicle to it."""
    range_m = max(NEAREST_M, float(np.hypot(*line_of_sight)))
    if target.range_source is RangeSource.NONE:
        sigma_along = UNKNOWN_RANGE_SIGMA_M
    elif math.isfinite(target.range_sigma_m):
        sigma_along = target.range_sigma_m
    else:
        sigma_along = math.hypot(UNSTATED_SIGMA[0], UNSTATED_SIGMA[1] * range_m)
    sigma_across = math.hypot(ACROSS_SIGMA_M, BEARING_SIGMA_RAD * range_m)
    bearing_rad = math.atan2(line_of_sight[1], line_of_sight[0])
    return position_covariance(bearing_rad, sigma_along, sigma_across)
