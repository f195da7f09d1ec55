"""The pose of a vehicle, interpolated between its telemetry messages by its clock.

Attitude is from ATTITUDE_QUATERNION, or from ATTITUDE without a quaternion; position from LOCAL_POSITION_NED.
A simulator's truth, HIL_STATE_QUATERNION, replaces both where it is sent.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from typing import Any, NamedTuple

from vision.attitude import Quaternion, quaternion_from_euler, slerp

Vector = tuple[float, float, float]

KEPT_S = 3.0
"""Poses older than this are dropped."""
RESTART_S = 1.0
"""A clock that goes back by more than this indicates a restart of the vehicle."""
CLOCK_WINDOW_S = 2.0
"""The smallest delay of the last one to two of these windows is used: long enough to contain an undelayed
message, short enough to follow a simulation that runs a little slower than real time."""
QUATERNION_LOST_S = 1.0
"""Without ATTITUDE_QUATERNION for this time ATTITUDE is used."""
EARTH_RADIUS_M = 6_371_000.0
MESSAGES = ("ATTITUDE_QUATERNION", "ATTITUDE", "LOCAL_POSITION_NED", "HIL_STATE_QUATERNION")


class Pose(NamedTuple):
    """Position and velocity NED (m, m/s), and the (w, x, y, z) quaternion of `ned_from_body`."""

    position: Vector
    velocity: Vector
    attitude: Quaternion


class BootClock:
    """The vehicle's time since boot on CLOCK_MONOTONIC, from the message with the least delay.

    The error is that smallest delay: below a millisecond on one host.
    """

    def __init__(self) -> None:
        self._window_start_ns: int | None = None
        self._before_ns: int | None = None
        self._offset_ns: int | None = None

    def add(self, boot_ns: int, arrived_ns: int) -> None:
        """Add a message of time `boot_ns` that arrived at `arrived_ns` (CLOCK_MONOTONIC)."""
        offset_ns = arrived_ns - boot_ns
        if self._window_start_ns is None or arrived_ns - self._window_start_ns >= CLOCK_WINDOW_S * 1e9:
            self._window_start_ns = arrived_ns
            self._before_ns, self._offset_ns = self._offset_ns, offset_ns
        elif self._offset_ns is None or offset_ns < self._offset_ns:
            self._offset_ns = offset_ns

    def monotonic_ns(self, boot_ns: int) -> int:
        """CLOCK_MONOTONIC nanoseconds at a time since boot. Raises ValueError before the first message."""
        known = [offset for offset in (self._before_ns, self._offset_ns) if offset is not None]
        if not known:
            raise ValueError("no message with the vehicle's time received")
        return boot_ns + min(known)


class _Track:
    """Values by time, oldest first."""

    def __init__(self) -> None:
        self.stamps_ns: deque[int] = deque()
        self.values: deque[tuple[float, ...]] = deque()

    def add(self, stamp_ns: int, value: tuple[float, ...]) -> None:
        if self.stamps_ns and stamp_ns <= self.stamps_ns[-1]:
            return  # a duplicate, or out of order
        self.stamps_ns.append(stamp_ns)
        self.values.append(value)
        while stamp_ns - self.stamps_ns[0] > KEPT_S * 1e9:
            self.stamps_ns.popleft()
            self.values.popleft()

    def around(self, stamp_ns: int) -> tuple[tuple[float, ...], tuple[float, ...], float]:
        """The values before and after a time within the track, and the fraction between them, 0..1."""
        after = bisect_left(self.stamps_ns, stamp_ns)
        if self.stamps_ns[after] == stamp_ns:
            return self.values[after], self.values[after], 0.0
        start_ns, end_ns = self.stamps_ns[after - 1], self.stamps_ns[after]
        return self.values[after - 1], self.values[after], (stamp_ns - start_ns) / (end_ns - start_ns)


class PoseHistory:
    """The last seconds of one vehicle's pose.

    Attributes:
        truth: the poses are a simulator's truth, not the estimate of the autopilot.
    """

    def __init__(self) -> None:
        self.truth = False
        self._fix: tuple[int, int, int] | None = None
        self._restart()

    def _restart(self) -> None:
        self._clock = BootClock()
        self._attitudes, self._motions = _Track(), _Track()
        self._quaternion_ns: int | None = None
        self._newest_ns: int | None = None

    def add(self, message: Any, arrived_ns: int) -> None:
        """Add a message of the vehicle, of any kind, received at CLOCK_MONOTONIC nanoseconds."""
        kind = message.get_type()
        if kind not in MESSAGES or (self.truth and kind != "HIL_STATE_QUATERNION"):
            return
        if kind == "HIL_STATE_QUATERNION":
            if not self.truth:
                self.truth = True
                self._restart()
            # PX4 leaves its time at zero: then the time of arrival is used.
            stamp_ns = message.time_usec * 1000 or arrived_ns
        else:
            stamp_ns = message.time_boot_ms * 1_000_000
        values = _values_of(message)
        if not all(map(math.isfinite, values)):
            return
        if self._newest_ns is not None and stamp_ns < self._newest_ns - RESTART_S * 1e9:
            self._restart()
        self._newest_ns = max(stamp_ns, self._newest_ns or stamp_ns)
        self._clock.add(stamp_ns, arrived_ns)
        if kind == "LOCAL_POSITION_NED":
            self._motions.add(stamp_ns, values)
        elif kind == "ATTITUDE_QUATERNION":
            self._quaternion_ns = arrived_ns
            self._add_attitude(stamp_ns, values)
        elif kind == "ATTITUDE":
            if self._quaternion_ns is None or arrived_ns - self._quaternion_ns > QUATERNION_LOST_S * 1e9:
                self._add_attitude(stamp_ns, quaternion_from_euler(*values))
        else:
            self._add_attitude(stamp_ns, values)
            self._motions.add(stamp_ns, self._local(message))

    def _add_attitude(self, stamp_ns: int, values: tuple[float, ...]) -> None:
        if any(values):  # all zeros are no rotation
            self._attitudes.add(stamp_ns, values)

    def _local(self, message: Any) -> tuple[float, ...]:
        """Position NED in metres from the first fix, on a sphere; velocity NED in m/s."""
        if self._fix is None:
            self._fix = (message.lat, message.lon, message.alt)
        lat, lon, alt_mm = self._fix
        per_unit_m = math.radians(1e-7) * EARTH_RADIUS_M
        return (
            (message.lat - lat) * per_unit_m,
            (message.lon - lon) * per_unit_m * math.cos(math.radians(lat * 1e-7)),
            (alt_mm - message.alt) / 1000.0,
            message.vx / 100.0,
            message.vy / 100.0,
            message.vz / 100.0,
        )

    @property
    def missing(self) -> tuple[str, ...]:
        """The messages still missing for a pose."""
        attitude = () if self._attitudes.stamps_ns else ("ATTITUDE_QUATERNION",)
        return attitude + (() if self._motions.stamps_ns else ("LOCAL_POSITION_NED",))

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """The interval, by the vehicle's clock, in which its pose is known; None: none."""
        tracks = self._attitudes.stamps_ns, self._motions.stamps_ns
        if not all(tracks):
            return None
        start_ns, end_ns = max(track[0] for track in tracks), min(track[-1] for track in tracks)
        return (start_ns, end_ns) if start_ns <= end_ns else None

    def at(self, boot_ns: int) -> Pose:
        """The pose at a time within `span_ns`: position linear, attitude along the shorter arc (slerp)."""
        first, second, share = self._attitudes.around(boot_ns)
        attitude = slerp(_quaternion(first), _quaternion(second), share)
        before, after, share = self._motions.around(boot_ns)
        n, e, d, vn, ve, vd = (p + (q - p) * share for p, q in zip(before, after, strict=True))
        return Pose((n, e, d), (vn, ve, vd), attitude)

    def monotonic_ns(self, boot_ns: int) -> int:
        """CLOCK_MONOTONIC nanoseconds at a time of the vehicle's clock."""
        return self._clock.monotonic_ns(boot_ns)


def _quaternion(values: tuple[float, ...]) -> Quaternion:
    w, x, y, z = values
    return w, x, y, z


def _values_of(message: Any) -> tuple[float, ...]:
    match message.get_type():
        case "ATTITUDE_QUATERNION":
            return (message.q1, message.q2, message.q3, message.q4)
        case "ATTITUDE":
            return (message.roll, message.pitch, message.yaw)
        case "LOCAL_POSITION_NED":
            return (message.x, message.y, message.z, message.vx, message.vy, message.vz)
        case _:
            return tuple(message.attitude_quaternion)
