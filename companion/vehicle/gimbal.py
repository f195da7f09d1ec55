"""The state of a gimbal and the aim it can be commanded to.

MAVLink's gimbal protocol version 2 (https://mavlink.io/en/services/gimbal_v2.html). Gimbal frame: FRD, x
along the optical axis of the payload. Pitch is positive above the horizon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

Quaternion = tuple[float, float, float, float]
# A MAVLink address: system id, component id.
Address = tuple[int, int]

NOBODY: Address = (0, 0)
# An attitude older than this is not used: the gimbal may have turned by 10° since.
GIMBAL_MAX_AGE_S = 0.5
# Primary control older than this is unknown: PX4 sends it every two seconds, and at every change.
CONTROL_MAX_AGE_S = 6.5
# Device ids up to this are gimbals attached to the autopilot's component; others are component ids.
LAST_ATTACHED_DEVICE = 6


class YawFrame(StrEnum):
    """The reference of a gimbal's yaw. Its roll and pitch are relative to the horizon in both."""

    NORTH = "north"
    NOSE = "nose"


@dataclass(frozen=True, slots=True)
class GimbalAim:
    """A commanded gimbal direction.

    Attributes:
        pitch_rad: above the horizon, stabilized.
        yaw_rad: clockwise from `yaw_frame`: from the nose it turns with the vehicle, from north it does not.
    """

    pitch_rad: float
    yaw_rad: float = 0.0
    yaw_frame: YawFrame = YawFrame.NOSE

    def __post_init__(self) -> None:
        if not (abs(self.pitch_rad) <= math.pi / 2 + 1e-9 and abs(self.yaw_rad) <= math.pi + 1e-9):
            raise ValueError(
                f"gimbal aim: pitch must be -90° to 90° and yaw -180° to 180°, "
                f"got {math.degrees(self.pitch_rad):g}° and {math.degrees(self.yaw_rad):g}°"
            )


@dataclass(frozen=True, slots=True)
class GimbalState:
    """One gimbal as its manager and its device report it. Stamps are CLOCK_MONOTONIC ns, 0: never.

    Attributes:
        device: gimbal_device_id: up to 6 if attached to the autopilot, else its component id; 0: unknown.
        information_ns, status_ns, attitude_ns: of GIMBAL_MANAGER_INFORMATION, GIMBAL_MANAGER_STATUS and
            GIMBAL_DEVICE_ATTITUDE_STATUS.
        attitude: (w, x, y, z), rotates gimbal FRD into NED, or into NED rotated by the heading; see
            `yaw_frame`.
        attitude_problem: why the newest received attitude is not used; empty if it is.
        lowest_pitch_rad, highest_pitch_rad: reported end stops; infinite where not reported.
        primary_control: address in control; `NOBODY`, or None if unknown.
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
        """Pitch of the optical axis above the horizon, -π/2..π/2; None without an attitude."""
        if self.attitude is None:
            return None
        w, x, y, z = self.attitude
        return math.asin(max(-1.0, min(1.0, 2 * (w * y - x * z))))

    def off_rad(self, aim: GimbalAim, heading_rad: float) -> float | None:
        """Return the angle between the optical axis and an aim, 0..π; None without an attitude."""
        if self.attitude is None:
            return None
        w, x, y, z = self.attitude
        axis = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
        yaw_rad = aim.yaw_rad
        if self.yaw_frame is not aim.yaw_frame:
            yaw_rad += heading_rad if self.yaw_frame is YawFrame.NORTH else -heading_rad
        level = math.cos(aim.pitch_rad)
        aimed = (level * math.cos(yaw_rad), level * math.sin(yaw_rad), -math.sin(aim.pitch_rad))
        return math.acos(max(-1.0, min(1.0, sum(a * b for a, b in zip(axis, aimed, strict=True)))))

    def attitude_fresh(self, now_ns: int) -> bool:
        """Whether the attitude is known and recent."""
        return self.attitude is not None and now_ns - self.attitude_ns <= GIMBAL_MAX_AGE_S * 1e9

    def control_known(self, now_ns: int) -> bool:
        """Whether the owner of primary control is known and recent."""
        return self.primary_control is not None and now_ns - self.status_ns <= CONTROL_MAX_AGE_S * 1e9

    def why_not_looking(self, now_ns: int) -> str | None:
        """Return why the gimbal's attitude is unknown, as text; None if it is known."""
        if self.attitude_problem:
            return self.attitude_problem
        if self.attitude is None:
            return "attitude not received"
        if not self.attitude_fresh(now_ns):
            return f"attitude {(now_ns - self.attitude_ns) / 1e9:.1f} s old"
        return None

    def nearest_pitch_rad(self, pitch_rad: float) -> float:
        """Clamp a pitch to the end stops and to what can be commanded."""
        low, high = self.lowest_pitch_rad, self.highest_pitch_rad
        if low <= high:  # else the reported stops are invalid and ignored
            pitch_rad = max(low, min(high, pitch_rad))
        return max(-math.pi / 2, min(math.pi / 2, pitch_rad))

    def reaches(self, pitch_rad: float) -> bool:
        """Whether a pitch lies between the end stops, within half a degree."""
        slack = math.radians(0.5)
        return self.lowest_pitch_rad - slack <= pitch_rad <= self.highest_pitch_rad + slack


def address_text(address: Address) -> str:
    """Format an address as SYSTEM/COMPONENT."""
    return f"{address[0]}/{address[1]}"
