"""An object as it is flown to, published, drawn and recorded; and what a command calls it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.guidance.objects.position_filter import STALE_S, largest_sigma, predicted_covariance
from companion.guidance.objects.target import (
    DOUBTED,
    UNCONFIRMED_MARKER,
    RangeSource,
    Target,
    marker_name,
)
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.state import Vector3
from vision.geolocation import ErrorEllipse

# How long a drift of the vehicle's estimate, in which objects are located, lasts unseen.
DRIFT_S = 0.6
# An object that is ambiguous in this share of its frames is not chosen; found is one seen in so many frames.
MOST_DOUBT, FOUND_FRAMES = 0.5, 3


@dataclass(frozen=True, slots=True)
class TrackedObject:
    """One object at the capture of its newest detection. Local NED, metres, CLOCK_MONOTONIC nanoseconds.

    Attributes:
        object_id: stays the same while the image tracker changes its ids.
        track_ids: the image tracker's ids that it had, the newest last; empty without a tracker.
        class_name: from the detector.
        position_ned_m: None without a range so far. Of a standing object it is fused over its detections.
        velocity_ned_mps: north and east, also where the object does not count as `moving`.
        covariance: (4, 4) of north, east and their velocities, the vehicle's own position error included.
        moving: its estimated speed is more than its error explains.
        located_ns: capture of the newest detection that showed all of it with a range; 0: none.
        first_ns, last_ns: capture of its first and its newest detection.
        confirmed: it may be selected as a goal (`Target.trusted`), in this frame or in one before.
        ambiguous: its newest detection may be of another class, or two detections fit it equally.
        frames: number of its detections.
        doubt: share of its detections since it was first confirmed in which it was ambiguous, 0..1.
        occluded: it is not in the newest frame.
        detection: its newest detection.

    >>> from companion import ObjectTable, TrackedObject
    >>> from companion.guidance.objects.target import Target
    >>> seen = Target("car", 0.9, 0, 0.0, -0.2, 10.0, position_ned_m=(10.0, 0.0, 0.0), track_id=3)
    >>> [car] = ObjectTable().update([seen], (0.0, 0.0, -2.0), seen.captured_ns)
    >>> isinstance(car, TrackedObject), car.track_ids, car.position_at(500_000_000), car.unseen_s(500_000_000)
    (True, (3,), (10.0, 0.0, 0.0), 0.5)
    """

    object_id: int
    track_ids: tuple[int, ...]
    class_name: str
    position_ned_m: Vector3 | None
    velocity_ned_mps: tuple[float, float]
    covariance: tuple[tuple[float, ...], ...]
    moving: bool
    located_ns: int
    first_ns: int
    last_ns: int
    confirmed: bool
    ambiguous: bool
    frames: int
    doubt: float
    occluded: bool
    detection: Target

    @property
    def track_id(self) -> int | None:
        """The image tracker's id of the object now; None without one."""
        return self.track_ids[-1] if self.track_ids else None

    @property
    def range_source(self) -> RangeSource:
        """Of the newest detection."""
        return self.detection.range_source

    @property
    def speed_sigma_mps(self) -> float:
        """One sigma of the velocity along the longer axis of its ellipse."""
        return largest_sigma(np.array(self.covariance)[2:, 2:])

    @property
    def certain(self) -> bool:
        """Whether it counts as found: confirmed, and of its class now and in most of its frames."""
        sure = self.confirmed and not self.ambiguous and self.doubt < MOST_DOUBT
        return sure and self.frames >= FOUND_FRAMES

    def unseen_s(self, now_ns: int) -> float:
        """How long ago it was detected."""
        return max(0.0, (now_ns - self.last_ns) / 1e9)

    def located(self, now_ns: int) -> bool:
        """Whether its position is not older than its newest detection by more than `STALE_S`.

        Args:
            now_ns: of that detection, if it is newer than those of the object.
        """
        newest_ns = max(now_ns, self.last_ns)
        return self.position_ned_m is not None and newest_ns - self.located_ns <= STALE_S * 1e9

    def position_at(self, now_ns: int) -> Vector3:
        """Where it is expected: a moving object goes on, and a marker for `DRIFT_S` with the estimate.

        Raises ValueError without a position.
        """
        if self.position_ned_m is None:
            raise ValueError(f"object {self.object_id}, a {self.class_name}, has no known range")
        north, east, down = self.position_ned_m
        north_mps, east_mps = self.velocity_ned_mps
        ahead_s = self.unseen_s(now_ns)
        if not self.moving:
            ahead_s = min(ahead_s, self._drift_s)
        return (north + ahead_s * north_mps, east + ahead_s * east_mps, down)

    def velocity_at(self, now_ns: int) -> tuple[float, float]:
        """Of `position_at`, north and east."""
        goes_on = self.moving or self.unseen_s(now_ns) < self._drift_s
        return self.velocity_ned_mps if goes_on else (0.0, 0.0)

    @property
    def _drift_s(self) -> float:
        """How long a standing object goes on unseen: only of a marker is the velocity known well enough."""
        return DRIFT_S if self.range_source is RangeSource.MARKER else 0.0

    def ellipse_at(self, now_ns: int) -> ErrorEllipse:
        """The horizontal error of `position_at`."""
        unseen_s = self.unseen_s(now_ns)
        covariance = predicted_covariance(np.array(self.covariance), unseen_s, self.range_source)
        return ErrorEllipse.of(covariance[:2, :2])


@dataclass(frozen=True, slots=True)
class Subject:
    """What a command is about: an object of a class, that of one track, or one printed marker.

    A field `subject: Subject` of a command gives it the arguments `class`, `track` and `marker`;
    `context.objects.of(subject)` is the object. Raises ValueError unless exactly one of them is given.

    >>> from companion import Subject
    >>> Subject("car").phrase, Subject(track_id=17).phrase, Subject(marker_id=7).phrase
    ('the car', 'track 17', 'marker 7')
    """

    class_name: str = ""
    track_id: int | None = None
    marker_id: int | None = None

    def __post_init__(self) -> None:
        given = (bool(self.class_name), self.track_id is not None, self.marker_id is not None)
        if sum(given) != 1:
            raise ValueError(
                "expected one of class, track and marker, got "
                f"{self.class_name!r}, {self.track_id} and {self.marker_id}"
            )

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes that the detector must know."""
        return (self.class_name,) if self.class_name else ()

    @property
    def name(self) -> str:
        """`car`, `track 17`, or `marker 7`."""
        if self.marker_id is not None:
            return marker_name(self.marker_id)
        return self.class_name or f"track {self.track_id}"

    @property
    def phrase(self) -> str:
        """`the car`, `track 17`, or `marker 7`."""
        return f"the {self.class_name}" if self.class_name else self.name

    def phrase_now(self, track_id: int | None) -> str:
        """`phrase` with the id that the object has now: `track 31 (was 20)`."""
        if self.track_id is None or track_id in (None, self.track_id):
            return self.phrase
        return f"track {track_id} (was {self.track_id})"

    def means(self, seen: TrackedObject) -> bool:
        """Whether an object is one of these; a track also by an id that it had before."""
        if self.track_id is not None:
            return self.track_id in seen.track_ids
        return seen.class_name == (self.class_name or self.name)

    @property
    def doubted(self) -> str:
        """The reason when it was seen and never confirmed."""
        return DOUBTED if self.marker_id is None else UNCONFIRMED_MARKER


@dataclass(frozen=True, slots=True)
class GlobalPoint:
    """A place to point the gimbal at: WGS 84, and metres above home."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0


# Where to point the gimbal: a direction, an object, or a place.
GimbalGoal = GimbalAim | Subject | GlobalPoint
