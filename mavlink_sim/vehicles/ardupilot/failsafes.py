"""Copter's failsafes for the ground station (FS_GCS_*), the EKF's position (FS_EKF_ACTION) and the fence."""

from __future__ import annotations

import math
from collections import deque
from typing import Protocol

from mavlink_sim.autopilot.home import Home
from mavlink_sim.physics.airframe import Vector
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.vehicles.ardupilot.modes import WITHOUT_POSITION, CopterMode
from mavlink_sim.wire.announcements import CRITICAL, Text

WARNING, NOTICE = 4, 5  # MAV_SEVERITY_WARNING, MAV_SEVERITY_NOTICE
POSITION_LOST_S = 1.0
FENCE_ALTITUDE, FENCE_CIRCLE = 1, 2  # bits of FENCE_TYPE
STOP_AT_FENCE = 1  # a bit of AVOID_ENABLE
# Speed towards the circle, less FENCE_MARGIN, per remaining metre.
AVOIDANCE_GAIN_PER_S = 1.0
# FS_GCS_ENABLE: 1 RTL, 2 AUTO or RTL, 3 and 4 SMART_RTL, 5 LAND, 7 BRAKE or LAND. There is no SMART_RTL here.
_GCS_MODES = {
    1: CopterMode.RTL,
    2: CopterMode.RTL,
    3: CopterMode.RTL,
    4: CopterMode.LAND,
    5: CopterMode.LAND,
    6: CopterMode.RTL,
    7: CopterMode.BRAKE,
}
# FENCE_ACTION: 1 RTL or LAND, 2 LAND, 3 SMART_RTL or RTL or LAND, 4 BRAKE or LAND, 5 SMART_RTL or LAND.
_FENCE_MODES = {
    1: CopterMode.RTL,
    2: CopterMode.LAND,
    3: CopterMode.RTL,
    4: CopterMode.BRAKE,
    5: CopterMode.LAND,
}
_GOING_DOWN = (CopterMode.LAND, CopterMode.RTL)


class FailsafeAutopilot(Protocol):
    """What the failsafes use of the autopilot; see `autopilot.CopterAutopilot`."""

    now_s: float
    armed: bool
    mode: CopterMode
    failsafe: bool
    position_valid: bool
    home: Home
    texts: deque[Text]

    @property
    def landed(self) -> bool: ...

    @property
    def position(self) -> Vector: ...

    def disarm(self, force: bool = False, by: str = ...) -> int: ...

    def change_mode(self, mode: CopterMode) -> None: ...

    def restart_task(self) -> None: ...

    def announce(self, line: str) -> None: ...


class Failsafes:
    """Copter's automatic mode changes.

    Attributes:
        ground_station_seen_s: the newest heartbeat of SYSID_MYGCS. is_breached: outside the fence.
    """

    def __init__(self, autopilot: FailsafeAutopilot, parameters: Parameters) -> None:
        self._autopilot = autopilot
        self._parameters = parameters
        self.ground_station_seen_s = math.nan
        self._gcs_lost = self._ekf_lost = False
        self.is_breached = False
        self._position_seen_s = 0.0

    def mode_was_chosen(self) -> None:
        """Note a mode request: an active failsafe does not override it."""
        self._autopilot.failsafe = self._gcs_lost or self._ekf_lost

    def disarmed(self) -> None:
        self._gcs_lost = self._ekf_lost = False

    def update(self) -> None:
        self._check_ground_station()
        self._check_position()
        self._check_fence()
        self._autopilot.failsafe = self._gcs_lost or self._ekf_lost

    def avoid_fence(self, velocity: Vector) -> Vector:
        """A commanded velocity limited towards the fence circle; its tangential component is unchanged."""
        value, autopilot = self._parameters.number, self._autopilot
        circle = value("FENCE_ENABLE") and int(value("FENCE_TYPE")) & FENCE_CIRCLE
        if not circle or not int(value("AVOID_ENABLE")) & STOP_AT_FENCE:
            return velocity
        north, east, _ = (
            point - home for point, home in zip(autopilot.position, autopilot.home.position, strict=True)
        )
        distance_m = max(math.hypot(north, east), 1e-6)
        north, east = north / distance_m, east / distance_m
        left_m = value("FENCE_RADIUS") - value("FENCE_MARGIN") - distance_m
        outwards_mps = north * velocity[0] + east * velocity[1]
        too_fast_mps = max(0.0, outwards_mps - max(0.0, AVOIDANCE_GAIN_PER_S * left_m))
        return (velocity[0] - too_fast_mps * north, velocity[1] - too_fast_mps * east, velocity[2])

    def _check_ground_station(self) -> None:
        autopilot, value = self._autopilot, self._parameters.number
        if math.isnan(self.ground_station_seen_s):
            return  # without a first heartbeat it is not lost
        action = int(value("FS_GCS_ENABLE"))
        silent_s = autopilot.now_s - self.ground_station_seen_s
        lost = action in _GCS_MODES and autopilot.armed and silent_s > value("FS_GCS_TIMEOUT")
        if lost is self._gcs_lost:
            return
        self._gcs_lost = lost
        if not lost:
            self._send_text("GCS Failsafe Cleared")
            return
        self._send_text("GCS Failsafe")
        autopilot.announce("failsafe: ground station lost")
        if autopilot.landed:
            autopilot.disarm(force=True, by="failsafe")
        elif autopilot.mode is not CopterMode.LAND:
            self._change(_GCS_MODES[action])

    def _check_position(self) -> None:
        autopilot = self._autopilot
        if autopilot.position_valid:
            self._position_seen_s = autopilot.now_s
            if self._ekf_lost:
                self._ekf_lost = False
                autopilot.texts.append(Text(CRITICAL, "EKF Failsafe Cleared"))
            return
        blind_s = autopilot.now_s - self._position_seen_s
        if self._ekf_lost or not autopilot.armed or blind_s < POSITION_LOST_S:
            return
        if not self._parameters.number("FS_EKF_ACTION"):
            return
        if autopilot.mode in WITHOUT_POSITION and autopilot.mode is not CopterMode.LAND:
            return
        self._ekf_lost = True
        autopilot.announce("failsafe: position lost")
        if autopilot.mode is CopterMode.LAND:
            autopilot.restart_task()  # it descends without a position
        else:
            autopilot.change_mode(CopterMode.LAND)
        autopilot.texts.append(Text(CRITICAL, f"EKF Failsafe: changed to {autopilot.mode.title} Mode"))

    def _check_fence(self) -> None:
        autopilot, value = self._autopilot, self._parameters.number
        breach = self._breach() if value("FENCE_ENABLE") else None
        was_breached, self.is_breached = self.is_breached, breach is not None
        if breach is None or was_breached or not autopilot.armed or autopilot.landed:
            return
        autopilot.texts.append(Text(NOTICE, f"{breach} fence breached"))
        autopilot.announce(f"{breach} fence breached")
        mode = _FENCE_MODES.get(int(value("FENCE_ACTION")))
        if mode is not None and autopilot.mode not in _GOING_DOWN:
            self._change(mode)

    def _breach(self) -> str | None:
        autopilot, value = self._autopilot, self._parameters.number
        kinds = int(value("FENCE_TYPE"))
        north, east, down = (
            point - home for point, home in zip(autopilot.position, autopilot.home.position, strict=True)
        )
        if kinds & FENCE_ALTITUDE and -down > value("FENCE_ALT_MAX"):
            return "Max Alt"
        if kinds & FENCE_CIRCLE and math.hypot(north, east) > value("FENCE_RADIUS"):
            return "Circle"
        return None

    def _change(self, mode: CopterMode) -> None:
        """The failsafe's mode, or LAND where that one needs a position."""
        blind = not self._autopilot.position_valid and mode not in WITHOUT_POSITION
        self._autopilot.change_mode(CopterMode.LAND if blind else mode)

    def _send_text(self, text: str) -> None:
        self._autopilot.texts.append(Text(WARNING, text))
