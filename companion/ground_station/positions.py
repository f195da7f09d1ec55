"""Where the vehicle and its cameras were at a time of the last seconds, from the bus."""

from __future__ import annotations

import math
from bisect import bisect
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from companion.bus.bodies.frames import TransformBody, TransformsBody
from companion.bus.bodies.vehicle import VehicleBody
from vision.attitude import Quaternion
from vision.rotation import BODY_FROM_OPTICAL, matrix_from_quaternion, quaternion_from_matrix

_VEHICLE_KEPT, _FRAMES_KEPT = 50, 64  # 5 s at 10 Hz; some seconds of frames
_OLDEST_S = 1.0
# A position at another time is not that of the image.
_FURTHEST_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Place:
    """WGS 84, degrees; heights above mean sea level and above home, metres, NaN if not known."""

    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float
    altitude_m: float


class Positions:
    """The newest positions of the vehicle, and the orientations of one camera."""

    def __init__(self) -> None:
        self._vehicle: deque[tuple[int, Place]] = deque(maxlen=_VEHICLE_KEPT)
        self._frames: deque[TransformsBody] = deque(maxlen=_FRAMES_KEPT)

    def on_vehicle(self, body: VehicleBody) -> None:
        """Keep a message of the topic `vehicle`."""
        latitude, longitude, age_s = body["latitude_deg"], body["longitude_deg"], body["global_age_s"]
        amsl_m, altitude_m = body["altitude_amsl_m"], body["altitude_m"]
        if latitude is None or longitude is None or age_s is None or age_s > _OLDEST_S:
            return
        stamp_ns = body["stamp_ns"] - round(age_s * 1e9)
        if not self._vehicle or stamp_ns > self._vehicle[-1][0]:
            heights = (math.nan if height is None else height for height in (amsl_m, altitude_m))
            self._vehicle.append((stamp_ns, Place(latitude, longitude, *heights)))

    def on_transforms(self, body: TransformsBody) -> None:
        """Keep a message of the topic `transforms` of the camera."""
        self._frames.append(body)

    def place(self, stamp_ns: int) -> Place | None:
        """Return where the vehicle was, interpolated; None: not known at that time."""
        index = bisect(self._vehicle, stamp_ns, key=lambda each: each[0])
        around = list(self._vehicle)[max(index - 1, 0) : index + 1]
        if not around or min(abs(stamp_ns - ns) for ns, _ in around) > _FURTHEST_NS:
            return None
        (first_ns, first), (last_ns, last) = around[0], around[-1]
        if first_ns == last_ns:
            return first
        share = (stamp_ns - first_ns) / (last_ns - first_ns)
        pairs = zip(_values(first), _values(last), strict=True)
        return Place(*(one + share * (other - one) for one, other in pairs))

    def newest(self, now_ns: int) -> Place | None:
        """Return where the vehicle is; None: not known."""
        if not self._vehicle or now_ns - self._vehicle[-1][0] > _FURTHEST_NS:
            return None
        return self._vehicle[-1][1]

    def orientation(self, captured_ns: int | None = None) -> Sequence[float] | None:
        """Return the camera's orientation at the capture of a frame; of None, of the newest.

        Returns:
            Quaternion w, x, y, z that rotates the camera's axes (forward, right, down) into NED; None: not
            known.
        """
        for body in reversed(self._frames):
            if captured_ns in (None, body["captured_ns"]):
                return _orientation(body["transforms"])
        return None


def _values(place: Place) -> tuple[float, ...]:
    return (place.latitude_deg, place.longitude_deg, place.altitude_amsl_m, place.altitude_m)


def _orientation(transforms: Sequence[TransformBody]) -> Sequence[float]:
    rotation = np.eye(3)
    for each in transforms:
        rotation = rotation @ matrix_from_quaternion(cast("Quaternion", each["rotation_wxyz"]))
    return quaternion_from_matrix(rotation @ BODY_FROM_OPTICAL.T)
