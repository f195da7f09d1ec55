"""The position of each confirmed track, fused over its detections, with its error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.guidance.targets.estimate import Estimate
from companion.guidance.targets.target import Target
from companion.vehicle.state import Vector3
from vision.geolocation import ErrorEllipse

# An object moves if its estimated speed exceeds this and so many sigma. Errors of the range of a vehicle that
# flies towards a standing object show as some tenths of its own speed.
MOVING_MPS, MOVING_SIGMA = 1.0, 3.0
# Older detections count less, by this time constant: an object slower than `MOVING_MPS` may still move.
MEMORY_S = 5.0
# A detection this many sigma from the fused position shows that the object has moved: the fusion restarts.
RESTART_SIGMA = 3.0
# A detection this many sigma from where the object was expected is left out: it may have the range of another
# object in front. So many in a row that fit each other as well show that the object was moved.
OUTLIER_SIGMA, OUTLIERS = 5.0, 3
# A box at the image's upper edge shows a part of an object if it is lower than this share of the newest box
# that the edge did not cut off: of an object that leaves at the top, half of its width may be detected last.
PART = 0.5
# Without a position for this long an object may be anywhere, although its boxes are still detected.
STALE_S = MEMORY_S / 2.0
# A track that was not seen for this long has ended (`tracker.max_age_s` is less by default).
FORGET_S = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class FusedPosition:
    """The position of one track.

    Attributes:
        position_ned_m: local NED.
        ellipse: its horizontal error, the vehicle's own position error included.
        moving: whether the object moves; then the position is that of the requested time.
        captured_ns: capture of the newest detection with a position.
    """

    position_ned_m: Vector3
    ellipse: ErrorEllipse
    moving: bool
    captured_ns: int


class _Track:
    """Of a standing object, detections weighted by their information; of a moving one, a filter's estimate.

    Most errors of two frames have one cause: attitude, height, the object's size. Covariance intersection
    with equal weights (Julier & Uhlmann 1997) holds for any correlation: the covariance is the inverse of the
    mean information, and the position is the one that independent errors would give. Slow motion leaves the
    position behind the object, so detections are forgotten, and one that disagrees restarts the fusion.
    """

    def __init__(self, target: Target, vehicle: Vector3, covariance: NDArray[np.float64]) -> None:
        self._whole_height = 0.0
        self._begin(target, vehicle, covariance)

    def _begin(self, target: Target, vehicle: Vector3, covariance: NDArray[np.float64]) -> None:
        self._motion = Estimate.initialize(target, vehicle)
        self._outliers: list[tuple[Target, Vector3]] = []
        self._restart()
        self._add(target, covariance)

    def update(self, target: Target, vehicle: Vector3, covariance: NDArray[np.float64]) -> None:
        if target.cut_above and _height(target) < PART * self._whole_height:
            return  # the middle of a small part is not the object's
        expected = self._motion.at(target.captured_ns)
        fit = expected.fit(target, vehicle)
        if fit.squared > OUTLIER_SIGMA**2:
            self._leave_out(target, vehicle, covariance)
            return
        self._outliers = []
        self._motion = expected.update(fit)
        if self.moving or self._disagrees(target, covariance):
            self._restart()
        self._forget((target.captured_ns - self._newest.captured_ns) / 1e9)
        self._add(target, covariance)

    def _leave_out(self, target: Target, vehicle: Vector3, covariance: NDArray[np.float64]) -> None:
        """Restart at the last of enough outliers that fit each other, with their spread as an error."""
        for other, from_ned_m in self._outliers:
            expected = Estimate.initialize(other, from_ned_m).at(target.captured_ns)
            if expected.fit(target, vehicle).squared > OUTLIER_SIGMA**2:
                self._outliers = []
                break
        self._outliers.append((target, vehicle))
        if len(self._outliers) == OUTLIERS:
            places = [other.position_ned_m[:2] for other, _ in self._outliers if other.position_ned_m]
            spread = np.cov(places, rowvar=False)
            self._begin(target, vehicle, covariance + spread)
            self._motion.covariance[:2, :2] += spread

    @property
    def moving(self) -> bool:
        speed_sigma_mps = math.sqrt(float(np.trace(self._motion.covariance[2:, 2:])))
        return math.hypot(*self._motion.velocity) > max(MOVING_MPS, MOVING_SIGMA * speed_sigma_mps)

    def position(self, at_ns: int) -> FusedPosition:
        """The position at this time; its error grows since the newest detection as the filter's does."""
        moving, newest = self.moving, self._newest
        place, covariance = self._fused()
        motion = self._motion.at(at_ns)
        covariance += (motion.covariance - self._motion.covariance)[:2, :2]
        if moving:
            place = motion.state[:2]
        else:
            # How far the newest detections are from the fused position is part of its error.
            behind = self._motion.state[:2] - place
            covariance += np.outer(behind, behind)
        covariance += np.eye(2) * newest.vehicle_sigma_m**2
        down = self._weighted_down / self._weight
        return FusedPosition(
            (float(place[0]), float(place[1]), down),
            ErrorEllipse.of(covariance),
            moving,
            newest.captured_ns,
        )

    @property
    def captured_ns(self) -> int:
        return self._newest.captured_ns

    @property
    def cut(self) -> bool:
        return self._newest.cut

    def _fused(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position and covariance of the mean information."""
        covariance = np.asarray(np.linalg.inv(self._information / self._count), np.float64)
        return covariance @ (self._weighted / self._count), covariance

    def _disagrees(self, target: Target, covariance: NDArray[np.float64]) -> bool:
        assert target.position_ned_m is not None
        place, fused = self._fused()
        away = np.array(target.position_ned_m[:2]) - place
        return float(away @ np.linalg.solve(fused + covariance, away)) > RESTART_SIGMA**2

    def _restart(self) -> None:
        self._information, self._weighted = np.zeros((2, 2)), np.zeros(2)
        self._weight = self._weighted_down = self._count = 0.0

    def _forget(self, elapsed_s: float) -> None:
        kept = math.exp(-elapsed_s / MEMORY_S)
        self._information, self._weighted = self._information * kept, self._weighted * kept
        self._weight, self._weighted_down = self._weight * kept, self._weighted_down * kept
        self._count *= kept

    def _add(self, target: Target, covariance: NDArray[np.float64]) -> None:
        assert target.position_ned_m is not None
        north, east, down = target.position_ned_m
        information = np.linalg.inv(covariance)
        self._information += information
        self._weighted += information @ (north, east)
        weight = float(np.trace(information))
        self._weight += weight
        self._weighted_down += weight * down
        self._count += 1
        self._newest = target
        if not target.cut_above:
            self._whole_height = _height(target)


def _height(target: Target) -> float:
    """Of its box, in pixels at a range of 1 m, so that it is the same from near and far."""
    _, top, _, bottom = target.box_xyxy
    return (bottom - top) * target.ground_range_m


class FusedTracks:
    """The fused positions of one camera's confirmed tracks."""

    def __init__(self) -> None:
        self._tracks: dict[int, _Track] = {}

    def update(self, targets: Sequence[Target], vehicle: Vector3, now_ns: int) -> None:
        """Add the targets of one frame.

        Where the image's edge cuts a box off, an object seems to move: the position of such a target is only
        used until the object is seen whole.

        Args:
            vehicle: its position at the capture, local NED.
            now_ns: the capture.
        """
        for target in targets:
            covariance = target.position_covariance
            if covariance is None or target.track_id is None or not target.trusted:
                continue
            track = self._tracks.get(target.track_id)
            if track is None or (track.cut and not target.cut):
                self._tracks[target.track_id] = _Track(target, vehicle, covariance)
            elif target.captured_ns > track.captured_ns and not target.cut:
                track.update(target, vehicle, covariance)
        ended = [key for key, track in self._tracks.items() if now_ns - track.captured_ns > FORGET_S * 1e9]
        for key in ended:
            del self._tracks[key]

    def position(self, track_id: int, seen_ns: int) -> FusedPosition | None:
        """The position of a track when it was last detected, with or without a position then.

        Returns:
            None: it never had a position, or the newest one is older than that by more than `STALE_S`.
        """
        track = self._tracks.get(track_id)
        if track is None:
            return None
        at_ns = max(seen_ns, track.captured_ns)
        return track.position(at_ns) if at_ns - track.captured_ns <= STALE_S * 1e9 else None
