"""A target: a detection turned into a direction and, where possible, a place in the level world frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from companion.vehicle.state import Vector3

# What to say when only doubtful objects were seen.
DOUBTED = "what was seen does not count as true (tracker.confirm_score), or may be of another class"


class RangeSource(StrEnum):
    """Where a target's range comes from."""

    DEPTH = "depth"
    GROUND_PLANE = "ground_plane"
    KNOWN_HEIGHT = "known_height"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Target:
    """One seen object.

    Attributes:
        class_name, confidence: as the detector says, of this frame.
        captured_ns: CLOCK_MONOTONIC stamp of the frame.
        bearing_rad: direction of the box's centre, clockwise from north, -π..π (attitude removed).
        elevation_rad: above the horizon, positive up.
        ground_range_m: horizontal, from the vehicle to the object's nearest surface; NaN when unknown. At the
            capture, as everything here: for the range now, use `position_ned_m` and where the vehicle is now.
        range_source: where that comes from.
        position_ned_m: local NED; None when the range is unknown. `ground_range_m` away in the direction of
            the box's centre, or of its foot if the range comes from the ground or the class's height: the
            nearest point itself jumps between the corners of an object that turns.
        box_xyxy: pixels, as detected.
        track_id: of the object, the same from frame to frame; None without a track.
        track_score: median confidence over the track; None without a track.
        trusted: it may be chosen to be flown to: its track counts as true, or nobody looks for tracks; and it
            is not as likely of another class, neither in this frame nor over its track.
        depth_m: along the camera's optical axis to the nearest surface; NaN without a depth image.
        distance_m: straight from the vehicle to the nearest surface; NaN when the range is unknown.
        range_sigma_m: of `ground_range_m`, one sigma; NaN: not stated.
    """

    class_name: str
    confidence: float
    captured_ns: int
    bearing_rad: float
    elevation_rad: float
    ground_range_m: float = math.nan
    range_source: RangeSource = RangeSource.NONE
    position_ned_m: Vector3 | None = None
    box_xyxy: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    track_id: int | None = None
    track_score: float | None = None
    trusted: bool = True
    depth_m: float = math.nan
    distance_m: float = math.nan
    range_sigma_m: float = math.nan

    @property
    def score(self) -> float:
        """How sure it is, 0..1: of a followed object over its history, else in this frame."""
        return self.confidence if self.track_score is None else self.track_score
