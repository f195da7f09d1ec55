"""The camera's angles on the body, from a level marker and the vehicle's attitude."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.attitude import euler_from_quaternion
from vision.calibration.calibrate import CalibrationError
from vision.markers import Marker
from vision.rotation import BODY_FROM_OPTICAL, matrix_from_euler, quaternion_from_matrix

# Up to this ambiguity of a marker (`Marker.ambiguity`) its better pose is the true one.
UNAMBIGUOUS = 0.7
# Downward part of the image's downward direction; about zero for a camera that looks straight down.
UPSIDE_DOWN = -0.5
# Rotations farther than this from the others are outliers.
OUTLIER_RAD = math.radians(2.0)


@dataclass(frozen=True, slots=True)
class MountAngles:
    """Angles of a camera on the body, as in `CameraMount`.

    Attributes:
        roll_rad, pitch_rad, yaw_rad: from the body's forward direction.
        spread_rad: RMS angle between the views' results and their mean.
        views: number of used views.
    """

    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    spread_rad: float
    views: int


def mount_from_markers(
    markers: Sequence[Marker],
    heading_rad: float = 0.0,
    roll_rad: float | Sequence[float] = 0.0,
    pitch_rad: float | Sequence[float] = 0.0,
) -> MountAngles:
    """The camera's angles on the body.

    Args:
        markers: one marker lying level, face up, in several images.
        heading_rad: direction of the marker's upper edge, clockwise from the vehicle's nose.
        roll_rad, pitch_rad: attitude of the vehicle, for all images or for each.

    Raises:
        CalibrationError: no marker, none whose pose is unambiguous, or the camera is upside down.
    """
    if not markers:
        raise CalibrationError("the marker is in none of the images")
    rolls, pitches = (np.broadcast_to(angle, len(markers)) for angle in (roll_rad, pitch_rad))
    clear = [
        (marker, matrix_from_euler(float(roll), float(pitch), 0.0))
        for marker, roll, pitch in zip(markers, rolls, pitches, strict=True)
        if marker.ambiguity <= UNAMBIGUOUS
    ]
    if not clear:
        raise CalibrationError(
            f"the marker's pose is ambiguous in all of {len(markers)} images: place it nearer, or where it "
            "is seen more from the side"
        )
    sine, cosine = math.sin(heading_rad), math.cos(heading_rad)
    # Columns: the marker's right, its upper edge, and out of its face, in a level frame along the nose (FRD).
    level_from_marker = np.array([[-sine, cosine, 0.0], [cosine, sine, 0.0], [0.0, 0.0, -1.0]])
    found = np.array(
        [
            level_from_body.T @ level_from_marker @ marker.rotation.T @ BODY_FROM_OPTICAL.T
            for marker, level_from_body in clear
        ]
    )
    middle = found[np.argmin([np.median(_angles(found, each)) for each in found])]
    found = found[_angles(found, middle) < OUTLIER_RAD]
    left, _, right = np.linalg.svd(found.mean(axis=0))
    mean: NDArray[np.float64] = left @ right
    roll, pitch, yaw = euler_from_quaternion(quaternion_from_matrix(mean))
    if mean[2, 2] < UPSIDE_DOWN:
        raise CalibrationError(
            f"the camera is upside down (roll {math.degrees(roll):.0f} degrees): turn it, or its images"
        )
    spread = float(np.sqrt((_angles(found, mean) ** 2).mean()))
    return MountAngles(roll, pitch, yaw, spread, len(found))


def _angles(rotations: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) angles between rotations (N, 3, 3) and another one, radians."""
    difference = np.linalg.norm(rotations - other, axis=(1, 2))
    return np.asarray(2 * np.arcsin(np.minimum(difference / math.sqrt(8.0), 1.0)), np.float64)
