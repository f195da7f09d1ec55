"""What is known of a gimbal at one moment, and where it may be asked to look.

MAVLink's gimbal protocol version 2 (https://mavlink.io/en/services/gimbal_v2.html). Gimbal frame: FRD, x
along the axis of what it carries. Pitch is above the horizon, negative below it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

Quaternion = tuple[float, float, float, float]
# A MAVLink address: system id, component id.
Address = tuple[int, int]

NOBODY: Address = (0, 0)
# An attitude that was not told for this long is not where the gimbal looks: it may have turned by 10° since.
GIMBAL_MAX_AGE_S = 0.5
# Whose control was not told for this long is not known: PX4 tells every two seconds, and at every change.
CONTROL_MAX_AGE_S = 6.5
# Device ids up to this are of gimbals that speak through the autopilot's component; others are component ids.
LAST_ATTACHED_DEVICE = 6


class YawFrame(StrEnum):
    """What a gimbal's yaw counts from. Its roll and pitch count from the horizon in both."""

    NORTH = "north"
    NOSE = "nose"


@dataclass(frozen=True, slots=True)
class GimbalAim:
    """Where a gimbal is to look.

    Attributes:
        pitch_rad: above the horizon, kept whatever the vehicle does.
        yaw_rad: clockwise from the nose, with which it turns.
    """

    pitch_rad: float
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (abs(self.pitch_rad) <= math.pi / 2 + 1e-9 and abs(self.yaw_rad) <= math.pi + 1e-9):
            raise ValueError(
                f"a gimbal looks between -90° and 90° of the horizon and -180° and 180° of the nose, "
                f"got {math.degrees(self.pitch_rad):g}° and {math.degrees(self.yaw_rad):g}°"
            )


@dataclass(frozen=True, slots=True)
class GimbalState:
    """One gimbal as its manager and its device tell of it. Stamps are CLOCK_MONOTONIC ns, 0: never.

    Attributes:
        device: gimbal_device_id: up to 6 it speaks through the autopilot, else its component id; 0: not told.
        information_ns, status_ns, attitude_ns: of GIMBAL_MANAGER_INFORMATION, GIMBAL_MANAGER_STATUS and
            GIMBAL_DEVICE_ATTITUDE_STATUS.
        attitude: (w, x, y, z), turns gimbal FRD into NED, or into NED turned to the heading; see `yaw_frame`.
        attitude_problem: why the newest attitude that came is not used; empty: it is.
        lowest_pitch_rad, highest_pitch_rad: its stops, as told; infinite where not told.
        primary_control: who may move it; `NOBODY`, or None where not told.
    """

    device: int = 0
    information_ns: int = 0
    status_ns: int = 0
    attitude_ns: int = 0
    attitude: Quaternion | None = None
    yaw_frame: YawFrame = YawFrame.NORTH
    attitude_problem: str = ""
    lowest_pitch_rad: float = -math.inf
    highest_pitch_rad: float = math.inf
    primary_control: Address | None = None

    @property
    def pitch_rad(self) -> float | None:
        """Of its axis above the horizon, -π/2..π/2; None while no attitude came."""
        if self.attitude is None:
            return None
        w, x, y, z = self.attitude
        return math.asin(max(-1.0, min(1.0, 2 * (w * y - x * z))))

    def off_rad(self, aim: GimbalAim, heading_rad: float) -> float | None:
        """The angle between its axis and an aim, 0..π, with the vehicle's heading; None: no attitude came."""
        if self.attitude is None:
            return None
        w, x, y, z = self.attitude
        axis = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
        yaw_rad = aim.yaw_rad + (heading_rad if self.yaw_frame is YawFrame.NORTH else 0.0)
        level = math.cos(aim.pitch_rad)
        aimed = (level * math.cos(yaw_rad), level * math.sin(yaw_rad), -math.sin(aim.pitch_rad))
        return math.acos(max(-1.0, min(1.0, sum(a * b for a, b in zip(axis, aimed, strict=True)))))

    def attitude_fresh(self, now_ns: int) -> bool:
        """It is known where the gimbal looks."""
        return self.attitude is not None and now_ns - self.attitude_ns <= GIMBAL_MAX_AGE_S * 1e9

    def control_known(self, now_ns: int) -> bool:
        """It is known who may move the gimbal."""
        return self.primary_control is not None and now_ns - self.status_ns <= CONTROL_MAX_AGE_S * 1e9

    def why_not_looking(self, now_ns: int) -> str | None:
        """Why it is not known where the gimbal looks, in words; None: it is."""
        if self.attitude_problem:
            return self.attitude_problem
        if self.attitude is None:
            return "it has not told its attitude"
        if not self.attitude_fresh(now_ns):
            return f"its attitude is {(now_ns - self.attitude_ns) / 1e9:.1f} s old"
        return None

    def nearest_pitch_rad(self, pitch_rad: float) -> float:
        """The pitch between its stops that is nearest to this one, and that can be asked for."""
        low, high = self.lowest_pitch_rad, self.highest_pitch_rad
        if low <= high:  # else its stops make no sense, and bound nothing
            pitch_rad = max(low, min(high, pitch_rad))
        return max(-math.pi / 2, min(math.pi / 2, pitch_rad))

    def reaches(self, pitch_rad: float) -> bool:
        """Whether a pitch lies between its stops, to half a degree."""
        slack = math.radians(0.5)
        return self.lowest_pitch_rad - slack <= pitch_rad <= self.highest_pitch_rad + slack


def address_text(address: Address) -> str:
    """As people write it."""
    return f"{address[0]}/{address[1]}"
