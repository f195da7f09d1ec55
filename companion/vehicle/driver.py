"""What every driver of a vehicle must do. One contract test runs against all of them.

A driver sends what it is told, once. It repeats nothing by itself: no setpoint, no heartbeat. What repeats
lives in the loop that does the work, so that it stops when that loop stops (see `streamer.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Protocol

from companion.vehicle.gimbal import Address, GimbalAim
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, VehicleState


class LinkError(ConnectionError):
    """The link could not be opened, or no autopilot answers on it. The message is one line for a person."""


class CommandRefusedError(RuntimeError):
    """The vehicle refused, or did not do in time, what was asked. The message says what and why."""


class NoAnswerError(CommandRefusedError):
    """The vehicle is heard, and has not answered. The message says what may be the reason."""


class SystemStatus(IntEnum):
    """MAV_STATE of our own heartbeat."""

    ACTIVE = 4
    CRITICAL = 5


class Driver(Protocol):
    """A link to one autopilot. All methods are called from one asyncio loop.

    `url` is `udpin://HOST:PORT` (listen, as PX4 SITL sends to 14540), `udpout://HOST:PORT`, `tcp://HOST:PORT`
    or `serial:///dev/ttyAMA0:921600`.
    """

    @property
    def library(self) -> str:
        """Which library speaks MAVLink: "mavsdk", "pymavlink", or "auto" while that is not chosen yet."""

    async def connect(self, timeout_s: float) -> None:
        """Open the link and wait for the autopilot's first heartbeat.

        Raises:
            LinkError: the endpoint cannot be opened (busy port, no such device, bad url) or nothing answers.
        """

    async def close(self) -> None:
        """Close the link. Never raises; can be called twice."""

    @property
    def state(self) -> VehicleState:
        """The newest snapshot. A new object whenever a message changed it."""

    def subscribe(self, callback: Callable[[VehicleState], None]) -> Callable[[], None]:
        """Call back in the loop with every new snapshot; returns what ends the subscription."""

    async def arm(self) -> None:
        """Arm, and return when the vehicle shows that it is armed. Raises CommandRefusedError."""

    async def disarm(self) -> None:
        """Disarm (never forced in the air), and return when shown. Raises CommandRefusedError."""

    async def set_mode(self, mode: FlightMode, *, timeout_s: float = 3.0) -> None:
        """Ask for a flight mode, and return when the vehicle SHOWS it (heartbeat or CURRENT_MODE).

        The acknowledgement alone is not believed: PX4 >= 1.16 first acknowledges every DO_SET_MODE.
        Raises CommandRefusedError with what the vehicle shows instead.
        """

    async def takeoff(self, altitude_m: float) -> None:
        """Ask for the autopilot's own take-off to a height above home. Must be armed before or after.

        Raises CommandRefusedError, also when home's altitude is not known yet.
        """

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """Put one SET_POSITION_TARGET_LOCAL_NED on the wire, now. Never raises for a lost link."""

    def send_landing_target(self, target: LandingTarget) -> None:
        """Put one LANDING_TARGET on the wire, now, in the frame that this autopilot takes."""

    def send_heartbeat(
        self, status: SystemStatus, *, uptime_s: float = 0.0, in_command: bool = False
    ) -> None:
        """Put one HEARTBEAT of MAV_TYPE_ONBOARD_CONTROLLER on the wire, now.

        Another service on the same vehicle reads in it for how long this one has run, and whether it is in
        command (`companion.vehicle.commander`).
        """

    @property
    def own_address(self) -> Address:
        """Whom our messages say they are from: system and component id."""

    async def find_gimbal(self) -> bool:
        """Ask the autopilot for its gimbal and for the streams of it. False: none answers. Never raises.

        Asked by itself when the link opens, when the autopilot restarts and when a gimbal is heard.
        """

    async def take_gimbal(self) -> None:
        """Take primary control of the gimbal, whoever has it. Raises CommandRefusedError."""

    async def point_gimbal(self, aim: GimbalAim) -> None:
        """Let the gimbal look there; returns when that is accepted, before it has turned.

        Raises CommandRefusedError, also when another has taken control of it.
        """

    async def give_gimbal_back(self) -> None:
        """Give primary control back, if it is ours; the gimbal stays as it is. Raises CommandRefusedError."""

    async def get_parameter(self, name: str) -> float:
        """The value of one parameter. Raises CommandRefusedError if there is none of that name."""

    async def set_parameter(self, name: str, value: float) -> None:
        """Set one parameter, keeping its type, and return when the vehicle echoed it."""
