"""ArduPilot Copter's behaviour mapped to PX4's terms, so that the code above the driver supports both.

Differences from PX4, and how they are handled:

* GUIDED is one mode where PX4 has several: armed and waiting, taking off, holding, flying setpoints. It is
  reported as the mode requested last (HOLD, TAKEOFF, HOLD again at the take-off altitude, OFFBOARD). GUIDED
  that was set by another station is reported as OFFBOARD.
* HOLD is BRAKE in the air. BRAKE does not allow arming, so on the ground HOLD is GUIDED.
* A take-off goes to a height above home, in GUIDED, armed.
* **There is no failsafe that leaves GUIDED when setpoints stop.** A velocity is flown for GUID_TIMEOUT (3 s)
  more, then the vehicle stops, in GUIDED; a position is flown to and held indefinitely. So the braking
  setpoint that the streamer sends before it stops sending is what stops the vehicle. RTL or LAND on our
  silence needs FS_GCS_ENABLE with SYSID_MYGCS (MAV_GCS_SYSID since 4.7) set to our system id.
* A setpoint without yaw turns the nose into the direction of flight (WP_YAW_BEHAVIOR). Ours keep the heading,
  so they are sent with a yaw rate of zero.
* HOME_POSITION's local position is always zero; it is computed from GPS_GLOBAL_ORIGIN.
* EKF_STATUS_REPORT has the flags of PX4's ESTIMATOR_STATUS. No message counts estimator resets: they are
  detected by the jump of the position.
* Hardly any stream is sent without a request; parameters are sent as numbers, whatever their type.

The flight modes (HEARTBEAT.custom_mode, parameter 2 of MAV_CMD_DO_SET_MODE) have PX4's names, mapped by
behaviour: GUIDED is OFFBOARD, LOITER is POSITION, BRAKE is HOLD.
"""

from __future__ import annotations

import math
from typing import Any

from companion.vehicle.autopilot_profile import (
    DISTANCE_SENSOR_ID,
    HOME_POSITION_ID,
    POSITION_TARGET_HZ,
    POSITION_TARGET_ID,
    AutopilotProfile,
)
from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.framing import EKF_STATUS_REPORT_ID
from companion.vehicle.setpoint import IGNORE_ACCELERATION, IGNORE_YAW, IGNORE_YAW_RATE
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.telemetry import Fields
from companion.vehicle.vehicle_type import ARDUPILOT, AUTOPILOT_NAMES, NOT_KNOWN_YET, why_not_flown

GUIDED, BRAKE = 4, 17

_MODES: dict[int, FlightMode] = {
    0: FlightMode.STABILIZED,
    1: FlightMode.ACRO,
    2: FlightMode.ALTITUDE,
    3: FlightMode.MISSION,
    GUIDED: FlightMode.OFFBOARD,
    5: FlightMode.POSITION,  # LOITER: flown by sticks
    6: FlightMode.RETURN,
    9: FlightMode.LAND,
    16: FlightMode.POSITION,  # POSHOLD
    BRAKE: FlightMode.HOLD,
    21: FlightMode.RETURN,  # SMART_RTL
    23: FlightMode.FOLLOW,
    27: FlightMode.RETURN,  # AUTO_RTL
}
_REQUESTS = {mode: number for number, mode in reversed(_MODES.items())}
GPS_GLOBAL_ORIGIN_ID = 49
_IN_AIR = 2  # MAV_LANDED_STATE_IN_AIR
_EARTH_RADIUS_M = 6_371_000.0
_METRES_PER_UNIT = math.radians(1e-7) * _EARTH_RADIUS_M  # of latitude


def mode_of_custom_mode(custom_mode: int) -> FlightMode:
    """Return the mode of a custom_mode; UNKNOWN for modes without an equivalent here."""
    return _MODES.get(custom_mode, FlightMode.UNKNOWN)


def custom_mode_of_mode(mode: FlightMode) -> int:
    """Return the custom_mode to request. Raises ValueError for a mode that Copter does not have."""
    if mode not in _REQUESTS:
        raise ValueError(f"ArduPilot has no mode {mode!s}; available: {', '.join(_REQUESTS)}")
    return _REQUESTS[mode]


class ArduPilotProfile(AutopilotProfile):
    """ArduPilot Copter; see the module docstring."""

    name = AUTOPILOT_NAMES[ARDUPILOT]
    parameters_bytewise = False
    takeoff_needs_home = False
    has_events = False
    requested = (HOME_POSITION_ID, GPS_GLOBAL_ORIGIN_ID)
    rates_hz = {  # noqa: RUF012 - a constant table
        0: 5.0,  # HEARTBEAT: no other message reports the mode
        31: 50.0,  # ATTITUDE_QUATERNION
        32: 30.0,  # LOCAL_POSITION_NED
        33: 5.0,  # GLOBAL_POSITION_INT
        1: 2.0,  # SYS_STATUS
        245: 5.0,  # EXTENDED_SYS_STATE
        HOME_POSITION_ID: 0.5,
        GPS_GLOBAL_ORIGIN_ID: 0.5,
        EKF_STATUS_REPORT_ID: 5.0,
        DISTANCE_SENSOR_ID: 10.0,
        POSITION_TARGET_ID: POSITION_TARGET_HZ,
    }
    optional = (EKF_STATUS_REPORT_ID,)

    def __init__(self) -> None:
        self._guided_use = FlightMode.OFFBOARD  # what GUIDED is reported as
        self._seen_guided = False
        self._origin: Fields | None = None

    def translate(self, name: str, fields: Fields, state: VehicleState) -> list[tuple[str, Fields]]:
        if name in ("HEARTBEAT", "CURRENT_MODE"):
            return [(name, {**fields, "flight_mode": self._mode(fields, state)})]
        if name == "EXTENDED_SYS_STATE" and self._guided_use is FlightMode.TAKEOFF:
            if fields["landed_state"] == _IN_AIR and state.landed is LandedState.TAKING_OFF:
                self._guided_use = FlightMode.HOLD  # take-off finished: it waits for setpoints
                return [(name, fields), _mode_message(FlightMode.HOLD)]
        elif name == "GPS_GLOBAL_ORIGIN":
            self._origin = fields
        elif name == "HOME_POSITION":
            return [(name, {**fields, **self._local(fields)})]
        elif name == "EKF_STATUS_REPORT":
            return [("ESTIMATOR_STATUS", fields)]
        return [(name, fields)]

    def _mode(self, fields: Fields, state: VehicleState) -> FlightMode:
        """Return the mode; UNKNOWN for a vehicle that is not Copter, whose numbers mean other modes."""
        mav_type, autopilot = fields.get("type", state.mav_type), fields.get("autopilot", state.mav_autopilot)
        custom_mode: int = fields["custom_mode"]
        if mav_type is not None and autopilot is not None:
            why = why_not_flown(mav_type, autopilot, state.vtol_state, is_plane=state.is_plane)
            if autopilot != ARDUPILOT or why not in (None, *NOT_KNOWN_YET):
                return FlightMode.UNKNOWN
        if custom_mode == GUIDED:
            self._seen_guided = True
            return self._guided_use
        if self._seen_guided:  # GUIDED was left: the next GUIDED was not requested by us
            self.clear_request()
        return mode_of_custom_mode(custom_mode)

    def _local(self, home: Fields) -> dict[str, float | None]:
        """Home in local NED, metres from the EKF origin; None values while the origin is unknown."""
        origin = self._origin
        if origin is None:
            return {"x": None, "y": None, "z": None}
        scale = math.cos(math.radians(origin["latitude"] * 1e-7))
        return {
            "x": (home["latitude"] - origin["latitude"]) * _METRES_PER_UNIT,
            "y": (home["longitude"] - origin["longitude"]) * _METRES_PER_UNIT * scale,
            "z": (origin["altitude"] - home["altitude"]) * 1e-3,
        }

    def mode_request(self, mode: FlightMode, state: VehicleState) -> int:
        flying = state.armed and state.landed is not LandedState.ON_GROUND
        if mode is FlightMode.OFFBOARD or (mode is FlightMode.HOLD and not flying):
            self._guided_use, self._seen_guided = mode, False
            return GUIDED
        return custom_mode_of_mode(mode)

    def mode_parameters(self, custom_mode: int) -> tuple[int, int]:
        return custom_mode, 0

    def takeoff_parameters(self, altitude_m: float, state: VehicleState) -> tuple[float, ...]:
        if not state.armed:
            raise CommandRefusedError("ArduPilot must be armed before take-off: arm it first")
        return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, altitude_m)

    def on_takeoff_accepted(self) -> list[tuple[str, Fields]]:
        self._guided_use = FlightMode.TAKEOFF
        return [_mode_message(FlightMode.TAKEOFF)]

    def clear_request(self) -> None:
        self._guided_use, self._seen_guided = FlightMode.OFFBOARD, False

    def setpoint_fields(self, fields: dict[str, Any]) -> dict[str, Any]:
        # Copter integrates the acceleration into the velocity setpoint, and goes on for GUID_TIMEOUT (3 s)
        # after setpoints end. So no acceleration is sent.
        fields = {**fields, "type_mask": fields["type_mask"] | IGNORE_ACCELERATION}
        fields.update(dict.fromkeys(("afx", "afy", "afz"), 0.0))
        if not fields["type_mask"] & IGNORE_YAW or not fields["type_mask"] & IGNORE_YAW_RATE:
            return fields
        return {**fields, "type_mask": fields["type_mask"] & ~IGNORE_YAW_RATE, "yaw_rate": 0.0}


def _mode_message(mode: FlightMode) -> tuple[str, Fields]:
    return ("CURRENT_MODE", {"flight_mode": mode})
