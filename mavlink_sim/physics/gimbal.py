"""A two-axis gimbal: it pans about the body's down axis, then tilts, within its limits and rates.

Angles are radians. Pan and tilt are the joints: pan is positive to the right, tilt positive upwards. "Locked"
angles are kept relative to the horizon (pitch) or north (yaw) whatever the vehicle does; "follow" angles are
kept relative to the vehicle. Two axes point the optical axis anywhere but cannot level the image: with the
vehicle rolled and the camera forward, the horizon is tilted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from mavlink_sim.physics.rotations import Vector, rotation_matrix, turned_back
from mavlink_sim.px4.parameters import Parameters
from vision.attitude import Quaternion, quaternion_product

SLEW_RADPS = math.radians(120.0)  # slew rate to a new target, of a small brushless gimbal
JOINT_RADPS = math.radians(300.0)  # greatest rate of stabilisation
UNLIMITED_RANGE_DEG = 360.0  # from this MNT_RANGE_YAW on there is no limit
RATE_TIMEOUT_S = 2.0  # a rate that is not repeated ends, as in PX4


class Aim(Enum):
    """Kind of target."""

    NEUTRAL = "neutral"
    ANGLES = "angles"
    LOCATION = "location"


@dataclass(frozen=True, slots=True)
class Target:
    """The target of the gimbal. NaN: keep that angle; no rate.

    Attributes:
        pitch_rad, yaw_rad: relative to the world if locked, else to the vehicle.
        pitch_rate_radps, yaw_rate_radps: with an angle too, the gimbal turns until that is reached.
        location: NED metres, for Aim.LOCATION.
    """

    aim: Aim = Aim.NEUTRAL
    pitch_rad: float = math.nan
    yaw_rad: float = math.nan
    pitch_rate_radps: float = math.nan
    yaw_rate_radps: float = math.nan
    pitch_locked: bool = False
    yaw_locked: bool = False
    location: Vector = (math.nan, math.nan, math.nan)


class Gimbal:
    """One gimbal. `step` moves it.

    Attributes:
        target: set it by `point`.
        pan_rad, tilt_rad: the joints; pan_rate_radps, tilt_rate_radps: how fast they turn.
        pitch_rad, yaw_rad: of the optical axis against horizon and north.
        lowest_rad, highest_rad, furthest_rad: the limits of tilt, and of pan to either side (infinite: none).
        quaternion: `ned_from_gimbal`, (w, x, y, z), gimbal frame FRD: x along the optical axis.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._revision = -1
        self.target = Target()
        self.pan_rad = self.tilt_rad = 0.0
        self.pan_rate_radps = self.tilt_rate_radps = 0.0
        self.pitch_rad = self.yaw_rad = 0.0
        self.quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._aim_pitch_rad = self._aim_yaw_rad = 0.0  # in the frames of `target`, slewing towards it
        self._pointed_s = 0.0
        self._now_s = 0.0
        self._load()

    def _load(self) -> None:
        self._revision = self._parameters.revision
        value = self._parameters.number
        self.lowest_rad = math.radians(value("MNT_MIN_PITCH"))
        self.highest_rad = max(math.radians(value("MNT_MAX_PITCH")), self.lowest_rad)
        span = value("MNT_RANGE_YAW")
        self.furthest_rad = math.inf if span >= UNLIMITED_RANGE_DEG else math.radians(max(span, 0.0)) / 2.0
        self._landed_rad = (math.radians(value("MNT_LND_P_MIN")), math.radians(value("MNT_LND_P_MAX")))

    @property
    def body_quaternion(self) -> Quaternion:
        """`body_from_gimbal`, (w, x, y, z): the current mount of a camera on it."""
        return quaternion_product(_about_z(self.pan_rad), _about_y(self.tilt_rad))

    def angular_velocity(self, body_rates: Vector) -> Vector:
        """About the gimbal's own axes, rad/s, given the vehicle's body rates (FRD)."""
        p, q, r = body_rates
        x, y, z = turned_back(rotation_matrix(self.body_quaternion), (p, q, r + self.pan_rate_radps))
        return (x, y + self.tilt_rate_radps, z)

    def point(self, target: Target) -> None:
        """Set the target."""
        old = self.target
        self.target = target
        self._pointed_s = self._now_s
        if target.pitch_locked is not old.pitch_locked or target.aim is not old.aim:
            self._aim_pitch_rad = self.pitch_rad if self._pitch_is_locked else self.tilt_rad
        if target.yaw_locked is not old.yaw_locked or target.aim is not old.aim:
            self._aim_yaw_rad = self.yaw_rad if self._yaw_is_locked else self.pan_rad

    @property
    def _pitch_is_locked(self) -> bool:
        return self.target.aim is Aim.LOCATION or (self.target.aim is Aim.ANGLES and self.target.pitch_locked)

    @property
    def _yaw_is_locked(self) -> bool:
        return self.target.aim is Aim.LOCATION or (self.target.aim is Aim.ANGLES and self.target.yaw_locked)

    def step(self, dt_s: float, attitude: Quaternion, position: Vector, landed: bool) -> None:
        """Advance by `dt_s`. `attitude`: `ned_from_body` (w, x, y, z); `position`: NED metres."""
        if self._revision != self._parameters.revision:
            self._load()
        self._now_s += dt_s
        self._slew(dt_s, position)
        pan, tilt = self._joints(attitude)
        if math.isfinite(self.furthest_rad):
            pan = min(max(pan, -self.furthest_rad), self.furthest_rad)
        low, high = self.lowest_rad, self.highest_rad
        if landed:
            low, high = max(low, self._landed_rad[0]), min(high, self._landed_rad[1])
        tilt = min(max(tilt, low), max(low, high))
        reach = JOINT_RADPS * dt_s
        turn = pan - self.pan_rad
        if math.isinf(self.furthest_rad):
            turn = math.remainder(turn, math.tau)
        turn = min(max(turn, -reach), reach)
        rise = min(max(tilt - self.tilt_rad, -reach), reach)
        self.pan_rad = (
            math.remainder(self.pan_rad + turn, math.tau)
            if math.isinf(self.furthest_rad)
            else (self.pan_rad + turn)
        )
        self.tilt_rad += rise
        if dt_s > 0.0:
            self.pan_rate_radps, self.tilt_rate_radps = turn / dt_s, rise / dt_s
        self._aim_angles(attitude)

    def _aim_angles(self, attitude: Quaternion) -> None:
        """The pose that follows from the joints."""
        self.quaternion = quaternion_product(attitude, self.body_quaternion)
        x, y, z = _x_axis(self.quaternion)
        self.pitch_rad = math.asin(min(max(-z, -1.0), 1.0))
        if math.hypot(x, y) > 1e-6:
            self.yaw_rad = math.atan2(y, x)
        target = self.target
        if target.aim is not Aim.ANGLES:
            return
        # at a limit, a rate must not run ahead of the gimbal
        if target.pitch_rate_radps == target.pitch_rate_radps and self._at_tilt_stop():
            self._aim_pitch_rad = self.pitch_rad if self._pitch_is_locked else self.tilt_rad
        if target.yaw_rate_radps == target.yaw_rate_radps and abs(self.pan_rad) >= self.furthest_rad - 1e-9:
            self._aim_yaw_rad = self.yaw_rad if self._yaw_is_locked else self.pan_rad

    def _at_tilt_stop(self) -> bool:
        return self.tilt_rad <= self.lowest_rad + 1e-9 or self.tilt_rad >= self.highest_rad - 1e-9

    def _slew(self, dt_s: float, position: Vector) -> None:
        target = self.target
        reach = SLEW_RADPS * dt_s
        if target.aim is Aim.ANGLES:
            silent = self._now_s - self._pointed_s > RATE_TIMEOUT_S
            self._aim_pitch_rad = _moved(
                self._aim_pitch_rad, target.pitch_rad, target.pitch_rate_radps, silent, reach, dt_s, False
            )
            self._aim_yaw_rad = _moved(
                self._aim_yaw_rad, target.yaw_rad, target.yaw_rate_radps, silent, reach, dt_s, True
            )
            return
        pitch, yaw = 0.0, 0.0
        if target.aim is Aim.LOCATION:
            north, east, down = (there - here for there, here in zip(target.location, position, strict=True))
            level = math.hypot(north, east)
            pitch = math.atan2(-down, level) if level > 0.0 or down != 0.0 else 0.0
            yaw = math.atan2(east, north) if level > 0.0 else self._aim_yaw_rad
        self._aim_pitch_rad = _moved(self._aim_pitch_rad, pitch, math.nan, False, reach, dt_s, False)
        self._aim_yaw_rad = _moved(self._aim_yaw_rad, yaw, math.nan, False, reach, dt_s, True)

    def _joints(self, attitude: Quaternion) -> tuple[float, float]:
        """(pan, tilt) of the aim."""
        if not self._pitch_is_locked and not self._yaw_is_locked:
            return self._aim_yaw_rad, self._aim_pitch_rad
        if self._pitch_is_locked and self._yaw_is_locked:
            level = math.cos(self._aim_pitch_rad)
            sight = (
                level * math.cos(self._aim_yaw_rad),
                level * math.sin(self._aim_yaw_rad),
                -math.sin(self._aim_pitch_rad),
            )
            x, y, z = turned_back(rotation_matrix(attitude), sight)
            level = math.hypot(x, y)
            pan = math.atan2(y, x) if level > 1e-6 else self.pan_rad
            tilt = math.atan2(-z, level)
            return pan, tilt
        if self._pitch_is_locked:
            return self._aim_yaw_rad, _tilt_for_pitch(attitude, self._aim_yaw_rad, self._aim_pitch_rad)
        tilt = self._aim_pitch_rad
        north, east, _ = _x_axis(attitude)
        heading = math.atan2(east, north)
        return math.remainder(self._aim_yaw_rad - heading, math.tau), tilt


def _moved(
    aim: float, angle: float, rate: float, silent: bool, reach: float, dt_s: float, wraps: bool
) -> float:
    """An aim after `dt_s`: towards the angle, at the rate, or both."""
    has_angle, has_rate = angle == angle, rate == rate
    if not has_angle:
        aim += 0.0 if silent or not has_rate else rate * dt_s
        return math.remainder(aim, math.tau) if wraps else aim
    left = angle - aim
    if wraps:
        left = math.remainder(left, math.tau)
    if has_rate:
        reach = 0.0 if silent else min(reach, abs(rate) * dt_s)
    moved = aim + min(max(left, -reach), reach)
    return math.remainder(moved, math.tau) if wraps else moved


def _tilt_for_pitch(attitude: Quaternion, pan_rad: float, pitch_rad: float) -> float:
    """The tilt that, panned so, puts the optical axis `pitch_rad` above the horizon, or nearly so."""
    # down component of the axis: a cos(tilt) - b sin(tilt)
    row = _down_row(attitude)
    a = row[0] * math.cos(pan_rad) + row[1] * math.sin(pan_rad)
    b = row[2]
    length = math.hypot(a, b)
    if length < 1e-6:
        return 0.0
    angle = math.acos(min(max(-math.sin(pitch_rad) / length, -1.0), 1.0))
    return math.remainder(angle - math.atan2(b, a), math.tau)


def _down_row(q: Quaternion) -> Vector:
    """How much of body x, y and z points down."""
    w, x, y, z = q
    return (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))


def _x_axis(q: Quaternion) -> Vector:
    w, x, y, z = q
    return (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))


def _about_z(angle: float) -> Quaternion:
    return (math.cos(angle / 2.0), 0.0, 0.0, math.sin(angle / 2.0))


def _about_y(angle: float) -> Quaternion:
    return (math.cos(angle / 2.0), 0.0, math.sin(angle / 2.0), 0.0)
