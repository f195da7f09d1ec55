"""A target: a detection with its direction and, if the range is known, its position in local NED."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from companion.vehicle.state import Vector3
from vision.geolocation import position_covariance

# The reason when no seen object was trusted.
DOUBTED = "target not confirmed (score < tracker.confirm_score) or class ambiguous"
UNCONFIRMED_MARKER = "not confirmed: detected in too few frames in a row"


def marker_name(identifier: int) -> str:
    """The class name of a printed marker."""
    return f"marker {identifier}"


class RangeSource(StrEnum):
    """Source of a target's range."""

    DEPTH = "depth"
    GROUND_PLANE = "ground_plane"
    KNOWN_HEIGHT = "known_height"
    MARKER = "marker"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Target:
    """One detected object.

    Attributes:
        class_name, confidence: from the detector, of this frame.
        captured_ns: CLOCK_MONOTONIC stamp of the frame.
        bearing_rad: direction of the object's middle, clockwise from north, -π..π (attitude removed): with
            depth that between its ends, else the box's centre.
        elevation_rad: above the horizon, positive up.
        ground_range_m: horizontal, from the vehicle to the object's nearest surface; NaN when unknown. At the
            capture time, like all fields: for the range now use `position_ned_m` and the current position.
        range_source: source of `ground_range_m`.
        position_ned_m: local NED; None when the range is unknown. `ground_range_m` away in the direction
            `bearing_rad`, or of its foot if the range comes from the ground or the class's height: the
            nearest point itself jumps between the corners of a turning object.
        box_xyxy: pixels, as detected.
        track_id: constant from frame to frame; None without a track.
        track_score: median confidence over the track; None without a track.
        trusted: it may be selected as a goal: its track is confirmed, or tracking is off; and its class is
            not ambiguous, neither in this frame nor over its track.
        depth_m: along the camera's optical axis to the nearest surface; NaN without a depth image.
        distance_m: straight line from the vehicle to a point at `ground_range_m`; NaN when the range is
            unknown. Which point: by depth, of the surface, at the height of the nearest one; by the ground
            plane, of the ground below the nearest surface; by the class's height, the object's foot; the
            marker's centre.
        depth_sigma_m, distance_sigma_m: one sigma of `depth_m` and of `distance_m`; NaN: not stated, as for
            a marker.
        cut: the image's left, right or lower edge may cut the object off, so the box's centre is not the
            object's. cut_above: the upper edge may.
        range_sigma_m: one sigma of `ground_range_m`; NaN: not stated.
        across_sigma_m: the same across the line of sight, horizontal.
        vehicle_sigma_m: one sigma of the vehicle's own horizontal position, on each axis, common to all of
            its targets and not part of the two above.
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
    cut: bool = False
    cut_above: bool = False
    range_sigma_m: float = math.nan
    across_sigma_m: float = math.nan
    vehicle_sigma_m: float = 0.0
    depth_sigma_m: float = math.nan
    distance_sigma_m: float = math.nan

    @property
    def position_covariance(self) -> NDArray[np.float64] | None:
        """(2, 2) covariance, m², of the horizontal position, without the vehicle's own; None: unknown."""
        if self.position_ned_m is None or not math.isfinite(self.range_sigma_m + self.across_sigma_m):
            return None
        return position_covariance(self.bearing_rad, self.range_sigma_m, self.across_sigma_m)

    @property
    def score(self) -> float:
        """`track_score` of a tracked object, else `confidence`; 0..1."""
        return self.confidence if self.track_score is None else self.track_score
