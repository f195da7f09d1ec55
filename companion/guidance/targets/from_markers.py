"""From markers to places: a marker before the camera becomes a place in local NED, and its pad with it.

As with detections, attitude and position are those of the moment of capture (`targets.StateHistory`), so a
vehicle that banks does not swing its marker.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.guidance.targets.from_detections import Pose, StateHistory, mount_at
from companion.vehicle.state import Vector3
from vision.camera_model import CameraModel, CameraMount
from vision.markers import Marker, MarkerPose, PadMarker

# Two poses that fit so alike (see `Marker.ambiguity`) are told apart by what is known of pads: level.
AMBIGUOUS = 0.25
# Straight down must be this far inside the picture, as a share of it, for a camera to follow a marker down.
DOWN_MARGIN = 0.08


@dataclass(frozen=True, slots=True)
class MarkerTarget:
    """One marker, seen once.

    Attributes:
        identifier: in its dictionary. pad: the marker whose pad it lies on, its own unless settings say else.
        captured_ns: CLOCK_MONOTONIC stamp of the frame.
        bearing_rad: clockwise from north, -π..π. elevation_rad: above the horizon. Both from the vehicle.
        distance_m: straight from the vehicle. ground_range_m: over ground.
        position_ned_m: of its centre, local NED. pad_ned_m: of its pad's centre.
        pad_offset_frd_m: from the vehicle to the pad's centre in the body frame of that moment.
        heading_rad: where its upper edge points, clockwise from north.
        size_m, side_px: its side, and how long that is in the picture. reprojection_px: how well it fits.
    """

    identifier: int
    pad: int
    captured_ns: int
    bearing_rad: float
    elevation_rad: float
    distance_m: float
    ground_range_m: float
    position_ned_m: Vector3
    pad_ned_m: Vector3
    pad_offset_frd_m: Vector3
    heading_rad: float
    size_m: float
    side_px: float
    reprojection_px: float


@dataclass(frozen=True, slots=True)
class MarkerSight:
    """What is seen of markers now.

    Attributes:
        targets: of the newest frame; empty when nothing is seen or it is too old to steer by.
        captured_ns: of that frame; 0: none ever came.
        age_s: since then; None: none ever came.
        fresh: that is within the declared maximum.
        missing: what is missing before markers can be landed on; empty if nothing is.
    """

    targets: tuple[MarkerTarget, ...] = ()
    captured_ns: int = 0
    age_s: float | None = None
    fresh: bool = False
    missing: str = "perception that looks for markers (markers.dictionary is not set)"

    def unavailable(self, gap_s: float) -> str | None:
        """What is missing, in words; None: nothing is. A camera may be late by `gap_s`."""
        if self.missing:
            return self.missing
        if self.age_s is None:
            return "a camera that looks for markers (nothing came from it yet)"
        if not self.fresh and self.age_s > gap_s:
            return f"a camera that looks for markers (its newest frame is {self.age_s:.1f} s old)"
        return None


NO_MARKERS = MarkerSight()


def marker_targets(
    markers: Sequence[Marker],
    captured_ns: int,
    mount: CameraMount,
    history: StateHistory,
    on_pads: Mapping[int, PadMarker],
) -> tuple[MarkerTarget, ...]:
    """Where the markers of one frame are, in their order.

    Args:
        on_pads: those that lie on another's pad, by their own id.

    Raises:
        HistoryError: the vehicle's pose at `captured_ns`, or where its gimbal looked then, is not known.
    """
    if not markers:
        return ()
    pose, mount = history.at(captured_ns), mount_at(mount, history, captured_ns)
    return tuple(_target(marker, captured_ns, mount, pose, on_pads) for marker in markers)


def looks_down(camera: CameraModel, mount: CameraMount) -> bool:
    """Whether what is straight below a level vehicle is well inside the picture.

    A camera on a gimbal must be told how it was held (`mount_at`).
    """
    below = mount.ned_from_optical(np.eye(3)).T @ np.array([0.0, 0.0, 1.0])
    column, row = camera.project(below.reshape(1, 3))[0]
    wide, high = camera.width * DOWN_MARGIN, camera.height * DOWN_MARGIN
    # NaN, which is behind the camera, fails both comparisons.
    return bool(wide <= column <= camera.width - wide and high <= row <= camera.height - high)


def _target(
    marker: Marker, captured_ns: int, mount: CameraMount, pose: Pose, on_pads: Mapping[int, PadMarker]
) -> MarkerTarget:
    ned_from_optical = mount.ned_from_optical(pose.ned_from_body)
    place, rotation = marker.position_camera_m, marker.rotation
    if marker.other is not None and marker.ambiguity > AMBIGUOUS:
        # The one whose face looks up more: NED, so up is -z.
        both = (MarkerPose(place, rotation, marker.reprojection_px), marker.other)
        level = min(both, key=lambda fit: (ned_from_optical @ fit.rotation)[2, 2])
        place, rotation = level.position_camera_m, level.rotation
    offset = ned_from_optical @ place + pose.ned_from_body @ mount.position_frd_m
    heading_rad = _heading(ned_from_optical @ rotation)
    on_pad = on_pads.get(marker.identifier)
    pad_offset = offset
    if on_pad is not None:
        upper = np.array([math.cos(heading_rad), math.sin(heading_rad), 0.0])
        right = np.array([-upper[1], upper[0], 0.0])
        pad_offset = offset - right * on_pad.right_m - upper * on_pad.up_m
    origin = np.array(pose.position_ned_m)
    ground_range_m = math.hypot(offset[0], offset[1])
    return MarkerTarget(
        identifier=marker.identifier,
        pad=marker.identifier if on_pad is None else on_pad.pad,
        captured_ns=captured_ns,
        bearing_rad=math.atan2(offset[1], offset[0]),
        elevation_rad=math.atan2(-offset[2], ground_range_m),
        distance_m=float(np.linalg.norm(offset)),
        ground_range_m=ground_range_m,
        position_ned_m=_vector(origin + offset),
        pad_ned_m=_vector(origin + pad_offset),
        pad_offset_frd_m=_vector(pose.ned_from_body.T @ pad_offset),
        heading_rad=heading_rad,
        size_m=marker.size_m,
        side_px=marker.side_px,
        reprojection_px=marker.reprojection_px,
    )


def _heading(ned_from_marker: NDArray[np.float64]) -> float:
    """Of the upper edge, from both of the print's axes: a tilt that is not there must not turn it."""
    right, upper = ned_from_marker[:2, 0], ned_from_marker[:2, 1]
    return math.atan2(upper[1] - right[0], upper[0] + right[1])


def _vector(values: NDArray[np.float64]) -> Vector3:
    return (float(values[0]), float(values[1]), float(values[2]))
