"""The interface of the vehicle drivers. One contract test runs against all of them.

A driver sends each message once. It repeats nothing by itself: no setpoint, no heartbeat. The repetition is
done by the guidance loop, so that it stops when that loop stops (see `streamer.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Protocol

from companion.host.clock import StandstillWatch
from companion.host.passing import PassingError
from companion.vehicle.autopilot_parameters import FirmwareVersion
from companion.vehicle.gimbal import Address, GimbalAim
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.reception import ReceptionCounts
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, VehicleState
from companion.vehicle.vision_position import VisionPosition
from vision.obstacle_sectors import ObstacleSectors

# Called with every piece of bytes on the link: whether we sent it, and the bytes. Must return at once.
OnBytes = Callable[[bool, bytes], None]


class LinkError(ConnectionError):
    """The link cannot be opened, or no autopilot answers on it. The message is one line."""


class LinkUnavailableError(LinkError, PassingError):
    """It cannot be opened now, or no autopilot answers now."""


class CommandRefusedError(RuntimeError):
    """The vehicle refused a request or did not fulfil it in time. The message says what and why."""


class TakenOverError(CommandRefusedError):
    """Someone else, or the autopilot by itself, changed the mode or the arming during the request."""


class NoAnswerError(CommandRefusedError):
    """The vehicle is connected and has not answered. The message gives a likely reason."""


class SystemStatus(IntEnum):
    """MAV_STATE of our own heartbeat."""

    ACTIVE = 4
    CRITICAL = 5


class Driver(Protocol):
    """A link to one autopilot. All methods are called from one asyncio loop.

    `url` is `udpin://HOST:PORT` (listen, as PX4 SITL sends to 14540), `udpout://HOST:PORT`, `tcp://HOST:PORT`,
    `serial:///dev/ttyAMA0:921600`, or `none`: there is no vehicle, and `connect` fails.
    """

    @property
    def library(self) -> str:
        """The MAVLink library: "pymavlink" or "mavsdk"."""

    async def connect(self, timeout_s: float | None, on_wait: Callable[[str], None] = lambda _: None) -> None:
        """Open the link and wait for the autopilot's first heartbeat.

        Args:
            timeout_s: None: the heartbeat is waited for without limit.
            on_wait: called every second meanwhile, with the reason why it may not come.

        Raises:
            LinkError: the endpoint cannot be opened (busy port, no such device, bad url), no heartbeat within
                `timeout_s`, or one of an unsupported autopilot. The driver is closed then.
        """

    async def close(self) -> None:
        """Close the link. Never raises; can be called twice."""

    @property
    def watch(self) -> StandstillWatch:
        """Detects a standstill. Until it is acknowledged no setpoint, mode, arming or take-off is sent.

        The loop that steers acknowledges at the end of its steps.
        """

    def abandon(self, why: str) -> None:
        """End what is pending of arming, modes and take-off: nothing of it is sent or repeated any more."""

    def discard_received(self) -> None:
        """What was received is outdated, also what waits in the link's buffers: the state has no stamps."""

    @property
    def link_count(self) -> int:
        """How often the link has opened, returned after silence, or the autopilot has restarted.

        0 until `connect` has found the autopilot.
        """

    @property
    def reception(self) -> ReceptionCounts:
        """How many frames were received, split over datagrams, and lost, since the link was opened."""

    @property
    def state(self) -> VehicleState:
        """The newest snapshot; a new object for every change."""

    def subscribe(self, callback: Callable[[VehicleState], None]) -> Callable[[], None]:
        """Call back in the loop with every new snapshot; returns a function that unsubscribes."""

    async def arm(self, *, since: VehicleState | None = None, valid_until_ns: int | None = None) -> None:
        """Arm, and return when the vehicle reports armed. Raises CommandRefusedError.

        This, `disarm`, `set_mode` and `takeoff` are sent by one state machine (`mode_changes`): a
        new one replaces the pending one, which raises CommandRefusedError. They raise TakenOverError as
        soon as someone else's change of mode or arming is reported.

        Args:
            since: the state that it was decided on; with another mode or arming now, nothing is sent. None:
                the present one.
            valid_until_ns: nothing is sent or repeated after it, by the clock of `watch`; None: no limit.
        """

    async def disarm(self, *, since: VehicleState | None = None, valid_until_ns: int | None = None) -> None:
        """Disarm (never forced in the air), and return when reported. Arguments and errors as `arm`."""

    async def set_mode(
        self,
        mode: FlightMode,
        *,
        timeout_s: float = 3.0,
        since: VehicleState | None = None,
        valid_until_ns: int | None = None,
    ) -> None:
        """Request a flight mode, and return when the vehicle REPORTS it (HEARTBEAT or CURRENT_MODE).

        The acknowledgement is not sufficient: PX4 >= 1.16 first acknowledges every DO_SET_MODE.
        Raises CommandRefusedError with the mode that is reported instead. Other arguments as `arm`.
        """

    async def takeoff(
        self, altitude_m: float, *, since: VehicleState | None = None, valid_until_ns: int | None = None
    ) -> None:
        """Request the autopilot's own take-off to a height above home, metres. Arm before or after.

        Raises CommandRefusedError, also when home's altitude is unknown. Other arguments as `arm`.
        """

    async def settle(self) -> None:
        """Wait until no command of ours can change the mode after someone else has, for at most 3 s."""

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """Send one SET_POSITION_TARGET_LOCAL_NED now. Never raises for a lost link."""

    def send_landing_target(self, target: LandingTarget) -> None:
        """Send one LANDING_TARGET now, in the frame that this autopilot accepts."""

    def send_obstacle_distance(self, sectors: ObstacleSectors) -> None:
        """Send one OBSTACLE_DISTANCE now, relative to the vehicle's nose. Not without a yaw."""

    def send_vision_position(self, vision: VisionPosition) -> None:
        """Send one VISION_POSITION_ESTIMATE now. Never raises for a lost link."""

    def send_heartbeat(
        self, status: SystemStatus, *, uptime_s: float | None = None, in_command: bool = False
    ) -> None:
        """Send one HEARTBEAT of MAV_TYPE_ONBOARD_CONTROLLER now.

        It carries uptime and whether this service is in command, for another service on the same vehicle
        (`companion.vehicle.commander`). Default of the uptime: since this driver was created.
        """

    @property
    def own_address(self) -> Address:
        """System and component id of our messages; also in `state`."""

    def change_address(self) -> bool:
        """Send with another component id from now on, since another program has ours.

        False: none is free, the gimbal is under our control, an acknowledgement to the present address may
        still arrive, or the library does not allow it.
        """

    async def find_gimbal(self) -> bool:
        """Request the gimbal manager's information and its streams. False: no answer. Never raises.

        Done automatically when the link opens, when the autopilot restarts, and when a gimbal's message is
        received.
        """

    async def take_gimbal(self) -> None:
        """Take primary control of the gimbal, also from another owner. Raises CommandRefusedError."""

    async def point_gimbal(self, aim: GimbalAim) -> None:
        """Point the gimbal; returns when the command is accepted, before the gimbal has turned.

        Raises CommandRefusedError, also when another owner has primary control.
        """

    async def give_gimbal_back(self) -> None:
        """Release primary control if it is ours; the gimbal keeps its aim. Raises CommandRefusedError."""

    async def firmware_version(self) -> FirmwareVersion:
        """Return the autopilot's version (AUTOPILOT_VERSION). Raises CommandRefusedError if it sends none."""

    async def get_parameter(self, name: str) -> float:
        """Return the value of one parameter. Raises CommandRefusedError if it does not exist."""

    async def set_parameter(self, name: str, value: float) -> None:
        """Set one parameter, keeping its type, and return when the vehicle has echoed it."""
