"""Autopilot profiles: modes, streams, take-off and parameter encoding of each firmware.

`Px4Profile` here, `ArduPilotProfile` in `ardupilot_profile.py`; the first heartbeat selects one.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.framing import CURRENT_MODE_ID
from companion.vehicle.px4_modes import request_of_mode
from companion.vehicle.state import FlightMode, VehicleState
from companion.vehicle.telemetry import Fields
from companion.vehicle.vehicle_type import AUTOPILOT_NAMES, PX4

HOME_POSITION_ID = 242
ESTIMATOR_STATUS_ID = 230
ODOMETRY_ID = 331
DISTANCE_SENSOR_ID = 132
POSITION_TARGET_ID = 85  # POSITION_TARGET_LOCAL_NED
# Its period, 187 ms, has no factor in common with the usual ones of setpoints (20, 100, 500 ms): with 100 ms,
# Copter reported 2 of 130 setpoints that another program sent at 2 and 10 Hz.
POSITION_TARGET_HZ = 1.0 / 0.187


class AutopilotProfile(ABC):
    """The firmware-specific behaviour of one autopilot.

    A profile may remember the requested mode or take-off; `clear_request` undoes that.

    Attributes:
        name: for display. rates_hz: message id → requested rate, Hz, of the messages that are used.
        expected_hz: message id → resulting rate, where it differs from the requested one.
        optional: ids in `rates_hz` that not every version has.
        once: ids in `rates_hz` of equipment that a vehicle may lack, and of what it sends in some modes only:
            they are requested once where they are missing, and are not missing afterwards.
        requested: ids that are also requested once, while home is unknown.
        parameters_bytewise: integer parameters are sent as their bytes; else as numbers.
        takeoff_needs_home: NAV_TAKEOFF takes an altitude AMSL, which needs home's altitude.
        has_events: it reports by EVENT, with metadata; else by STATUSTEXT only.
    """

    name: str
    rates_hz: dict[int, float]
    expected_hz: Mapping[int, float] = MappingProxyType({})
    optional: tuple[int, ...] = ()
    once: tuple[int, ...] = (DISTANCE_SENSOR_ID, POSITION_TARGET_ID)
    requested: tuple[int, ...] = (HOME_POSITION_ID,)
    parameters_bytewise: bool
    takeoff_needs_home: bool
    has_events: bool

    def translate(self, name: str, fields: Fields, state: VehicleState) -> list[tuple[str, Fields]]:
        """Return the messages, in PX4's terms, to apply for one message; by default that message."""
        return [(name, fields)]

    @abstractmethod
    def mode_request(self, mode: FlightMode, state: VehicleState) -> int:
        """Return the custom_mode to request for a mode. Raises ValueError if it cannot be requested."""

    @abstractmethod
    def mode_parameters(self, custom_mode: int) -> tuple[int, int]:
        """Return DO_SET_MODE's parameters 2 and 3 for a custom_mode."""

    @abstractmethod
    def takeoff_parameters(self, altitude_m: float, state: VehicleState) -> tuple[float, ...]:
        """Return NAV_TAKEOFF's parameters for a height above home, metres. Raises CommandRefusedError."""

    def takeoff_mode(self) -> int | None:
        """Return the custom_mode of a take-off; None: it is none of its own."""
        return None

    def on_takeoff_accepted(self) -> list[tuple[str, Fields]]:
        """Return the messages to apply after an accepted take-off."""
        return []

    def clear_request(self) -> None:  # noqa: B027 - PX4 reports its mode by itself
        """Drop the remembered request after it was rejected."""

    def setpoint_fields(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Adapt the fields of SET_POSITION_TARGET_LOCAL_NED to this autopilot."""
        return fields


class Px4Profile(AutopilotProfile):
    """PX4. Its onboard link sends most of the streams without a request."""

    name = AUTOPILOT_NAMES[PX4]
    parameters_bytewise = True
    takeoff_needs_home = True
    has_events = True
    rates_hz = {  # noqa: RUF012 - a constant table
        31: 50.0,  # ATTITUDE_QUATERNION
        32: 30.0,  # LOCAL_POSITION_NED
        33: 5.0,  # GLOBAL_POSITION_INT
        1: 2.0,  # SYS_STATUS
        245: 5.0,  # EXTENDED_SYS_STATE
        CURRENT_MODE_ID: 10.0,  # sent on change; HEARTBEAT reports a mode up to 1 s late
        HOME_POSITION_ID: 0.5,
        ESTIMATOR_STATUS_ID: 5.0,
        ODOMETRY_ID: 5.0,  # for its reset_counter
        DISTANCE_SENSOR_ID: 10.0,
        POSITION_TARGET_ID: POSITION_TARGET_HZ,
    }
    expected_hz = MappingProxyType({CURRENT_MODE_ID: 2.0})  # PX4 repeats it every 0.5 s, not more often
    optional = (CURRENT_MODE_ID, ESTIMATOR_STATUS_ID, ODOMETRY_ID)  # PX4 has CURRENT_MODE since 1.15

    def mode_request(self, mode: FlightMode, state: VehicleState) -> int:
        main, sub = request_of_mode(mode)
        return main << 16 | sub << 24

    def mode_parameters(self, custom_mode: int) -> tuple[int, int]:
        return custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF

    def takeoff_mode(self) -> int:
        return self.mode_request(FlightMode.TAKEOFF, VehicleState())

    def takeoff_parameters(self, altitude_m: float, state: VehicleState) -> tuple[float, ...]:
        if state.home_altitude_amsl_m is None:
            raise CommandRefusedError(
                "home position not received: take-off needs home's altitude (no position estimate yet?)"
            )
        nan = math.nan  # at the present position and heading
        return (nan, nan, nan, nan, nan, nan, state.home_altitude_amsl_m + altitude_m)
