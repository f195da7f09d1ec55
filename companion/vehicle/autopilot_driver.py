"""Common base of the drivers: connection, vehicle state, commands.

A subclass adds the encoding and decoding of messages, and the command and parameter protocols. Everything
runs in one asyncio loop, and every byte is sent from that loop: when it hangs, nothing is sent.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
import struct
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from companion.host.clock import StandstillWatch
from companion.host.tasks import keep_running, spawn
from companion.vehicle.autopilot_parameters import FirmwareVersion
from companion.vehicle.autopilot_profile import POSITION_TARGET_ID, AutopilotProfile, Px4Profile
from companion.vehicle.byte_link import ByteLink, Source, open_link
from companion.vehicle.commander import NAME as COMMANDER_NAME
from companion.vehicle.commander import ONBOARD_CONTROLLER, commander_mode, read_commander
from companion.vehicle.connection_advice import no_answer_advice, no_autopilot_text, unsupported_autopilot
from companion.vehicle.driver import (
    CommandRefusedError,
    LinkError,
    LinkUnavailableError,
    NoAnswerError,
    OnBytes,
    SystemStatus,
)
from companion.vehicle.flight_commands import FlightCommands
from companion.vehicle.framing import CURRENT_MODE_ID, Frame, pack_frame
from companion.vehicle.gimbal import Address, GimbalAim, address_text
from companion.vehicle.gimbal_commands import GimbalCommands
from companion.vehicle.harmless import are_harmless
from companion.vehicle.landing_target import LandingTarget, landing_target_fields
from companion.vehicle.link_url import LinkScheme, LinkUrl
from companion.vehicle.mav_result import result_name
from companion.vehicle.obstacle_distance import obstacle_distance_fields
from companion.vehicle.own_address import LISTEN_JITTER_S, LISTEN_S, OwnAddress
from companion.vehicle.reception import Reception, ReceptionCounts
from companion.vehicle.report_reader import ReportReader
from companion.vehicle.setpoint import LEAVES_WITHIN_S, Setpoint, setpoint_fields
from companion.vehicle.setpoint_echo import NAME as ECHO_NAME
from companion.vehicle.signing import FrameSigner, is_signed_with_a_key
from companion.vehicle.state import HEARTBEAT_MAX_AGE_S, FlightMode, VehicleState
from companion.vehicle.stream_requests import StreamRequests
from companion.vehicle.telemetry import Fields
from companion.vehicle.telemetry_state import TelemetryState
from companion.vehicle.vehicle_type import ARDUPILOT, COPTER_PARAMETER, PLANE_PARAMETER, PX4
from companion.vehicle.vision_position import VisionPosition, vision_position_fields
from vision.obstacle_sectors import ObstacleSectors

logger = logging.getLogger(__name__)

# MAVLink common
HEARTBEAT_ID = 0
AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_AUTOPILOT_INVALID = 8  # MAV_AUTOPILOT: not an autopilot
_HEARTBEAT = struct.Struct(
    "<IBBBBB"
)  # custom_mode, type, autopilot, base_mode, system_status, mavlink_version
_CURRENT_MODE = struct.Struct("<II")  # custom_mode, intended_custom_mode; standard_mode is not read
EXTENDED_SYS_STATE_ID = 245
_COMMAND_LONG_ID = 76
_COMMAND_LONG = struct.Struct("<7fHBBB")  # parameters, command, target system, component, confirmation
_COMMAND_ACK_ID = 77
_COMMAND_ACK = struct.Struct("<HBBiBB")  # command, result, progress, result_param2, target system, component
_NAMED_VALUE_INT_ID = 252
_NAMED_VALUE_INT = struct.Struct("<II10s")  # time_boot_ms, value, name
_TIMESYNC_ID = 111
_SYSTEM_TIME_ID = 2
_SYSTEM_TIME = struct.Struct("<QI")  # time_unix_usec, time_boot_ms
_SETPOINT_ID = 84  # SET_POSITION_TARGET_LOCAL_NED
# POSITION_TARGET_LOCAL_NED: time_boot_ms, position, velocity, acceleration, yaw and its rate, mask, frame
_POSITION_TARGET = struct.Struct("<I11fHB")
_AUTOPILOT_VERSION_ID = 148
_AUTOPILOT_VERSION = struct.Struct("<QQI")  # capabilities, uid, flight_sw_version; the rest is not read
_REQUEST_MESSAGE = 512
_VERSION_TIMEOUT_S = 2.0
# Without a limit for the heartbeat: for one try to open the link, and for the library afterwards.
_OPEN_S, _ATTACH_S = 5.0, 10.0
_TIMESYNC = struct.Struct("<qqBB")  # tc1, ts1, target system and component
_TIMESYNC_PERIOD_S = 0.5
_IDENTIFY_PERIOD_S = 1.0
_TIMESYNCS_KEPT = 8  # those of the last 4 s
_MOST_OTHERS = 64  # senders that are logged


class AutopilotDriver(ABC):
    """The part of a driver above the encoding. `companion.vehicle.driver.Driver` has the contract."""

    library: str
    supported_autopilots: frozenset[int] = frozenset({PX4})  # MAV_AUTOPILOT

    def __init__(
        self,
        url: LinkUrl,
        *,
        system_id: int | None,
        own_system_id: int,
        own_component_id: int,
        other_component_ids: Sequence[int] = (),
        signer: FrameSigner | None = None,
        range_finder_height: bool = False,
        on_bytes: OnBytes | None = None,
    ) -> None:
        self.url = url
        self._on_bytes = on_bytes
        self._signer = signer
        self._wanted_system_id = system_id
        self._own_system_id = own_system_id
        self._address = OwnAddress(own_system_id, own_component_id, other_component_ids)
        self.watch = StandstillWatch()
        self._started_ns = time.monotonic_ns()
        self._telemetry = TelemetryState(
            url, self._warn_other_autopilot, range_finder_height, self._address.address
        )
        self._flight_commands = FlightCommands(
            url,
            self._telemetry,
            self._command,
            self._send_once,
            self._ack_is_ours,
            self._no_answer,
            lambda: self.watch.now_ns(),
        )
        self._gimbal_commands = GimbalCommands(url, self._telemetry, self._command)
        self._command_locks: dict[int, asyncio.Lock] = {}
        self._link: ByteLink | None = None
        self._reset()

    def _reset(self) -> None:
        self._telemetry.reset()
        self._reception = Reception()
        self._system_id: int | None = None
        self._autopilot_kind: int | None = None
        self._source: Source = None
        self._newest_heartbeat: Frame | None = None
        self._timesync_sent_ns = 0
        self._timesyncs_ns: deque[int] = deque(maxlen=_TIMESYNCS_KEPT)
        self._address.forget()
        self._heartbeat_received = asyncio.Event()
        self._version: FirmwareVersion | None = None
        self._version_received = asyncio.Event()
        self._others: set[tuple[Any, ...]] = set()
        self._time_sent_ns = 0
        self._signs = False  # the autopilot signs with a key of its own
        self._signs_since_ns = 0
        self._withheld = ""  # the logged reason
        self._only_heartbeats = True
        self.link_count = 0
        self._streams: StreamRequests | None = None
        self._reports = ReportReader(
            self.url,
            self._telemetry,
            self._transmit_payload,
            self._command,
            lambda: (self._system_id or 0, AUTOPILOT_COMPONENT),
        )
        self._sequence = 0
        self._tasks: list[asyncio.Task[None]] = []

    # --- the encoding, implemented by subclasses ------------------------------------------------------

    @abstractmethod
    async def _attach(self, timeout_s: float) -> None:
        """Prepare to exchange messages, after the first heartbeat. Raises LinkError."""

    @abstractmethod
    async def _detach(self) -> None:
        """Undo `_attach`, also after a failed one. Never raises."""

    @abstractmethod
    def _on_frames(self, frames: list[Frame]) -> None:
        """Decode frames of the selected system and pass them to `_telemetry.handle`."""

    @abstractmethod
    def _send_message(self, name: str, fields: dict[str, Any]) -> None:
        """Send one message."""

    @abstractmethod
    async def _exchange_command(self, command: int, parameters: tuple[float, ...]) -> int:
        """Send a COMMAND_LONG, repeated until acknowledged, and return its MAV_RESULT.

        Raises CommandRefusedError.
        """

    @abstractmethod
    async def get_parameter(self, name: str) -> float:
        """See Driver."""

    @abstractmethod
    async def set_parameter(self, name: str, value: float) -> None:
        """See Driver."""

    # --- connection ---------------------------------------------------------------------------------

    async def connect(self, timeout_s: float | None, on_wait: Callable[[str], None] = lambda _: None) -> None:
        """See Driver. A UDP listener sends nothing first; on other links our heartbeat prompts a reply."""
        if self._link is not None:
            raise LinkError(f"{self.url}: this driver is already connected")
        began_s = time.monotonic()
        open_s = _OPEN_S if timeout_s is None else timeout_s
        self._reset()
        try:
            async with asyncio.timeout(open_s):
                self._link = await open_link(self.url, self._received)
        except TimeoutError as error:
            raise LinkUnavailableError(f"{self.url}: could not be opened within {open_s:g} s") from error
        try:
            opened_s = time.monotonic()
            await self._first_heartbeat(timeout_s, on_wait)
            if self._autopilot_kind not in self.supported_autopilots:
                raise LinkError(unsupported_autopilot(self.url, self._system_id, self._autopilot_kind))
            await self._choose_address(opened_s)
            left_s = _ATTACH_S if timeout_s is None else began_s + timeout_s - time.monotonic()
            await self._attach(max(left_s, 1.0))
            await self._identify()
        except BaseException:
            await self.close()
            raise
        self._start_tasks()

    async def _identify(self) -> None:
        """Find out whether an ArduPilot that reports a multicopter's type is a quadplane (`vehicle_type`).

        Without an answer it is not known, and nothing that moves the vehicle is sent.
        """
        if self._autopilot_kind != ARDUPILOT:
            return
        for name, is_plane in ((COPTER_PARAMETER, False), (PLANE_PARAMETER, True)):
            with contextlib.suppress(CommandRefusedError):
                await self.get_parameter(name)
                self._telemetry.use_program(is_plane=is_plane)
                return

    async def _keep_identified(self) -> None:
        """Ask whenever it is not known: also after a restart, a silence and a standstill."""

        def due() -> bool:
            state = self._telemetry.state
            return state.is_plane is None and state.connected(time.monotonic_ns())

        while self._autopilot_kind == ARDUPILOT:
            await self._telemetry.until(due, None)
            await self._identify()
            if self._telemetry.state.is_plane is None:
                await asyncio.sleep(_IDENTIFY_PERIOD_S)  # an error may come at once

    def _start_tasks(self) -> None:
        name = self._telemetry.profile.name
        logger.info(
            "%s: connected to %s, system %s: %s driver", self.url, name, self._system_id, self.library
        )
        self._streams = StreamRequests(self.url, self._telemetry, self._command)
        loops: dict[str, Callable[[], Coroutine[Any, Any, None]]] = {
            "supervisor": partial(self._supervise, self._streams),
            "streams": self._streams.run,
            "clock": self._synchronise,
            "identity": self._keep_identified,
            "gimbal": self._gimbal_commands.run,
        }
        if self._telemetry.profile.has_events:
            loops["events"] = self._reports.load_events
        for what, loop in loops.items():
            name = f"{what} of {self.url}"
            self._tasks.append(spawn(keep_running(name, loop), name))

    async def close(self) -> None:
        """See Driver."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._flight_commands.close()
        try:
            await self._detach()
        finally:
            link, self._link = self._link, None
            if link is not None:
                await link.close()

    async def _first_heartbeat(self, timeout_s: float | None, on_wait: Callable[[str], None]) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while not self._heartbeat_received.is_set():
                    if self.url.scheme is not LinkScheme.UDP_IN:
                        self._prompt()
                    if not await _wait_event(self._heartbeat_received, 1.0):
                        on_wait(self._no_autopilot(None))
        if not self._heartbeat_received.is_set():
            raise LinkUnavailableError(self._no_autopilot(timeout_s))

    def _no_autopilot(self, timeout_s: float | None) -> str:
        return no_autopilot_text(
            self.url,
            timeout_s,
            wanted_system_id=self._wanted_system_id,
            others=self._others,
            signer=self._signer,
            skipped_bytes=self._reception.counts.skipped_bytes,
        )

    def _prompt(self) -> None:
        """Send a heartbeat, so that the peer learns where we are, before our address is chosen.

        A router forwards nothing to us that has an address with which we have sent. So this one has the last
        address that would be chosen, and not the mark of a service.
        """
        payload = _HEARTBEAT.pack(0, ONBOARD_CONTROLLER, _AUTOPILOT_INVALID, 0, int(SystemStatus.ACTIVE), 3)
        self._transmit_payload(HEARTBEAT_ID, payload, self._address.last)

    async def _choose_address(self, opened_s: float) -> None:
        """Wait for the heartbeats of other programs, before the first own one, and choose a free address."""
        if not self._address.others:
            return
        until_s = opened_s + LISTEN_S + random.uniform(0.0, LISTEN_JITTER_S)
        await asyncio.sleep(max(until_s - time.monotonic(), 0.0))
        before = self._address.address
        if self._address.is_taken(time.monotonic_ns()) and self._address.change(time.monotonic_ns()):
            self._telemetry.use_address(self._address.address)
            logger.warning(
                "%s: MAVLink address %s is used by another program: ours is %s",
                self.url,
                address_text(before),
                address_text(self._address.address),
            )
        self.send_heartbeat(SystemStatus.ACTIVE)  # others that listen now see that it is taken

    def change_address(self) -> bool:
        """See Driver."""
        gimbal = self._telemetry.state.gimbal
        if gimbal is not None and gimbal.primary_control == self._address.address:
            return False
        if self._flight_commands.in_transit:
            return False
        if not self._can_change_address or not self._address.change(time.monotonic_ns(), at_random=True):
            return False
        self._telemetry.use_address(self._address.address)
        return True

    @property
    def _can_change_address(self) -> bool:
        """Whether the encoding allows another address now."""
        return True

    # --- receiving ----------------------------------------------------------------------------------

    def _received(self, data: bytes, source: Source) -> None:
        link = self._link
        if link is None:
            return
        if self._on_bytes is not None:
            self._on_bytes(False, data)
        ours: list[Frame] = []
        for frame in self._reception.feed(data, source, datagram=link.datagrams, keep=self._source):
            if self._signer is not None and not self._signer.accepts(frame):
                if self._signer.peer_late and self._source is None:
                    self._send_signed_time(source)
                continue
            if frame.message_id == HEARTBEAT_ID:
                self._heartbeat_from(frame, source)
            elif frame.message_id == _NAMED_VALUE_INT_ID:
                _, value, name = _NAMED_VALUE_INT.unpack(frame.padded(_NAMED_VALUE_INT.size))
                if name.rstrip(b"\0") == COMMANDER_NAME:
                    self._commander_from(frame, source, ONBOARD_CONTROLLER, value)
            if frame.system_id == self._system_id and source == self._source:
                if frame.component_id == AUTOPILOT_COMPONENT:
                    self._reception.autopilot(frame)
                    self._only_heartbeats &= frame.message_id == HEARTBEAT_ID
                    if self._streams is not None:
                        self._streams.monitor.received(frame.message_id)
                    if frame.message_id == _TIMESYNC_ID:
                        self._time_from(frame)
                    elif frame.message_id == _SYSTEM_TIME_ID:
                        _, boot_ms = _SYSTEM_TIME.unpack(frame.padded(_SYSTEM_TIME.size))
                        self._telemetry.watch_clock("SYSTEM_TIME", boot_ms, time.monotonic_ns())
                    elif frame.message_id == _AUTOPILOT_VERSION_ID:
                        _, _, encoded = _AUTOPILOT_VERSION.unpack(frame.padded(_AUTOPILOT_VERSION.size))
                        self._version = FirmwareVersion.of(encoded)
                        self._version_received.set()
                    elif frame.message_id == CURRENT_MODE_ID:
                        self._current_mode_from(frame)
                        continue
                    elif frame.message_id == EXTENDED_SYS_STATE_ID:
                        self._extended_sys_state_from(frame)
                        continue
                    elif frame.message_id == POSITION_TARGET_ID:
                        self._position_target_from(frame)
                        continue
                    elif frame.message_id == _COMMAND_ACK_ID:
                        self._acknowledgement_from(frame)
                    elif self._reports.on_frame(frame):
                        continue
                ours.append(frame)
        if ours and self._autopilot_kind in self.supported_autopilots:
            self._on_frames(ours)

    def abandon(self, why: str) -> None:
        """See Driver."""
        self._flight_commands.abandon(why)

    def discard_received(self) -> None:
        """See Driver. The autopilot's heartbeat counts as lost until the next one."""
        if self._link is not None:
            self._link.discard_received()
        self._reception.discard_received()
        self._telemetry.discard_received()

    def _send_signed_time(self, source: Source) -> None:
        """Send a signed heartbeat: a peer with an old clock takes its time from it (PX4 after a restart)."""
        now_ns = time.monotonic_ns()
        if self._link is not None and now_ns - self._time_sent_ns >= 1e9:
            self._time_sent_ns = now_ns
            self._link.answer_to(source)
            self.send_heartbeat(SystemStatus.ACTIVE)

    def _heartbeat_from(self, frame: Frame, source: Source) -> None:
        custom_mode, mav_type, autopilot, base_mode, system_status, _ = _HEARTBEAT.unpack(
            frame.padded(_HEARTBEAT.size)
        )
        sender = (frame.system_id, frame.component_id)
        is_autopilot = frame.component_id == AUTOPILOT_COMPONENT and autopilot != _AUTOPILOT_INVALID
        wanted = self._wanted_system_id if self._system_id is None else self._system_id
        if not is_autopilot or wanted not in (None, frame.system_id):
            self._note_other(sender, "system/component %d/%d is also on this link")
            self._on_other_heartbeat(frame, source, custom_mode)
            self._commander_from(frame, source, mav_type, custom_mode)
            return
        if self._system_id is None:
            self._system_id, self._autopilot_kind = frame.system_id, autopilot
            self._telemetry.profile = profile_of(autopilot)
            self._telemetry.state = replace(self._telemetry.state, autopilot=self._telemetry.profile.name)
        elif source != self._source and self._telemetry.state.connected(time.monotonic_ns()):
            # Following the latest sender would command two vehicles alternately.
            self._note_other(
                (*sender, source), "a second autopilot %d/%d sends from %s: ignored; set a unique MAV_SYS_ID"
            )
            return
        self._source = source
        self._address.only_from(source)
        if self._link is not None:
            self._link.answer_to(source)
        self._newest_heartbeat = frame
        if self._signs != (signs := is_signed_with_a_key(frame.raw)):
            self._signs, self._signs_since_ns = signs, time.monotonic_ns()
        fields = {
            "type": mav_type,
            "autopilot": autopilot,
            "custom_mode": custom_mode,
            "base_mode": base_mode,
            "system_status": system_status,
        }
        self._telemetry.handle("HEARTBEAT", fields)
        self._heartbeat_received.set()

    def _current_mode_from(self, frame: Frame) -> None:
        """Apply a CURRENT_MODE here, like HEARTBEAT: a library may deliver it after newer heartbeats."""
        if self._autopilot_kind in self.supported_autopilots:
            shown, intended = _CURRENT_MODE.unpack(frame.padded(_CURRENT_MODE.size))
            fields = {"custom_mode": shown, "intended_custom_mode": intended}
            self._telemetry.handle("CURRENT_MODE", fields)

    def _extended_sys_state_from(self, frame: Frame) -> None:
        """Apply an EXTENDED_SYS_STATE here: a library may deliver it after what ended its validity."""
        if self._autopilot_kind in self.supported_autopilots:
            vtol_state, landed_state = frame.padded(2)
            fields = {"vtol_state": vtol_state, "landed_state": landed_state}
            self._telemetry.handle("EXTENDED_SYS_STATE", fields)

    def _position_target_from(self, frame: Frame) -> None:
        """Apply a POSITION_TARGET_LOCAL_NED here: its order among the reports of the mode counts."""
        if self._autopilot_kind in self.supported_autopilots:
            _, *values, mask, _ = _POSITION_TARGET.unpack(frame.padded(_POSITION_TARGET.size))
            named = zip(("x", "y", "z", "vx", "vy", "vz"), values, strict=False)
            self._telemetry.handle(ECHO_NAME, {"type_mask": mask, **dict(named)})

    def _acknowledgement_from(self, frame: Frame) -> None:
        """Apply a COMMAND_ACK here: its order among the reports of the mode counts (`mode_changes`).

        One that we have not asked for shows another program with our address.
        """
        if self._autopilot_kind in self.supported_autopilots:
            now_ns = time.monotonic_ns()
            command, result, *_, system, component = _COMMAND_ACK.unpack(frame.padded(_COMMAND_ACK.size))
            if (system, component) == self.own_address and self._address.is_foreign_ack(command, now_ns):
                self._telemetry.on_shared_address(now_ns, commands=True)
            target = {"target_system": system, "target_component": component}
            self._telemetry.handle("COMMAND_ACK", {"command": command, "result": result, **target})

    def _on_other_heartbeat(self, frame: Frame, source: Source, custom_mode: int) -> None:
        """Note the address of another program, which may be ours."""
        now_ns = time.monotonic_ns()
        if self._address.on_heartbeat(frame, source, custom_mode, now_ns) and source == self._source:
            self._telemetry.on_shared_address(now_ns, commands=False)

    def _commander_from(self, frame: Frame, source: Source, mav_type: int, custom_mode: int) -> None:
        """Note another service on this vehicle, if the message is one's.

        Only as the autopilot, or a router in its place, forwards it: else anybody who can send to this port
        could prevent every flight.
        """
        if self._system_id is None or source != self._source:
            return
        sender = (frame.system_id, frame.component_id)
        commander = read_commander(mav_type, custom_mode, sender, time.monotonic_ns())
        is_ours = self._address.is_echo(frame, custom_mode)
        if commander is not None and frame.system_id == self._own_system_id and not is_ours:
            self._telemetry.on_commander(commander)

    def _no_answer(self, text: str) -> NoAnswerError:
        """Build the error for a command or parameter request without an answer."""
        answered_ns = self._telemetry.answered_ns
        advice = no_answer_advice(
            signs=self._signs,
            has_key=self._signer is not None,
            only_heartbeats=self._only_heartbeats,
            answered_ago_s=(time.monotonic_ns() - answered_ns) / 1e9
            if answered_ns > self._signs_since_ns
            else None,
        )
        return NoAnswerError(f"{text}; {advice}" if advice else text)

    def _time_from(self, frame: Frame) -> None:
        """Process the reply to `_synchronise`; the autopilot's own requests have `tc1` = 0."""
        now_ns = time.monotonic_ns()
        boot_ns, sent_ns, system, component = _TIMESYNC.unpack(frame.padded(_TIMESYNC.size))
        # Our own stamp identifies the reply: PX4 v1.16.2 does not set its target, which is then any number;
        # older autopilots leave it 0.
        if boot_ns > 0 and sent_ns in self._timesyncs_ns:
            self._telemetry.answered_ns = max(self._telemetry.answered_ns, sent_ns)
        elif boot_ns > 0 and (system, component) == self.own_address:
            self._on_foreign_timesync(now_ns)
        if not (boot_ns > 0 and sent_ns == self._timesync_sent_ns):
            return
        self._telemetry.watch_clock("TIMESYNC", boot_ns // 1_000_000, now_ns)
        if self._telemetry.clock.answer(sent_ns, boot_ns, now_ns):
            self._telemetry.state = replace(self._telemetry.state, clock=self._telemetry.clock.offset(now_ns))

    def _on_foreign_timesync(self, now_ns: int) -> None:
        if self._address.is_foreign_timesync(now_ns):
            self._telemetry.on_shared_address(now_ns, commands=False)

    def _note_other(self, sender: tuple[Any, ...], text: str) -> None:
        if sender not in self._others and len(self._others) < _MOST_OTHERS:
            self._others.add(sender)
            logger.info("%s: " + text, self.url, *sender)

    @property
    def reception(self) -> ReceptionCounts:
        """See Driver."""
        return self._reception.counts

    @property
    def state(self) -> VehicleState:
        """See Driver."""
        return self._telemetry.state

    def subscribe(self, callback: Callable[[VehicleState], None]) -> Callable[[], None]:
        """See Driver."""
        return self._telemetry.subscribe(callback)

    def _warn_other_autopilot(self) -> None:
        logger.error(
            "%s: two autopilots send as system %s from one address: set a unique MAV_SYS_ID on each",
            self.url,
            self._system_id,
        )

    # --- sending ------------------------------------------------------------------------------------

    def _transmit(self, frame: bytes) -> None:
        if self._link is None:
            return
        ready = frame if self._signer is None else self._signer.signed(frame)
        # A stopped process resumes where it was, perhaps after the freshness check of a setpoint; sending it
        # would return PX4 to OFFBOARD.
        stamp_ms = _setpoint_stamp_ms(frame)
        if stamp_ms is not None and (self._boot_ms() - stamp_ms) & 0xFFFF_FFFF > LEAVES_WITHIN_S * 1e3:
            self._warn_stale_setpoint()
            return
        if self._is_withheld(frame):
            return
        self._link.send(ready)
        if self._on_bytes is not None:
            self._on_bytes(True, ready)

    def _is_withheld(self, frame: bytes) -> bool:
        """Whether a frame may not go to this vehicle, or not now. Everything that is sent passes here.

        What the callers refuse beforehand may have been sent by then, and would be repeated. After a
        standstill a repetition from before may come first, until the loop that steers has ended it.
        """
        standstill = self.watch.observe().standstill
        why = self._telemetry.state.not_flown or (None if standstill is None else standstill.why)
        if why is None or are_harmless(frame):
            return False
        if why != self._withheld:
            logger.warning("%s: nothing is sent that moves the vehicle: %s", self.url, why)
        self._withheld = why
        return True

    def _check_flown(self, what: str) -> None:
        """Raise CommandRefusedError for a vehicle that is not flown."""
        if (why := self._telemetry.state.not_flown) is not None:
            raise CommandRefusedError(f"{what} not sent: {why}")

    def _boot_ms(self) -> int:
        return (self.watch.now_ns() - self._started_ns) // 1_000_000 & 0xFFFF_FFFF

    def _warn_stale_setpoint(self) -> None:
        logger.warning("%s: setpoint dropped: it expired before it was sent", self.url)

    def _next_sequence(self) -> int:
        sequence, self._sequence = self._sequence, (self._sequence + 1) & 0xFF
        return sequence

    def _transmit_payload(self, message_id: int, payload: bytes, component_id: int | None = None) -> None:
        self._transmit(
            pack_frame(
                message_id,
                payload,
                system_id=self._own_system_id,
                component_id=self.own_address[1] if component_id is None else component_id,
                sequence=self._next_sequence(),
            )
        )

    def send_heartbeat(
        self, status: SystemStatus, *, uptime_s: float | None = None, in_command: bool = False
    ) -> None:
        """See Driver."""
        own_uptime_s = (time.monotonic_ns() - self._started_ns) / 1e9
        mode = commander_mode(own_uptime_s if uptime_s is None else uptime_s, in_command)
        payload = _HEARTBEAT.pack(mode, ONBOARD_CONTROLLER, _AUTOPILOT_INVALID, 0, int(status), 3)
        self._address.sent(self._sequence, mode)
        self._transmit_payload(HEARTBEAT_ID, payload)
        if self._autopilot_kind == ARDUPILOT:  # it keeps this heartbeat from another service with our address
            payload = _NAMED_VALUE_INT.pack(self._boot_ms(), mode, COMMANDER_NAME)
            self._address.sent(self._sequence, mode)
            self._transmit_payload(_NAMED_VALUE_INT_ID, payload)

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """See Driver."""
        if self._link is None or self._system_id is None:
            return
        stamp_ms = self._boot_ms()
        # Checked after the stamp: if the process is stopped between the two, one of them detects it.
        if setpoint.expired(self.watch.now_ns()):
            self._warn_stale_setpoint()
            return
        setpoint = setpoint.moved(self._telemetry.state.reset_offset_ned_m)
        fields = setpoint_fields(setpoint, self._system_id, stamp_ms)
        self._telemetry.echo.sent(fields, time.monotonic_ns())
        self._send_message("SET_POSITION_TARGET_LOCAL_NED", self._telemetry.profile.setpoint_fields(fields))

    def send_landing_target(self, target: LandingTarget) -> None:
        """See Driver."""
        if self._link is not None and self._system_id is not None:
            offset = self._telemetry.state.reset_offset_ned_m
            fields = landing_target_fields(target, self._autopilot_kind or 0, offset)
            self._send_message("LANDING_TARGET", fields)

    def send_obstacle_distance(self, sectors: ObstacleSectors) -> None:
        """See Driver."""
        yaw_rad = self._telemetry.state.yaw_rad
        if self._link is not None and self._system_id is not None and yaw_rad is not None:
            self._send_message("OBSTACLE_DISTANCE", obstacle_distance_fields(sectors, yaw_rad))

    def send_vision_position(self, vision: VisionPosition) -> None:
        """See Driver."""
        if self._link is not None and self._system_id is not None:
            self._send_message("VISION_POSITION_ESTIMATE", vision_position_fields(vision))

    # --- commands -----------------------------------------------------------------------------------

    async def _command(self, command: int, *parameters: float) -> int:
        """Send a command and return its MAV_RESULT; one at a time per kind, as the protocol requires."""
        if self._link is None:
            raise CommandRefusedError(f"{self.url}: not connected; command {command} was not sent")
        lock = self._command_locks.setdefault(command, asyncio.Lock())
        async with lock:
            try:
                self._address.asked(command, time.monotonic_ns())
                return await self._exchange_command(command, (*parameters, *[0.0] * (7 - len(parameters))))
            finally:
                self._address.asked(command, time.monotonic_ns())

    def _send_command(self, command: int, parameters: tuple[float, ...], confirmation: int) -> None:
        """Send one COMMAND_LONG, once and at once. `parameters`: all seven.

        Not by a library: `mode_changes` relies on the order of commands and TIMESYNC requests on the link.
        """
        target = (self._system_id or 0, AUTOPILOT_COMPONENT)
        payload = _COMMAND_LONG.pack(*parameters, command, *target, confirmation)
        self._transmit_payload(_COMMAND_LONG_ID, payload)

    def _send_once(self, command: int, parameters: tuple[float, ...], confirmation: int) -> None:
        """Send a command that changes the mode: only `mode_changes` repeats it."""
        if self._link is None:
            raise CommandRefusedError(f"{self.url}: not connected; command {command} was not sent")
        self._address.asked(command, time.monotonic_ns())
        self._send_command(command, (*parameters, *[0.0] * (7 - len(parameters))), confirmation)

    async def arm(self, *, since: VehicleState | None = None, valid_until_ns: int | None = None) -> None:
        """See Driver."""
        self._check_flown("arm")
        await self._flight_commands.arm_or_disarm(
            True, self._system_id, since=since, valid_until_ns=valid_until_ns
        )

    async def disarm(self, *, since: VehicleState | None = None, valid_until_ns: int | None = None) -> None:
        """See Driver."""
        self._check_flown("disarm")
        await self._flight_commands.arm_or_disarm(
            False, self._system_id, since=since, valid_until_ns=valid_until_ns
        )

    async def set_mode(
        self,
        mode: FlightMode,
        *,
        timeout_s: float = 3.0,
        since: VehicleState | None = None,
        valid_until_ns: int | None = None,
    ) -> None:
        """See Driver."""
        self._check_flown(f"mode {mode}")
        await self._flight_commands.set_mode(
            mode, timeout_s=timeout_s, since=since, valid_until_ns=valid_until_ns
        )

    async def takeoff(
        self, altitude_m: float, *, since: VehicleState | None = None, valid_until_ns: int | None = None
    ) -> None:
        """See Driver."""
        self._check_flown("take-off")
        await self._flight_commands.takeoff(altitude_m, since=since, valid_until_ns=valid_until_ns)

    async def settle(self) -> None:
        """See Driver."""
        await self._flight_commands.settled()

    async def firmware_version(self) -> FirmwareVersion:
        """See Driver."""
        self._version_received.clear()
        result = await self._command(_REQUEST_MESSAGE, _AUTOPILOT_VERSION_ID)
        if not await _wait_event(self._version_received, _VERSION_TIMEOUT_S) or self._version is None:
            raise CommandRefusedError(f"firmware version: no AUTOPILOT_VERSION ({result_name(result)})")
        return self._version

    @property
    def own_address(self) -> Address:
        """See Driver."""
        return self._address.address

    async def find_gimbal(self) -> bool:
        """See Driver."""
        return await self._gimbal_commands.find()

    async def take_gimbal(self) -> None:
        """See Driver."""
        await self._gimbal_commands.take_control()

    async def point_gimbal(self, aim: GimbalAim) -> None:
        """See Driver."""
        await self._gimbal_commands.point(aim)

    async def give_gimbal_back(self) -> None:
        """See Driver."""
        await self._gimbal_commands.release_control()

    def _ack_is_ours(self, fields: Fields) -> bool:
        """Whether a COMMAND_ACK is for us; MAVLink 1 and broadcasting autopilots leave the target 0."""
        target = (fields.get("target_system", 0), fields.get("target_component", 0))
        system, component = self.own_address
        return target[0] in (0, system) and target[1] in (0, component)

    # --- link supervision ---------------------------------------------------------------------------

    async def _supervise(self, streams: StreamRequests) -> None:
        """Log when the autopilot goes silent, restarts and returns, and request its streams again then."""
        while True:
            self._telemetry.restarted.clear()
            self.link_count += 1
            streams.restart()
            self._gimbal_commands.request_search()
            if not await self._wait_silent():
                logger.warning("%s: system %s has restarted", self.url, self._system_id)
                continue
            logger.error(
                "%s: system %s: no heartbeat for %g s",
                self.url,
                self._system_id,
                HEARTBEAT_MAX_AGE_S,
            )
            await self._telemetry.until(lambda: self._telemetry.state.connected(time.monotonic_ns()), None)
            logger.warning("%s: system %s: heartbeat received again", self.url, self._system_id)

    async def _synchronise(self) -> None:
        """Send TIMESYNC requests until cancelled."""
        while True:
            self._timesync_sent_ns = time.monotonic_ns()
            self._timesyncs_ns.append(self._timesync_sent_ns)
            request = _TIMESYNC.pack(0, self._timesync_sent_ns, self._system_id or 0, AUTOPILOT_COMPONENT)
            self._transmit_payload(_TIMESYNC_ID, request)
            await asyncio.sleep(_TIMESYNC_PERIOD_S)

    async def _wait_silent(self) -> bool:
        """Wait until the newest heartbeat is too old (True) or the autopilot has restarted (False)."""
        while self._telemetry.state.connected(time.monotonic_ns()):
            left_s = (self._telemetry.state.heartbeat_ns - time.monotonic_ns()) / 1e9 + HEARTBEAT_MAX_AGE_S
            if await _wait_event(self._telemetry.restarted, max(left_s, 0.0) + 1e-3):
                return False
        return True


def _setpoint_stamp_ms(frame: bytes) -> int | None:
    """Return `time_boot_ms` of a MAVLink 2 SET_POSITION_TARGET_LOCAL_NED; None for any other frame."""
    if int.from_bytes(frame[7:10], "little") != _SETPOINT_ID:
        return None
    return int.from_bytes(frame[10 : 10 + min(4, frame[1])], "little")


def profile_of(autopilot: int) -> AutopilotProfile:
    """Return the profile of a MAV_AUTOPILOT; PX4's for an unsupported one."""
    if autopilot == ARDUPILOT:
        from companion.vehicle.ardupilot_profile import ArduPilotProfile

        return ArduPilotProfile()
    return Px4Profile()


async def _wait_event(event: asyncio.Event, timeout_s: float) -> bool:
    # Not asyncio.wait_for: before Python 3.12 it loses a cancellation that coincides with the event.
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(timeout_s):
            await event.wait()
    return event.is_set()
