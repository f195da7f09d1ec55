"""The estimate under faults: it jumps, drifts, rotates or ends, and the messages that show it.

Without a horizontal position it behaves as PX4's EKF2 without aiding: dead reckoning for EKF2_NOAID_TOUT,
then an assumed standstill while height and attitude stay valid. PX4 continues to send LOCAL_POSITION_NED,
GLOBAL_POSITION_INT and ODOMETRY meanwhile: only ESTIMATOR_STATUS, GPS_RAW_INT and the mode show it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterable
from typing import Any

from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.estimate_errors import Estimate
from mavlink_sim.physics.rotations import Vector

ZERO: Vector = (0.0, 0.0, 0.0)
# ESTIMATOR_STATUS_FLAGS without horizontal aiding: attitude, vertical speed, height, height above ground,
# and CONST_POS_MODE
FLAGS_WITHOUT_POSITION = 1 | 4 | 32 | 64 | 128
NO_FIX = 1  # GPS_FIX_TYPE
UNKNOWN_ACCURACY_M = 100.0
_GPS_SENSOR = 0x20  # MAV_SYS_STATUS_SENSOR_GPS
_U16_UNKNOWN = 65535


class FallibleEstimate(Estimate):
    """The estimate of `estimator` with the errors of faults.

    Attributes:
        held_xy_m: horizontal position at which the estimate is frozen; None: not frozen.
        reset_counter: number of resets of the estimate, as in ODOMETRY (0..255).
        position_valid: horizontal position and velocity are usable for control.
        fix_lost: number of active faults that take the GPS fix; 0: there is a fix.
        gps_drift: NED metres of the receiver's error; by fault number.
    """

    __slots__ = (
        "_errors",
        "fix_lost",
        "gps_drift",
        "held_xy_m",
        "position_valid",
        "reset_counter",
    )

    def __init__(self, truth: Multirotor, seed: int = 0, noise: float = 1.0) -> None:
        self._errors: dict[int, tuple[Vector, Vector, float]] = {}
        self.held_xy_m: tuple[float, float] | None = None
        self.reset_counter = 0
        self.position_valid = True
        self.fix_lost = 0
        self.gps_drift: dict[int, Vector] = {}
        super().__init__(truth, seed, noise)

    def set_error(
        self, number: int, position_m: Vector | None, velocity_mps: Vector = ZERO, yaw_rad: float = 0.0
    ) -> None:
        """Set the error (NED) that a fault adds to the estimate from the next update on; None: none."""
        if position_m is None:
            self._errors.pop(number, None)
        else:
            self._errors[number] = (position_m, velocity_mps, yaw_rad)
        self.offset = _sum(error[0] for error in self._errors.values())
        self.yaw_offset_rad = sum(error[2] for error in self._errors.values())

    def restart(self, faults: Collection[int]) -> None:
        """Restart the filter; the errors of the faults with these numbers stay."""
        for number in [number for number in self._errors if number not in faults]:
            self.set_error(number, None)
        self.reset_counter = 0
        self.held_xy_m = None
        self.update(0.0)
        self.position_valid = not self.fix_lost
        if self.fix_lost:
            x, y, _ = self.position
            self.held_xy_m = (x, y)
            self.update(0.0)

    def count_reset(self, resets: int = 1) -> None:
        """Count resets of the estimate."""
        self.reset_counter = (self.reset_counter + resets) & 0xFF

    def refresh(self) -> None:
        """Update from the truth, with all current errors."""
        Estimate.refresh(self)  # super() takes twice as long
        if self.held_xy_m is not None:
            self.position = (*self.held_xy_m, self.position[2])
            self.velocity = (0.0, 0.0, self.velocity[2])
        elif self._errors:
            vx, vy, vz = self.velocity
            ex, ey, ez = _sum(error[1] for error in self._errors.values())
            self.velocity = (vx + ex, vy + ey, vz + ez)

    @property
    def gps_position(self) -> Vector:
        """The GPS receiver's position, NED metres, without the filter's errors."""
        return _sum((self.truth.position, self.gps_error, *self.gps_drift.values()))


def _sum(vectors: Iterable[Vector]) -> Vector:
    north = east = down = 0.0
    for x, y, z in vectors:
        north, east, down = north + x, east + y, down + z
    return (north, east, down)


# ---- effect on messages


def as_reported(estimate: FallibleEstimate, message: Any) -> Any:
    """The message as PX4 sends it during or after an error of the estimate."""
    amend = _AMENDMENTS.get(message.get_type())
    if amend is None:
        return message
    reported = copy.copy(message)
    amend(estimate, reported)
    return reported


def _odometry(estimate: FallibleEstimate, message: Any) -> None:
    message.reset_counter = estimate.reset_counter
    if not estimate.position_valid:
        covariance = list(message.pose_covariance)
        covariance[0] = covariance[6] = UNKNOWN_ACCURACY_M**2
        message.pose_covariance = covariance


def _gps_raw_int(estimate: FallibleEstimate, message: Any) -> None:
    if estimate.fix_lost:
        message.fix_type, message.satellites_visible = NO_FIX, 0
        message.eph = message.epv = message.cog = message.vel = _U16_UNKNOWN
        message.h_acc = message.v_acc = round(UNKNOWN_ACCURACY_M * 1000)


def _estimator_status(estimate: FallibleEstimate, message: Any) -> None:
    if not estimate.position_valid:
        message.flags = FLAGS_WITHOUT_POSITION
        message.pos_horiz_accuracy = UNKNOWN_ACCURACY_M


def _sys_status(estimate: FallibleEstimate, message: Any) -> None:
    if estimate.fix_lost:
        message.onboard_control_sensors_health &= ~_GPS_SENSOR


_AMENDMENTS: dict[str, Callable[[FallibleEstimate, Any], None]] = {
    "ODOMETRY": _odometry,
    "GPS_RAW_INT": _gps_raw_int,
    "ESTIMATOR_STATUS": _estimator_status,
    "SYS_STATUS": _sys_status,
}
