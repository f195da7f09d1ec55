"""One PX4-like vehicle without sockets: messages in by `handle`, time by `step`, messages out by `outgoing`.

Several links may be attached, as on a real vehicle: an onboard computer's and a ground station's. The vehicle never
reads a clock of its own, so it can be stepped as fast or as slowly as wanted (lockstep) and repeats itself exactly.
"""

from __future__ import annotations

import logging
import math
import random
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from mavlink_sim import commands, telemetry
from mavlink_sim.autopilot import CRITICAL, INFO, Autopilot, Text
from mavlink_sim.messages import Outgoing, dialect, event, link_node_status
from mavlink_sim.parameters import (
    HASH_CHECK,
    HASH_CHECK_INDEX,
    UINT32,
    Parameter,
    Parameters,
    UnknownParameterError,
    decode_wire_value,
)
from mavlink_sim.physics import Multirotor
from mavlink_sim.setpoints import SetpointRejectedError, trajectory_setpoint
from vision.rotation import quaternion_from_euler

logger = logging.getLogger(__name__)

COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
STEP_S = 0.004
# The air is never still: gusts that make a held position wander as measured on the real vehicle (std 0.25 m).
BACKGROUND_GUSTS_MPS = 0.3
GUST_SHARE_OF_WIND = 0.15
GROUND_STATION_TIMEOUT_S = 2.5
PARAMETERS_PER_SECOND = 1000.0
SECOND_PARAMETER_ECHO_S = 0.015
# Measured: "Connection to mission computer lost" comes about 7 s after the last heartbeat (COM_OBC_LOSS_T is 5 s).
COMPANION_LOSS_MARGIN_S = 2.0
MAV_TYPE_GCS = 6
MAV_TYPE_ONBOARD_CONTROLLER = 18


class Link:
    """One MAVLink connection of the vehicle: its streams, and what waits to be sent on it."""

    def __init__(self, name: str, rates_hz: dict[str, float], phase_s: float) -> None:
        self.name = name
        self.streams = telemetry.Streams(rates_hz, phase_s)
        self.outbox: deque[Outgoing] = deque()
        self.components: set[tuple[int, int]] = set()
        self.ground_station_seen_s = -math.inf
        self.parameters_left: deque[Parameter] = deque()
        self.parameter_credit = 0.0
        self.sent = 0
        self.received = 0
        self._rates_hz = rates_hz

    def has_stream(self, name: str) -> bool:
        return name in self._rates_hz

    def knows(self, system: int, component: int) -> bool:
        """Whether a message to this target is worth sending here (PX4's `component_was_seen`)."""
        if system == 0:
            return bool(self.components)
        return any(
            system == seen_system and component in (0, seen_component)
            for seen_system, seen_component in self.components
        )


class Vehicle:
    """A quadrotor with PX4's behaviour.

    Args:
        system_id: its MAVLink system; the component is 1.
        seed: of wind direction and gusts.
        wind_mps: steady horizontal wind, from a direction that the seed chooses.
        gusts_mps: standard deviation of the gusts per horizontal axis; None for a calm day's usual amount.
        parameters: PX4 parameters that differ from `parameters.txt`.
        ready_after_s: how long after boot the estimator allows arming.
        on_event: called with one readable line per event ("armed", "mode HOLD", "landed"…).

    Attributes:
        airframe: the motion (truth); autopilot: the decisions; parameters: the parameter set.
    """

    def __init__(
        self,
        *,
        system_id: int = 1,
        seed: int = 0,
        wind_mps: float = 0.0,
        gusts_mps: float | None = None,
        parameters: Mapping[str, float] | None = None,
        ready_after_s: float = 3.0,
        on_event: Callable[[str], None] | None = None,
    ) -> None:
        direction = random.Random(seed).uniform(0.0, math.tau)
        if gusts_mps is None:
            gusts_mps = BACKGROUND_GUSTS_MPS + GUST_SHARE_OF_WIND * wind_mps
        self.system_id = system_id
        self.parameters = Parameters(parameters)
        if wind_mps:
            self.parameters.set("SIH_WIND_N", wind_mps * math.cos(direction))
            self.parameters.set("SIH_WIND_E", wind_mps * math.sin(direction))
        self.parameters.set("MAV_SYS_ID", system_id)
        self.airframe = Multirotor(seed, gusts_mps=gusts_mps)
        self.links: dict[str, Link] = {}
        self.event_sequence = 0
        self.clock_ns: Callable[[], int] = lambda: self._boot_us * 1000
        self._on_event = on_event or (lambda text: None)
        self.autopilot = Autopilot(
            self.airframe, self.parameters, ready_after_s=ready_after_s, on_event=self._on_event
        )
        self._boot_us = 0
        self._leftover_s = 0.0
        self._ping_sequence = 0
        self._wind_revision = -1
        self._used_charge = 0.0
        self._companion_seen_s: float | None = None
        self._companion_lost = False
        self._later: deque[tuple[float, Callable[[], None]]] = deque()

    # ---- what is known of it ----------------------------------------------------------------------------

    @property
    def boot_us(self) -> int:
        return self._boot_us

    @property
    def boot_ms(self) -> int:
        return self._boot_us // 1000

    @property
    def now_s(self) -> float:
        return self._boot_us / 1e6

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """`ned_from_body`, (w, x, y, z)."""
        frame = self.airframe
        return quaternion_from_euler(frame.roll_rad, frame.pitch_rad, frame.yaw_rad)

    @property
    def battery_remaining(self) -> float:
        """0..1; drains over SIM_BAT_DRAIN seconds of armed time, to SIM_BAT_MIN_PCT at the lowest."""
        lowest = self.parameters.number("SIM_BAT_MIN_PCT") / 100.0
        return max(0.99 - self._used_charge, lowest)

    @property
    def battery_volts(self) -> float:
        return 14.4 + 1.8 * self.battery_remaining

    def next_ping(self) -> int:
        self._ping_sequence += 1
        return self._ping_sequence - 1

    # ---- links ------------------------------------------------------------------------------------------

    def add_link(self, name: str, rates_hz: dict[str, float] | None = None) -> Link:
        """Attach a link with the onboard link's rates, or others (`telemetry.GCS_RATES_HZ`)."""
        # links start out of step, so that two of them do not send everything in the same millisecond
        rates = telemetry.ONBOARD_RATES_HZ if rates_hz is None else rates_hz
        link = self.links[name] = Link(name, rates, 0.0017 * len(self.links))
        return link

    def outgoing(self, link: str) -> list[Outgoing]:
        """Take everything that waits to be sent on a link."""
        outbox = self.links[link].outbox
        taken = list(outbox)
        outbox.clear()
        return taken

    def _send(self, link: Link, message: Any) -> None:
        link.sent += 1
        link.outbox.append(Outgoing(message, self.system_id, COMPONENT))

    def send_built(self, link: Link, name: str) -> bool:
        """Send one message by name; False if it has nothing to say now."""
        if name == "LINK_NODE_STATUS":
            message = link_node_status(self.boot_ms, link.sent, link.received, 0)
        else:
            message = (telemetry.BUILDERS.get(name) or telemetry.REQUESTED[name])(self)
        if message is None:
            return False
        self._send(link, message)
        return True

    def send_interval(self, link: Link, identifier: int, name: str | None) -> None:
        """Send MESSAGE_INTERVAL: the stream's interval, -1 if it is off, 0 if it does not exist."""
        interval = 0 if name is None else link.streams.interval_us(name)
        self._send(link, dialect.MAVLink_message_interval_message(max(identifier, 0) & 0xFFFF, interval))

    # ---- time -------------------------------------------------------------------------------------------

    def step(self, dt_s: float) -> None:
        """Advance time by any amount, in physics steps of 4 ms; a remainder waits for the next call."""
        self._leftover_s += dt_s
        while self._leftover_s >= STEP_S - 1e-9:
            self._leftover_s -= STEP_S
            self._step()

    def _step(self) -> None:
        self._boot_us += round(STEP_S * 1e6)
        while self._later and self._later[0][0] <= self.now_s:
            self._later.popleft()[1]()
        if self._wind_revision != self.parameters.revision:
            self._wind_revision = self.parameters.revision
            value = self.parameters.number
            self.airframe.wind = (value("SIH_WIND_N"), value("SIH_WIND_E"), 0.0)
        self.autopilot.update(STEP_S)
        if self.autopilot.armed:
            self._used_charge += STEP_S / max(self.parameters.number("SIM_BAT_DRAIN"), 1.0) / 2.0
        self._watch_companion()
        self._spread_texts()
        for link in self.links.values():
            for name in link.streams.due(self._boot_us):
                self.send_built(link, name)
            if link.parameters_left:
                self._send_parameters(link)

    def _after(self, delay_s: float, action: Callable[[], None]) -> None:
        self._later.append((self.now_s + delay_s, action))
        if len(self._later) > 1:
            self._later = deque(sorted(self._later, key=lambda entry: entry[0]))

    def _watch_companion(self) -> None:
        seen = self._companion_seen_s
        if seen is None or self._companion_lost:
            return
        if self.now_s - seen > self.parameters.number("COM_OBC_LOSS_T") + COMPANION_LOSS_MARGIN_S:
            self._companion_lost = True
            self.autopilot.texts.append(Text(CRITICAL, "Connection to mission computer lost\t"))
            self._on_event("the companion's heartbeat is lost")

    def _spread_texts(self) -> None:
        texts = self.autopilot.texts
        while texts:
            text = texts.popleft()
            for link in self.links.values():
                if self.now_s - link.ground_station_seen_s < GROUND_STATION_TIMEOUT_S:
                    self._send_text(link, text)
            if text.event is not None:
                self.event_sequence += 1
                identifier, levels, arguments = text.event
                for link in self.links.values():
                    self._send(link, event(identifier, self.boot_ms, self.event_sequence, levels, arguments))
        commanded = self.autopilot.gimbal_commands
        while commanded:
            command, confirmation, values = commanded.popleft()
            for link in self.links.values():
                self._send(
                    link,
                    dialect.MAVLink_command_long_message(self.system_id, 0, command, confirmation, *values),
                )

    _text_id = 0

    def _send_text(self, link: Link, text: Text) -> None:
        """STATUSTEXT, in chunks of 50 characters where it is longer."""
        encoded = text.text.encode()
        if len(encoded) <= 50:
            self._send(link, dialect.MAVLink_statustext_message(text.severity, encoded))
            return
        self._text_id = self._text_id % 65535 + 1
        for sequence, start in enumerate(range(0, len(encoded), 50)):
            chunk = encoded[start : start + 50]
            self._send(
                link, dialect.MAVLink_statustext_message(text.severity, chunk, self._text_id, sequence)
            )

    # ---- messages in ------------------------------------------------------------------------------------

    def handle(self, link_name: str, message: Any) -> None:
        """Take in one MAVLink message (of any pymavlink dialect) that arrived on a link."""
        link = self.links[link_name]
        kind = message.get_type()
        if kind == "BAD_DATA":
            return
        link.received += 1
        system, component = message.get_srcSystem(), message.get_srcComponent()
        if (system, component) == (self.system_id, COMPONENT):
            return  # an echo of our own
        link.components.add((system, component))
        target_system = getattr(message, "target_system", 0)
        target_component = getattr(message, "target_component", 0)
        self._forward(link, message, target_system, target_component)
        handler = _HANDLERS.get(kind)
        if handler is None:
            return
        if target_system not in (0, self.system_id) or target_component not in (0, COMPONENT):
            return
        handler(self, link, message)

    def _forward(self, source: Link, message: Any, target_system: int, target_component: int) -> None:
        """PX4's message forwarding (`mavlink start -f`) between its links."""
        if target_system not in (0, self.system_id):
            return
        if target_component == COMPONENT or message.get_type().startswith("UNKNOWN"):
            return
        if target_system == 0 and hasattr(message, "target_system") and message.get_type() == "PING":
            return
        for link in self.links.values():
            if link is not source and link.knows(target_system, target_component):
                link.outbox.append(Outgoing(message, message.get_srcSystem(), message.get_srcComponent()))

    def _on_heartbeat(self, link: Link, message: Any) -> None:
        if message.type == MAV_TYPE_GCS:
            link.ground_station_seen_s = self.now_s
        elif message.type == MAV_TYPE_ONBOARD_CONTROLLER and message.get_srcSystem() == self.system_id:
            self._companion_seen_s = self.now_s
            if self._companion_lost:
                self._companion_lost = False
                self.autopilot.texts.append(Text(INFO, "Onboard controller regained\t"))
                self._on_event("the companion's heartbeat is back")

    def _on_command(self, link: Link, message: Any) -> None:
        command = commands.command_of(message)
        if command.identifier in commands.ANSWERED_TWICE:
            # the receiver accepts at once, whatever Commander says a moment later (PX4 since v1.16)
            self._acknowledge(link, command.identifier, 0, message)
            self._after(STEP_S, lambda: self._execute(link, command, message))
            return
        self._execute(link, command, message)

    def _execute(self, link: Link, command: commands.Command, message: Any) -> None:
        result = commands.execute(self, link, command)
        if result is not None:
            self._acknowledge(link, command.identifier, result, message)

    def _acknowledge(self, link: Link, command: int, result: int, message: Any) -> None:
        self._send(
            link,
            dialect.MAVLink_command_ack_message(
                command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
            ),
        )

    def _on_set_mode(self, link: Link, message: Any) -> None:
        custom = int(message.custom_mode)
        result = commands.set_mode(
            self, message.base_mode, custom >> 16 & 0xFF, custom >> 24 & 0xFF, message.get_srcComponent()
        )
        self._acknowledge(link, commands.DO_SET_MODE, result, message)

    def _on_setpoint(self, link: Link, message: Any) -> None:
        try:
            setpoint = trajectory_setpoint(message, self.airframe.yaw_rad)
        except SetpointRejectedError as error:
            self.autopilot.texts.append(Text(CRITICAL, f"{error}\t"))
            return
        self.autopilot.offboard_setpoint(setpoint)

    def _on_timesync(self, link: Link, message: Any) -> None:
        if message.tc1 == 0:
            self._send(link, dialect.MAVLink_timesync_message(self.clock_ns(), message.ts1))

    def _on_ping(self, link: Link, message: Any) -> None:
        if message.target_system == 0 and message.target_component == 0:
            self._send(
                link,
                dialect.MAVLink_ping_message(
                    message.time_usec, message.seq, message.get_srcSystem(), message.get_srcComponent()
                ),
            )

    def _on_mission_request_list(self, link: Link, message: Any) -> None:
        self._send(
            link,
            dialect.MAVLink_mission_count_message(
                message.get_srcSystem(), message.get_srcComponent(), 0, getattr(message, "mission_type", 0)
            ),
        )

    # ---- parameters -------------------------------------------------------------------------------------

    def _send_parameter(self, link: Link, parameter: Parameter) -> None:
        self._send(
            link,
            dialect.MAVLink_param_value_message(
                parameter.name.encode(),
                parameter.wire_value,
                parameter.kind,
                len(self.parameters),
                self.parameters.index(parameter.name),
            ),
        )

    def _send_hash(self, link: Link) -> None:
        self._send(
            link,
            dialect.MAVLink_param_value_message(
                HASH_CHECK.encode(),
                self.parameters.hash_wire_value(),
                UINT32,
                len(self.parameters),
                HASH_CHECK_INDEX,
            ),
        )

    def _send_parameters(self, link: Link) -> None:
        """The running answer to PARAM_REQUEST_LIST, about a thousand a second."""
        link.parameter_credit += PARAMETERS_PER_SECOND * STEP_S
        while link.parameter_credit >= 1.0 and link.parameters_left:
            link.parameter_credit -= 1.0
            self._send_parameter(link, self.parameters[link.parameters_left.popleft().name])

    def _on_parameter_list(self, link: Link, message: Any) -> None:
        self._after(0.01, lambda: self._start_list(link))

    def _start_list(self, link: Link) -> None:
        self._send_hash(link)
        link.parameters_left = deque(self.parameters)
        link.parameter_credit = 0.0

    def _on_parameter_read(self, link: Link, message: Any) -> None:
        index = int(message.param_index)
        name = _text_of(message.param_id)
        if index < 0 and name == HASH_CHECK:
            self._send_hash(link)
            return
        parameter = self.parameters.at(index) if index >= 0 else None
        if index < 0 and name in self.parameters:
            parameter = self.parameters[name]
        if parameter is None:
            self._parameter_error(link, message, name, index, 1)
            return
        self._send_parameter(link, parameter)

    def _on_parameter_set(self, link: Link, message: Any) -> None:
        name = _text_of(message.param_id)
        if name == HASH_CHECK:
            link.parameters_left.clear()  # the client has them cached: PX4 stops its list
            return
        try:
            parameter = self.parameters[name]
        except UnknownParameterError:
            self._parameter_error(link, message, name, -1, 1)
            return
        if parameter.kind != message.param_type:
            self._parameter_error(link, message, name, -1, 7)
            return
        value = decode_wire_value(parameter.kind, message.param_value)
        try:
            changed = self.parameters.set(name, value)
        except ValueError as error:
            logger.info("refused: %s", error)
            changed = parameter
        self._send_parameter(link, changed)
        self._after(SECOND_PARAMETER_ECHO_S, lambda: self._send_parameter(link, self.parameters[name]))

    def _parameter_error(self, link: Link, message: Any, name: str, index: int, error: int) -> None:
        self._send(
            link,
            dialect.MAVLink_param_error_message(
                message.get_srcSystem(), message.get_srcComponent(), name.encode(), index, error
            ),
        )


def _text_of(field: str | bytes) -> str:
    text = field.decode(errors="replace") if isinstance(field, bytes) else field
    return text.split("\0", 1)[0]


_HANDLERS: dict[str, Callable[[Vehicle, Link, Any], None]] = {
    "HEARTBEAT": Vehicle._on_heartbeat,
    "COMMAND_LONG": Vehicle._on_command,
    "COMMAND_INT": Vehicle._on_command,
    "SET_MODE": Vehicle._on_set_mode,
    "SET_POSITION_TARGET_LOCAL_NED": Vehicle._on_setpoint,
    "TIMESYNC": Vehicle._on_timesync,
    "PING": Vehicle._on_ping,
    "PARAM_REQUEST_LIST": Vehicle._on_parameter_list,
    "PARAM_REQUEST_READ": Vehicle._on_parameter_read,
    "PARAM_SET": Vehicle._on_parameter_set,
    "MISSION_REQUEST_LIST": Vehicle._on_mission_request_list,
}
