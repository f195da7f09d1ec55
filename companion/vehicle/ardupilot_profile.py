"""ArduPilot Copter's ways, told in PX4's terms, so that everything above the driver flies both.

What differs, and what is made of it:

* GUIDED is one mode for what PX4 tells apart: waiting armed, taking off, holding, flying setpoints. It is
  shown as what we asked it for last (HOLD, TAKEOFF, then HOLD again at the top, OFFBOARD). A vehicle that
  somebody else put into GUIDED shows OFFBOARD.
* HOLD is BRAKE in the air. BRAKE cannot be armed in, so on the ground HOLD is GUIDED.
* A take-off is to a height above home, in GUIDED, armed.
* **There is no failsafe that leaves GUIDED when setpoints stop.** A velocity is flown for GUID_TIMEOUT (3 s)
  more, then the vehicle stands still, in GUIDED; a position is flown to and held for ever. So the braking
  setpoint that our streamer sends before it falls silent is what stops the vehicle, and RTL or LAND on our
  silence is for FS_GCS_ENABLE with SYSID_MYGCS (MAV_GCS_SYSID since 4.7) set to our system id.
* A setpoint without any yaw turns the nose into the direction of flight (WP_YAW_BEHAVIOR); ours keep the
  heading, so they go out with a yaw rate of zero.
* HOME_POSITION's local position is always zero; it is computed from GPS_GLOBAL_ORIGIN.
* EKF_STATUS_REPORT says what PX4's ESTIMATOR_STATUS says, with the same flags. No message counts resets of
  the estimate: they are found by the jump of the position.
* Hardly any stream comes unasked; parameters travel as numbers, whatever their type.
"""

from __future__ import annotations

import math
from typing import Any

from companion.vehicle.ardupilot_modes import GUIDED, custom_mode_of_mode, mode_of_custom_mode
from companion.vehicle.autopilot_profile import HOME_POSITION_ID, AutopilotProfile
from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.framing import EKF_STATUS_REPORT_ID
from companion.vehicle.setpoint import IGNORE_ACCELERATION, IGNORE_YAW, IGNORE_YAW_RATE
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.telemetry import Fields

GPS_GLOBAL_ORIGIN_ID = 49
_IN_AIR = 2  # MAV_LANDED_STATE_IN_AIR
_EARTH_RADIUS_M = 6_371_000.0
_METRES_PER_UNIT = math.radians(1e-7) * _EARTH_RADIUS_M  # of latitude


class ArduPilotProfile(AutopilotProfile):
    """See the module."""

    name = "ArduPilot"
    parameters_bytewise = False
    takes_off_by_home = False
    has_events = False
    requested = (HOME_POSITION_ID, GPS_GLOBAL_ORIGIN_ID)
    rates_hz = {  # noqa: RUF012 - a table, never changed
        0: 5.0,  # HEARTBEAT: there is no other word of the mode
        31: 50.0,  # ATTITUDE_QUATERNION
        32: 30.0,  # LOCAL_POSITION_NED
        33: 5.0,  # GLOBAL_POSITION_INT
        1: 2.0,  # SYS_STATUS
        245: 5.0,  # EXTENDED_SYS_STATE
        HOME_POSITION_ID: 0.5,
        GPS_GLOBAL_ORIGIN_ID: 0.5,
        EKF_STATUS_REPORT_ID: 5.0,
    }
    optional = (EKF_STATUS_REPORT_ID,)

    def __init__(self) -> None:
        self._use = FlightMode.OFFBOARD  # what GUIDED is for
        self._seen_guided = False
        self._origin: Fields | None = None

    def translate(self, name: str, fields: Fields, state: VehicleState) -> list[tuple[str, Fields]]:
        if name in ("HEARTBEAT", "CURRENT_MODE"):
            return [(name, {**fields, "flight_mode": self._mode(fields["custom_mode"])})]
        if name == "EXTENDED_SYS_STATE" and self._use is FlightMode.TAKEOFF:
            if fields["landed_state"] == _IN_AIR and state.landed is LandedState.TAKING_OFF:
                self._use = FlightMode.HOLD  # at the top it waits for setpoints
                return [(name, fields), _shows(FlightMode.HOLD)]
        elif name == "GPS_GLOBAL_ORIGIN":
            self._origin = fields
        elif name == "HOME_POSITION":
            return [(name, {**fields, **self._local(fields)})]
        elif name == "EKF_STATUS_REPORT":
            return [("ESTIMATOR_STATUS", fields)]
        return [(name, fields)]

    def _mode(self, custom_mode: int) -> FlightMode:
        if custom_mode == GUIDED:
            self._seen_guided = True
            return self._use
        if self._seen_guided:  # whatever GUIDED shows next, we have not asked for
            self.forget()
        return mode_of_custom_mode(custom_mode)

    def _local(self, home: Fields) -> dict[str, float | None]:
        """Home in local NED, whose origin is the EKF's; none while that is not known."""
        origin = self._origin
        if origin is None:
            return {"x": None, "y": None, "z": None}
        scale = math.cos(math.radians(origin["latitude"] * 1e-7))
        return {
            "x": (home["latitude"] - origin["latitude"]) * _METRES_PER_UNIT,
            "y": (home["longitude"] - origin["longitude"]) * _METRES_PER_UNIT * scale,
            "z": (origin["altitude"] - home["altitude"]) * 1e-3,
        }

    def mode_request(self, mode: FlightMode, state: VehicleState) -> tuple[FlightMode, int, int]:
        flying = state.armed and state.landed is not LandedState.ON_GROUND
        if mode is FlightMode.OFFBOARD or (mode is FlightMode.HOLD and not flying):
            self._use, self._seen_guided = mode, False
            return mode, GUIDED, 0
        return mode, custom_mode_of_mode(mode), 0

    def takeoff_parameters(self, altitude_m: float, state: VehicleState) -> tuple[float, ...]:
        if not state.armed:
            raise CommandRefusedError("ArduPilot takes off armed: arm it first")
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, altitude_m)

    def takes_off(self) -> list[tuple[str, Fields]]:
        self._use = FlightMode.TAKEOFF
        return [_shows(FlightMode.TAKEOFF)]

    def forget(self) -> None:
        self._use, self._seen_guided = FlightMode.OFFBOARD, False

    def setpoint_fields(self, fields: dict[str, Any]) -> dict[str, Any]:
        # Copter adds an acceleration to the velocity it is to fly, again and again: when setpoints end, for
        # GUID_TIMEOUT (3 s). So it is given none.
        fields = {**fields, "type_mask": fields["type_mask"] | IGNORE_ACCELERATION}
        fields.update(dict.fromkeys(("afx", "afy", "afz"), 0.0))
        if not fields["type_mask"] & IGNORE_YAW or not fields["type_mask"] & IGNORE_YAW_RATE:
            return fields
        return {**fields, "type_mask": fields["type_mask"] & ~IGNORE_YAW_RATE, "yaw_rate": 0.0}


def _shows(mode: FlightMode) -> tuple[str, Fields]:
    return ("CURRENT_MODE", {"flight_mode": mode})
