"""A setpoint: a position or velocity in local NED, with a deadline.

The two forms are those that PX4 accepts in frame MAV_FRAME_LOCAL_NED of SET_POSITION_TARGET_LOCAL_NED
(MAVLink common, 84): a position or a velocity, each with a yaw or a yaw rate. A velocity may have an
acceleration as feed-forward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from companion.vehicle.state import Vector3

# POSITION_TARGET_TYPEMASK
IGNORE_POSITION = 0b0000_0000_0111
IGNORE_VELOCITY = 0b0000_0011_1000
IGNORE_ACCELERATION = 0b0001_1100_0000
IGNORE_YAW = 0b0100_0000_0000
IGNORE_YAW_RATE = 0b1000_0000_0000

_FRAME_LOCAL_NED = 1
_AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_ZERO = (0.0, 0.0, 0.0)  # ignored by the type mask

# Default lifetime of a setpoint: below PX4's default COM_OF_LOSS_T (1 s).
DEFAULT_LIFETIME_S = 0.3
# Limit between the choice of a setpoint and its sending; a longer delay means the process was stopped.
LEAVES_WITHIN_S = 0.3


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Exactly one of position and velocity; at most one of yaw and yaw rate (none: keep the heading).

    Attributes:
        deadline_ns: after which it must not be sent: CLOCK_MONOTONIC nanoseconds, compared with a clock that
            counts a suspend (`companion.host.clock`).
        position_ned_m: metres, local NED.
        velocity_ned_mps: metres a second, local NED.
        acceleration_ned_mps2: feed-forward of a velocity setpoint, m/s², local NED: PX4 adds it to the output
            of its velocity controller. It is not sent to ArduPilot (`ardupilot_profile`). None: none.
        yaw_rad: heading, clockwise from north.
        yaw_rate_radps: clockwise seen from above.

    Raises:
        ValueError: the form is none of the above, or a value is not finite.

    >>> from companion import Setpoint
    >>> setpoint = Setpoint.velocity((1.0, 0.0, 0.0), now_ns=0, yaw_rad=0.0)
    >>> setpoint.expired(200_000_000), setpoint.expired(400_000_000)
    (False, True)
    """

    deadline_ns: int
    position_ned_m: Vector3 | None = None
    velocity_ned_mps: Vector3 | None = None
    yaw_rad: float | None = None
    yaw_rate_radps: float | None = None
    acceleration_ned_mps2: Vector3 | None = None

    def __post_init__(self) -> None:
        if (self.position_ned_m is None) == (self.velocity_ned_mps is None):
            raise ValueError("a setpoint needs exactly one of position_ned_m and velocity_ned_mps")
        if self.yaw_rad is not None and self.yaw_rate_radps is not None:
            raise ValueError("a setpoint takes yaw_rad or yaw_rate_radps, not both")
        if self.acceleration_ned_mps2 is not None and self.velocity_ned_mps is None:
            raise ValueError(
                "acceleration_ned_mps2 is the feed-forward of a velocity: set velocity_ned_mps too"
            )
        values = [*(self.position_ned_m or ()), *(self.velocity_ned_mps or ())]
        values += self.acceleration_ned_mps2 or ()
        values += [value for value in (self.yaw_rad, self.yaw_rate_radps) if value is not None]
        if not all(math.isfinite(value) for value in values):
            raise ValueError(f"all values of a setpoint must be finite, got {values}")

    @classmethod
    def velocity(
        cls,
        velocity_ned_mps: Vector3,
        now_ns: int,
        *,
        yaw_rad: float | None = None,
        yaw_rate_radps: float | None = None,
        acceleration_ned_mps2: Vector3 | None = None,
        lifetime_s: float = DEFAULT_LIFETIME_S,
    ) -> Setpoint:
        """Create a velocity setpoint that expires after `lifetime_s`."""
        return cls(
            now_ns + round(lifetime_s * 1e9),
            velocity_ned_mps=velocity_ned_mps,
            yaw_rad=yaw_rad,
            yaw_rate_radps=yaw_rate_radps,
            acceleration_ned_mps2=acceleration_ned_mps2,
        )

    @classmethod
    def position(
        cls,
        position_ned_m: Vector3,
        now_ns: int,
        *,
        yaw_rad: float | None = None,
        lifetime_s: float = DEFAULT_LIFETIME_S,
    ) -> Setpoint:
        """Create a position setpoint that expires after `lifetime_s`."""
        return cls(now_ns + round(lifetime_s * 1e9), position_ned_m=position_ned_m, yaw_rad=yaw_rad)

    @classmethod
    def brake(cls, now_ns: int, lifetime_s: float = DEFAULT_LIFETIME_S) -> Setpoint:
        """Create a setpoint that stops the vehicle and its yaw."""
        return cls.velocity((0.0, 0.0, 0.0), now_ns, yaw_rate_radps=0.0, lifetime_s=lifetime_s)

    @property
    def type_mask(self) -> int:
        """POSITION_TARGET_TYPEMASK: the bits of the ignored fields."""
        mask = IGNORE_ACCELERATION if self.acceleration_ned_mps2 is None else 0
        mask |= IGNORE_POSITION if self.position_ned_m is None else 0
        mask |= IGNORE_VELOCITY if self.velocity_ned_mps is None else 0
        mask |= IGNORE_YAW if self.yaw_rad is None else 0
        mask |= IGNORE_YAW_RATE if self.yaw_rate_radps is None else 0
        return mask

    def expired(self, now_ns: int) -> bool:
        """Whether the deadline has passed."""
        return now_ns > self.deadline_ns

    def leaving(self, now_ns: int) -> Setpoint:
        """Return a copy to send now: its deadline is at most `LEAVES_WITHIN_S` from now."""
        latest_ns = now_ns + round(LEAVES_WITHIN_S * 1e9)
        return self if self.deadline_ns <= latest_ns else replace(self, deadline_ns=latest_ns)

    def moved(self, by_ned_m: Vector3) -> Setpoint:
        """Return a copy with its position, if any, translated."""
        if self.position_ned_m is None or by_ned_m == (0.0, 0.0, 0.0):
            return self
        north, east, down = (p + d for p, d in zip(self.position_ned_m, by_ned_m, strict=True))
        return replace(self, position_ned_m=(north, east, down))


def setpoint_fields(setpoint: Setpoint, system_id: int, time_boot_ms: int = 0) -> dict[str, Any]:
    """Return the fields of SET_POSITION_TARGET_LOCAL_NED to this system's autopilot."""
    x, y, z = setpoint.position_ned_m or _ZERO
    vx, vy, vz = setpoint.velocity_ned_mps or _ZERO
    afx, afy, afz = setpoint.acceleration_ned_mps2 or _ZERO
    return {
        "time_boot_ms": time_boot_ms,
        "target_system": system_id,
        "target_component": _AUTOPILOT_COMPONENT,
        "coordinate_frame": _FRAME_LOCAL_NED,
        "type_mask": setpoint.type_mask,
        "x": x,
        "y": y,
        "z": z,
        "vx": vx,
        "vy": vy,
        "vz": vz,
        "afx": afx,
        "afy": afy,
        "afz": afz,
        "yaw": setpoint.yaw_rad or 0.0,
        "yaw_rate": setpoint.yaw_rate_radps or 0.0,
    }
