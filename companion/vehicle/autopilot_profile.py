"""What a driver must know of the autopilot it speaks to: modes, streams, take-off, how parameters travel.

`Px4Profile` here, `ArduPilotProfile` in `ardupilot_profile.py`; the first heartbeat decides which.
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

PX4, ARDUPILOT = 12, 3  # MAV_AUTOPILOT
HOME_POSITION_ID = 242
ESTIMATOR_STATUS_ID = 230
ODOMETRY_ID = 331


class AutopilotProfile(ABC):
    """One autopilot's ways. Whoever is asked for a mode or a take-off may remember it (`forget` undoes it).

    Attributes:
        name: for people. rates_hz: what is read, by message id, and the rate that is asked for.
        expected_hz: the rate that comes of it, where that is another one.
        optional: of these the messages that not every version has.
        requested: messages that are requested besides while home is not known.
        parameters_bytewise: integer parameters travel as their bytes; else as numbers.
        takes_off_by_home: a take-off is commanded as an altitude AMSL, which home's altitude is needed for.
        has_events: it speaks by EVENT, with metadata; else by STATUSTEXT alone.
    """

    name: str
    rates_hz: dict[int, float]
    expected_hz: Mapping[int, float] = MappingProxyType({})
    optional: tuple[int, ...] = ()
    requested: tuple[int, ...] = (HOME_POSITION_ID,)
    parameters_bytewise: bool
    takes_off_by_home: bool
    has_events: bool

    def translate(self, name: str, fields: Fields, state: VehicleState) -> list[tuple[str, Fields]]:
        """A message of the autopilot in PX4's terms: what is to be taken in for it, often itself."""
        return [(name, fields)]

    @abstractmethod
    def mode_request(self, mode: FlightMode, state: VehicleState) -> tuple[FlightMode, int, int]:
        """The mode that will be shown, and DO_SET_MODE's parameters 2 and 3.

        Raises ValueError for a mode that cannot be asked for.
        """

    @abstractmethod
    def takeoff_parameters(self, altitude_m: float, state: VehicleState) -> tuple[float, ...]:
        """NAV_TAKEOFF's parameters for a height above home. Raises CommandRefusedError."""

    def takes_off(self) -> list[tuple[str, Fields]]:
        """A take-off was accepted; what is to be taken in for that."""
        return []

    def forget(self) -> None:  # noqa: B027 - PX4 shows what was asked for by itself
        """What was asked for was refused."""

    def setpoint_fields(self, fields: dict[str, Any]) -> dict[str, Any]:
        """SET_POSITION_TARGET_LOCAL_NED, so that this autopilot understands it as PX4 does."""
        return fields


class Px4Profile(AutopilotProfile):
    """PX4's. Its onboard link has most of the streams unasked."""

    name = "PX4"
    parameters_bytewise = True
    takes_off_by_home = True
    has_events = True
    rates_hz = {  # noqa: RUF012 - a table, never changed
        31: 50.0,  # ATTITUDE_QUATERNION
        32: 30.0,  # LOCAL_POSITION_NED
        33: 5.0,  # GLOBAL_POSITION_INT
        1: 2.0,  # SYS_STATUS
        245: 5.0,  # EXTENDED_SYS_STATE
        CURRENT_MODE_ID: 10.0,  # HEARTBEAT alone shows a mode up to 1 s late; this comes when it changes
        HOME_POSITION_ID: 0.5,
        ESTIMATOR_STATUS_ID: 5.0,
        ODOMETRY_ID: 5.0,  # for its reset_counter
    }
    expected_hz = MappingProxyType({CURRENT_MODE_ID: 2.0})  # PX4 repeats it every 0.5 s, not more often
    optional = (CURRENT_MODE_ID, ESTIMATOR_STATUS_ID, ODOMETRY_ID)  # PX4 has CURRENT_MODE since 1.15

    def mode_request(self, mode: FlightMode, state: VehicleState) -> tuple[FlightMode, int, int]:
        main, sub = request_of_mode(mode)
        return mode, main, sub

    def takeoff_parameters(self, altitude_m: float, state: VehicleState) -> tuple[float, ...]:
        if state.home_altitude_amsl_m is None:
            raise CommandRefusedError(
                "take-off needs home's altitude, and the vehicle has not told it (no position yet?)"
            )
        nan = math.nan  # here, with this heading
        return (nan, nan, nan, nan, nan, nan, state.home_altitude_amsl_m + altitude_m)
