"""A driver for flights in lockstep: requests and setpoints to the simulated vehicle, without sockets."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Protocol

from companion.guidance.interface import (
    Answer,
    Arm,
    Disarm,
    FindGimbal,
    PointGimbal,
    ReleaseGimbal,
    Request,
    SetMode,
    TakeGimbal,
    TakeOff,
)
from companion.vehicle.ardupilot_profile import ArduPilotProfile
from companion.vehicle.autopilot_parameters import AutopilotParameters, FirmwareVersion, parameter_names
from companion.vehicle.autopilot_profile import HOME_POSITION_ID, AutopilotProfile, Px4Profile
from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.gimbal_commands import CONFIGURE, PITCHYAW, RELEASE, UNCHANGED, pitchyaw_parameters
from companion.vehicle.landing_target import LandingTarget, landing_target_fields
from companion.vehicle.mav_result import ACCEPTED, IN_PROGRESS, result_name
from companion.vehicle.mode_changes import (
    ARM_DISARM,
    DO_SET_MODE,
    MODE_FLAG_CUSTOM,
    NAV_TAKEOFF,
    Ending,
    ModeChange,
    ModeChanges,
)
from companion.vehicle.obstacle_distance import obstacle_distance_fields
from companion.vehicle.report_reader import Event, EventCatalogue
from companion.vehicle.setpoint import Setpoint, setpoint_fields
from companion.vehicle.setpoint_echo import NAME as ECHO_NAME
from companion.vehicle.setpoint_echo import SetpointEcho
from companion.vehicle.state import VehicleState
from companion.vehicle.telemetry import TELEMETRY_MESSAGES, apply_message
from companion.vehicle.telemetry_state import REPORTS_KEPT
from companion.vehicle.vehicle_type import ARDUPILOT, PX4
from companion.vehicle.vision_position import VisionPosition, vision_position_fields
from mavlink_sim.lockstep import COMPANION, LockstepVehicle
from mavlink_sim.services.vehicle_files import event_metadata
from mavlink_sim.vehicles.ardupilot.copter import CopterVehicle
from mavlink_sim.vehicles.ardupilot.telemetry import VERSION as COPTER_VERSION
from mavlink_sim.wire.messages import dialect
from vision.obstacle_sectors import ObstacleSectors

START_NS = 1_000_000_000_000
# As the drivers send it, and keep what was sent.
TIMESYNC_PERIOD_NS, TIMESYNCS_KEPT = 500_000_000, 8
# As the drivers wait.
SHOWN_TIMEOUT_S = 3.0
GIMBAL_INFORMATION_ID = 280
# What the drivers ask of an autopilot, and the same where there is a gimbal (`gimbal_commands`).
RATES_HZ = {
    **{dialect.mavlink_map[number].msgname: rate_hz for number, rate_hz in Px4Profile.rates_hz.items()},
    "HEARTBEAT": 1.0,
}
COPTER_STREAMS_S = 2.5  # until even the slowest stream has come
GIMBAL_RATES_HZ = {"GIMBAL_DEVICE_ATTITUDE_STATUS": 50.0, "GIMBAL_MANAGER_STATUS": 5.0}


class LockstepDriver(Protocol):
    """What a flight in lockstep needs of a vehicle: a clock, a state, and time that passes on request."""

    @property
    def now_ns(self) -> int:
        """The flight's clock, as CLOCK_MONOTONIC would be."""

    @property
    def state(self) -> VehicleState:
        """The newest snapshot."""

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """One setpoint, now."""

    def send_landing_target(self, target: LandingTarget) -> None:
        """One landing target, now."""

    def send_obstacle_distance(self, sectors: ObstacleSectors) -> None:
        """One OBSTACLE_DISTANCE, now."""

    def send_vision_position(self, vision: VisionPosition) -> None:
        """One position from a map, now."""

    def start(self, request: Request) -> None:
        """Begin to carry out a request of guidance."""

    def cancel(self, identifier: int) -> None:
        """Nobody waits for it any more."""

    def take_answers(self) -> tuple[Answer, ...]:
        """Those that have come since the last call."""

    def step(self, dt_s: float) -> None:
        """Let time pass."""


@dataclass
class _Pending:
    identifier: int
    command: int
    failure: str
    shown: Callable[[], bool] | None
    until_ns: float


class SimulatedDriver:
    """The simulated vehicle. A request is answered as `companion.vehicle.flight_commands` answers it.

    Args:
        vehicle: with the streams of `RATES_HZ` on its first link, if it is PX4-like; an ArduPilot's are asked
            for here.
        boot_ns: the flight's clock when the vehicle booted.
        range_finder_height: as in `VehicleState`.
    """

    def __init__(
        self, vehicle: LockstepVehicle, boot_ns: int = START_NS, *, range_finder_height: bool = False
    ) -> None:
        self.vehicle, self._boot_ns = vehicle, boot_ns
        copter = isinstance(vehicle.vehicle, CopterVehicle)
        self._kind = ARDUPILOT if copter else PX4
        self._profile: AutopilotProfile = ArduPilotProfile() if copter else Px4Profile()
        self._state = VehicleState(
            autopilot=self._profile.name,
            is_plane=False if copter else None,
            range_finder_height=range_finder_height,
        )
        self._changes = ModeChanges(
            lambda command, values, confirmation: self.vehicle.send(self._long(command, *values)),
            self._profile.mode_parameters,
            self._on_restored,
        )
        self._changing: dict[int, ModeChange] = {}
        self._echo = SetpointEcho()
        self._timesyncs_ns: deque[int] = deque(maxlen=TIMESYNCS_KEPT)
        self._answered_ns = 0
        self._pending: list[_Pending] = []
        self._home_requested = False
        self._answers: list[Answer] = []
        if vehicle.vehicle.gimbal is not None:
            # As the drivers do when a link opens.
            self.vehicle.send(self._long(dialect.MAV_CMD_REQUEST_MESSAGE, GIMBAL_INFORMATION_ID))
            self.vehicle.step(0.1)
        if copter:
            for number, rate_hz in self._profile.rates_hz.items():
                self.vehicle.send(self._long(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / rate_hz))
            self.vehicle.step(COPTER_STREAMS_S)
        # What it sent before this driver came, a take-off perhaps: the newest of each kind is its state.
        self.vehicle.receive()
        self._read(next(iter(self.vehicle.newest.values())).values())

    @property
    def now_ns(self) -> int:
        return self._boot_ns + round(self.vehicle.now_s * 1e9)

    @property
    def state(self) -> VehicleState:
        return self._state

    @property
    def parameters(self) -> AutopilotParameters:
        """As the service reads them when the link has opened (`companion.service.health`)."""
        vehicle, name = self.vehicle.vehicle, self._profile.name
        encoded = COPTER_VERSION if self._kind == ARDUPILOT else vehicle.release.software_version
        version = FirmwareVersion.of(encoded)
        values = tuple((key, vehicle.parameters.number(key)) for key in parameter_names(name, version))
        return AutopilotParameters(name, version, vehicle.system_id, values)

    def send_setpoint(self, setpoint: Setpoint) -> None:
        moved = setpoint.moved(self._state.reset_offset_ned_m)
        fields = self._profile.setpoint_fields(setpoint_fields(moved, self.vehicle.vehicle.system_id))
        self._echo.sent(fields, self.now_ns)
        self.vehicle.send(dialect.MAVLink_set_position_target_local_ned_message(**fields))

    def send_landing_target(self, target: LandingTarget) -> None:
        fields = landing_target_fields(target, self._kind, self._state.reset_offset_ned_m)
        self.vehicle.send(dialect.MAVLink_landing_target_message(**fields))

    def send_obstacle_distance(self, sectors: ObstacleSectors) -> None:
        if self._state.yaw_rad is not None:
            fields = obstacle_distance_fields(sectors, self._state.yaw_rad)
            self.vehicle.send(dialect.MAVLink_obstacle_distance_message(**fields))

    def send_vision_position(self, vision: VisionPosition) -> None:
        fields = vision_position_fields(vision)
        self.vehicle.send(dialect.MAVLink_vision_position_estimate_message(**fields))

    def start(self, request: Request) -> None:
        mav, state = dialect, self._state
        match request.action:
            case SetMode(mode):
                number = self._profile.mode_request(mode, state)
                parameters = (MODE_FLAG_CUSTOM, *self._profile.mode_parameters(number))
                self._change(request, ModeChange(f"mode {mode}", DO_SET_MODE, parameters, state, number))
            case Arm():
                self._change(request, ModeChange("arming", ARM_DISARM, (1.0,), state, None, True))
            case Disarm():
                self._change(request, ModeChange("disarming", ARM_DISARM, (0.0,), state, None, False))
            case TakeOff(altitude_m):
                if self._profile.takeoff_needs_home:
                    # Moved by arming, and else sent every two seconds only. The answer comes at once.
                    self.vehicle.send(self._long(mav.MAV_CMD_REQUEST_MESSAGE, HOME_POSITION_ID))
                    self.receive()
                try:
                    values = self._profile.takeoff_parameters(altitude_m, self._state)
                except CommandRefusedError as error:
                    self._answers.append(Answer(request.identifier, str(error)))
                    return
                change = ModeChange("take-off", NAV_TAKEOFF, values, state, self._profile.takeoff_mode())
                change.done_by_acknowledgement = True
                self._change(request, change)
            case FindGimbal():
                self._command(
                    request,
                    "no gimbal answers",
                    None,
                    mav.MAV_CMD_REQUEST_MESSAGE,
                    GIMBAL_INFORMATION_ID,
                )
            case TakeGimbal():
                values = (*COMPANION, UNCHANGED, UNCHANGED)
                self._command(request, "the vehicle refused control of the gimbal", None, CONFIGURE, *values)
            case PointGimbal(aim):
                values = pitchyaw_parameters(aim)
                self._command(request, "the vehicle refused to point the gimbal", None, PITCHYAW, *values)
            case ReleaseGimbal():
                values = (RELEASE, RELEASE, UNCHANGED, UNCHANGED)
                self._command(
                    request, "the vehicle refused to give the gimbal back", None, CONFIGURE, *values
                )

    def _change(self, request: Request, change: ModeChange) -> None:
        self._changing[request.identifier] = change
        self._changes.begin(change, self._state, self.now_ns)

    def _on_restored(self, _change: ModeChange, text: str) -> None:
        self._state = replace(self._state, mode_restored=text)

    def cancel(self, identifier: int) -> None:
        if identifier in self._changing:
            self._changes.drop(self._changing.pop(identifier), "cancelled")
        self._pending = [pending for pending in self._pending if pending.identifier != identifier]

    def take_answers(self) -> tuple[Answer, ...]:
        answers, self._answers = tuple(self._answers), []
        return answers

    def step(self, dt_s: float) -> None:
        self.vehicle.step(dt_s)
        self.receive()

    def receive(self) -> None:
        """Messages into the state, acknowledgements into answers."""
        self._read(self.vehicle.receive())

    def _read(self, messages: Iterable[Any]) -> None:
        now_ns = self.now_ns
        for message in messages:
            name = message.get_type()
            if name == "COMMAND_ACK":
                self._acknowledge(message)
                self._changes.on_acknowledgement(message.command, message.result, now_ns)
            elif name == "TIMESYNC" and message.tc1 > 0 and message.ts1 in self._timesyncs_ns:
                self._answered_ns = max(self._answered_ns, message.ts1)
            elif name == "EVENT":
                self._on_event(message, now_ns)
            elif name == ECHO_NAME:
                self._echo.received(message.to_dict(), self._state, now_ns, self._answered_ns)
            elif name in TELEMETRY_MESSAGES or self._kind == ARDUPILOT:
                for name_now, fields in self._profile.translate(name, message.to_dict(), self._state):
                    self._state = apply_message(self._state, name_now, fields, now_ns)
                    if name_now in ("HEARTBEAT", "CURRENT_MODE"):
                        self._state = self._echo.confirm(self._state, now_ns)
                        self._changes.on_report(self._state, now_ns, self._answered_ns)
        state = self._state
        if state.ready_to_arm and state.home_fault() is not None and not self._home_requested:
            # As the drivers do while home is unknown: PX4 sends it every two seconds only.
            self._home_requested = True
            self.vehicle.send(self._long(dialect.MAV_CMD_REQUEST_MESSAGE, HOME_POSITION_ID))
        for pending in list(self._pending):
            if pending.shown is not None and pending.shown():
                self._answer(pending, None)
            elif now_ns > pending.until_ns:
                self._answer(pending, f"{pending.failure}: nothing shows after {SHOWN_TIMEOUT_S:g} s")

        self._follow_changes(now_ns)

    def _follow_changes(self, now_ns: int) -> None:
        """As `flight_commands` follows them, with a TIMESYNC every half second."""
        if not self._timesyncs_ns or now_ns - self._timesyncs_ns[-1] >= TIMESYNC_PERIOD_NS:
            self._timesyncs_ns.append(now_ns)
            self.vehicle.send(dialect.MAVLink_timesync_message(0, now_ns))
        if not self._changing and not self._changes.pending:
            return
        self._changes.tick(now_ns)
        for identifier, change in list(self._changing.items()):
            if change.ending is None:
                continue
            del self._changing[identifier]
            refused = None if change.ending is Ending.DONE else change.why
            self._answers.append(Answer(identifier, refused, change.ending is Ending.TAKEN_OVER))
            if change.command == NAV_TAKEOFF and refused is None:
                for name, fields in self._profile.on_takeoff_accepted():
                    self._state = apply_message(self._state, name, fields, now_ns)

    def _on_event(self, message: Any, now_ns: int) -> None:
        event = Event(message.id, message.sequence, message.log_levels, message.arguments)
        report = _events_of_px4().report(event, now_ns)
        if report is not None:
            self._state = replace(self._state, reports=(*self._state.reports, report)[-REPORTS_KEPT:])

    def _command(
        self,
        request: Request,
        failure: str,
        shown: Callable[[], bool] | None,
        number: int,
        *parameters: float,
    ) -> None:
        """One COMMAND_LONG. `shown`: what ends it besides an error; None: its acknowledgement."""
        until_ns = self.now_ns + SHOWN_TIMEOUT_S * 1e9
        self._pending.append(_Pending(request.identifier, number, failure, shown, until_ns))
        self.vehicle.send(self._long(number, *parameters))

    def _long(self, number: int, *parameters: float) -> object:
        values = (*parameters, *[0.0] * (7 - len(parameters)))
        return dialect.MAVLink_command_long_message(self.vehicle.vehicle.system_id, 1, number, 0, *values)

    def _acknowledge(self, message: Any) -> None:
        pending = next((one for one in self._pending if one.command == message.command), None)
        if pending is None or message.result == IN_PROGRESS:
            return
        if message.result != ACCEPTED:
            self._answer(pending, f"{pending.failure} ({result_name(message.result)})")
        elif pending.shown is None:
            self._answer(pending, None)

    def _answer(self, pending: _Pending, refused: str | None) -> None:
        self._pending.remove(pending)
        self._answers.append(Answer(pending.identifier, refused))


@cache
def _events_of_px4() -> EventCatalogue:
    """The events that the drivers read from the vehicle's file."""
    return EventCatalogue(event_metadata())
