"""Association of detections with one standing object.

The ellipse of the innovation gates detections (Mahalanobis distance). Track ids of the image tracker have
priority: an object that was seen beside this one is never associated with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.guidance.targets.estimate import BEARING_SIGMA_RAD, Estimate
from companion.guidance.targets.target import Target
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle
from vision.tracking.association import overlaps

# χ² with two degrees of freedom, 99.9 %.
GATE = 13.8
# Two boxes of a frame that overlap by this IoU may be of one object: the detector finds some of them twice.
ONE_OBJECT_IOU = 0.5


class ObjectTrack:
    """Filtered position of one object, initialized from a target with a known position."""

    def __init__(self, target: Target, vehicle: Vector3) -> None:
        self._estimate = Estimate.initialize(target, vehicle, moving=False)
        self._class_name = target.class_name
        self._ranged = self._newest = target
        self._track_id = target.track_id
        self._others: set[int] = set()
        self.confidence = target.confidence

    @property
    def captured_ns(self) -> int:
        """Capture stamp of the newest detection of this object."""
        return self._estimate.captured_ns

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
        assert self._ranged.position_ned_m is not None
        north, east = self._estimate.state[:2]
        return (float(north), float(east), self._ranged.position_ned_m[2])

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
        fresh = [t for t in targets if t.class_name == self._class_name and t.captured_ns > self.captured_ns]
        fresh = self._same_identity(fresh)
        if not fresh:
            return False
        expected = self._estimate.at(fresh[0].captured_ns)
        best = min((expected.fit(target, vehicle) for target in fresh), key=lambda fit: fit.squared)
        if best.squared > GATE:
            return False
        self._estimate, self._newest = expected.update(best), best.target
        self.confidence = self._newest.confidence
        if self._newest.position_ned_m is not None:
            self._ranged = self._newest
        if self._newest.track_id is not None:
            self._track_id = self._newest.track_id
        return True

    def _same_identity(self, targets: list[Target]) -> list[Target]:
        """Candidates: targets with the object's track id, else trusted ones with an unknown id."""
        own = [t for t in targets if t.track_id is not None and t.track_id == self._track_id]
        if own:
            self._others |= {
                t.track_id
                for t in targets
                if t.track_id not in (None, self._track_id) and _are_apart(t, own[0])
            }
            return own
        return [t for t in targets if t.trusted and not self.is_another(t)]


def _are_apart(one: Target, other: Target) -> bool:
    """Whether two targets of a frame are two objects, and not two boxes on the same."""
    if abs(wrap_angle(one.bearing_rad - other.bearing_rad)) <= BEARING_SIGMA_RAD:
        return False
    return bool(overlaps(np.array([one.box_xyxy]), np.array([other.box_xyxy]))[0, 0] < ONE_OBJECT_IOU)
