"""What a command is about: an object of a class, exactly one track, or a printed marker."""

from __future__ import annotations

from dataclasses import dataclass

from companion.guidance.objects.from_markers import marker_name
from companion.guidance.objects.target import DOUBTED, UNCONFIRMED_MARKER
from companion.guidance.objects.tracked_object import TrackedObject
from companion.vehicle.gimbal import GimbalAim


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
