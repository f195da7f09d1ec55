"""What both drivers share: finding the autopilot, its state, the meaning of the commands.

A driver built on this adds how messages are encoded and decoded, and how a command and a parameter travel.
All of it runs in one asyncio loop, and every byte leaves from that loop: when it hangs, nothing is sent.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import struct
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from typing import Any

from companion.vehicle.byte_link import ByteLink, Source, open_link
from companion.vehicle.clock_sync import ClockSync
from companion.vehicle.driver import CommandRefusedError, LinkError, SystemStatus
from companion.vehicle.framing import CURRENT_MODE_ID, Frame, Framer, pack_frame
from companion.vehicle.landing_target import LandingTarget, landing_target_fields
from companion.vehicle.link_url import LinkScheme, LinkUrl
from companion.vehicle.px4_modes import request_of_mode
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import HEARTBEAT_MAX_AGE_S, FlightMode, VehicleState
from companion.vehicle.telemetry_fold import Fields, fold

logger = logging.getLogger(__name__)

# MAVLink common
HEARTBEAT_ID = 0
AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_AUTOPILOT_INVALID = 8  # MAV_AUTOPILOT: not an autopilot
_AUTOPILOT_PX4 = 12
_AUTOPILOT_NAMES = {0: "a generic autopilot", 3: "ArduPilot"}
_ONBOARD_CONTROLLER = 18  # MAV_TYPE
_HEARTBEAT = struct.Struct(
    "<IBBBBB"
)  # custom_mode, type, autopilot, base_mode, system_status, mavlink_version
_FRAME_LOCAL_NED = 1
_MODE_FLAG_CUSTOM = 1

_DO_SET_MODE = 176
_NAV_TAKEOFF = 22
_COMPONENT_ARM_DISARM = 400
_SET_MESSAGE_INTERVAL = 511
_REQUEST_MESSAGE = 512
_HOME_POSITION_ID = 242

ACCEPTED, IN_PROGRESS = 0, 5
RESULT_NAMES = {
    0: "accepted",
    1: "temporarily rejected",
    2: "denied",
    3: "unsupported",
    4: "failed",
    5: "in progress",
    6: "cancelled",
}

# What we read, and the rate control needs. PX4's onboard link has most of it already.
WANTED_RATES_HZ = {
    31: 50.0,  # ATTITUDE_QUATERNION
    32: 30.0,  # LOCAL_POSITION_NED
    33: 5.0,  # GLOBAL_POSITION_INT
    1: 2.0,  # SYS_STATUS
    245: 5.0,  # EXTENDED_SYS_STATE
    CURRENT_MODE_ID: 10.0,  # HEARTBEAT alone shows a mode up to 1 s late
}
_MEASURE_S = 1.5
_RATE_TOLERANCE = 0.7
_BOOT_TOLERANCE_MS = 1000  # datagrams may overtake each other
# A restart sets the clock back once; so many times within so long are two clocks, heard by turns.
_SETBACKS_OF_TWO = 3
_TWO_CLOCKS_S = 2.0
_OF_ITS_PLACE = ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "ATTITUDE_QUATERNION")
_TIMESYNC_ID = 111
_TIMESYNC = struct.Struct("<qqBB")  # tc1, ts1, target system and component
_TIMESYNC_PERIOD_S = 0.5
_SHOWN_TIMEOUT_S = 3.0  # HEARTBEAT comes once a second


class AutopilotDriver(ABC):
    """The part of a driver above the encoding. See `companion.vehicle.driver.Driver` for the promises."""

    def __init__(
        self, url: LinkUrl, *, system_id: int | None, own_system_id: int, own_component_id: int
    ) -> None:
        self.url = url
        self._wanted_system_id = system_id
        self._own_system_id = own_system_id
        self._own_component_id = own_component_id
        self._started_ns = time.monotonic_ns()
        self._subscribers: dict[object, Callable[[VehicleState], None]] = {}
        self._watchers: dict[object, Callable[[str, Fields], None]] = {}
        self._command_locks: dict[int, asyncio.Lock] = {}
        self._link: ByteLink | None = None
        self._reset()

    def _reset(self) -> None:
        self._state = VehicleState()
        self._framer = Framer()
        self._system_id: int | None = None
        self._autopilot_kind: int | None = None
        self._source: Source = None
        self._newest_heartbeat: Frame | None = None
        self._boot_ms = 0
        self._setbacks_ns: deque[int] = deque(maxlen=_SETBACKS_OF_TWO)
        self._two_heard_ns = 0
        self._asked_ns = 0
        self._restarted = asyncio.Event()
        self._heard = asyncio.Event()
        self._clock = ClockSync()
        self._others: set[tuple[Any, ...]] = set()
        self._received_count: Counter[int] = Counter()
        self._mode_ns = 0
        self._sequence = 0
        self._keeper: asyncio.Task[None] | None = None
        self._synchroniser: asyncio.Task[None] | None = None

    # --- the encoding: what a driver adds -------------------------------------------------------------

    @abstractmethod
    async def _attach(self, timeout_s: float) -> None:
        """The autopilot was heard: get ready to exchange messages with it. Raises LinkError."""

    @abstractmethod
    async def _detach(self) -> None:
        """Undo `_attach`, also a half done one. Never raises."""

    @abstractmethod
    def _take_frames(self, frames: list[Frame]) -> None:
        """Decode frames of the chosen system; call `_handle` with what they say."""

    @abstractmethod
    def _send_message(self, name: str, fields: dict[str, Any]) -> None:
        """Put one message on the wire."""

    @abstractmethod
    async def _exchange_command(self, command: int, parameters: tuple[float, ...]) -> int:
        """Send a COMMAND_LONG, again until acknowledged; its MAV_RESULT. Raises CommandRefusedError."""

    @abstractmethod
    async def get_parameter(self, name: str) -> float:
        """See Driver."""

    @abstractmethod
    async def set_parameter(self, name: str, value: float) -> None:
        """See Driver."""

    # --- connection ---------------------------------------------------------------------------------

    async def connect(self, timeout_s: float) -> None:
        """See Driver. A UDP listener stays silent; on other links our heartbeat asks for an answer."""
        if self._link is not None:
            raise LinkError(f"{self.url}: this driver is connected already")
        self._reset()
        deadline = time.monotonic() + timeout_s
        try:
            async with asyncio.timeout(timeout_s):
                self._link = await open_link(self.url, self._received)
        except TimeoutError as error:
            raise LinkError(f"{self.url}: no answer to opening it within {timeout_s:g} s") from error
        try:
            await self._first_heartbeat(timeout_s)
            if self._autopilot_kind != _AUTOPILOT_PX4:
                raise LinkError(self._why_not_px4())
            await self._attach(max(deadline - time.monotonic(), 1.0))
        except BaseException:
            await self.close()
            raise
        logger.info("%s: PX4, system %s, answers", self.url, self._system_id)
        self._keeper = asyncio.create_task(self._keep(), name=f"keeper of {self.url}")
        self._synchroniser = asyncio.create_task(self._synchronise(), name=f"clock of {self.url}")

    async def close(self) -> None:
        """See Driver."""
        tasks = [task for task in (self._keeper, self._synchroniser) if task is not None]
        self._keeper = self._synchroniser = None
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        try:
            await self._detach()
        finally:
            link, self._link = self._link, None
            if link is not None:
                await link.close()

    async def _first_heartbeat(self, timeout_s: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while not self._heard.is_set():
                    if self.url.scheme is not LinkScheme.UDP_IN:
                        self.send_heartbeat(SystemStatus.ACTIVE)
                    await _happens(self._heard, 1.0)
        if not self._heard.is_set():
            raise LinkError(self._why_no_autopilot(timeout_s))

    def _why_no_autopilot(self, timeout_s: float) -> str:
        which = (
            "autopilot" if self._wanted_system_id is None else f"autopilot of system {self._wanted_system_id}"
        )
        if self._others:
            heard = ", ".join(f"{sender[0]}/{sender[1]}" for sender in sorted(self._others))
            advice = f"heard only system/component {heard}; check the system id and what is connected"
        elif self._framer.skipped_bytes:
            count = self._framer.skipped_bytes
            advice = f"{count} bytes came that are not MAVLink; check the baud rate and what is connected"
        elif self.url.scheme is LinkScheme.UDP_IN:
            advice = "nothing came at all; check that the vehicle is on and sends to this address and port"
        else:
            advice = "nothing came at all; check that the vehicle is on, and the address or device"
        return f"no {which} answered on {self.url} within {timeout_s:g} s: {advice}"

    def _why_not_px4(self) -> str:
        kind = self._autopilot_kind
        name = _AUTOPILOT_NAMES.get(kind or 0, f"MAV_AUTOPILOT {kind}")
        return f"{self.url}: only PX4 is supported so far, and system {self._system_id} is {name}"

    # --- receiving ----------------------------------------------------------------------------------

    def _received(self, data: bytes, source: Source) -> None:
        link = self._link
        if link is None:
            return
        ours: list[Frame] = []
        for frame in self._framer.feed(data, datagram=link.datagrams):
            if frame.message_id == HEARTBEAT_ID:
                self._heartbeat_from(frame, source)
            if frame.system_id == self._system_id and source == self._source:
                ours.append(frame)
                if frame.component_id == AUTOPILOT_COMPONENT:
                    self._received_count[frame.message_id] += 1
                    if frame.message_id == _TIMESYNC_ID:
                        self._time_from(frame)
        if ours and self._autopilot_kind == _AUTOPILOT_PX4:
            self._take_frames(ours)

    def _heartbeat_from(self, frame: Frame, source: Source) -> None:
        custom_mode, _, autopilot, base_mode, system_status, _ = _HEARTBEAT.unpack(
            frame.padded(_HEARTBEAT.size)
        )
        sender = (frame.system_id, frame.component_id)
        is_autopilot = frame.component_id == AUTOPILOT_COMPONENT and autopilot != _AUTOPILOT_INVALID
        wanted = self._wanted_system_id if self._system_id is None else self._system_id
        if not is_autopilot or wanted not in (None, frame.system_id):
            self._note_other(sender, "system/component %d/%d is also on this link")
            return
        if self._system_id is None:
            self._system_id, self._autopilot_kind = frame.system_id, autopilot
        elif source != self._source and self._state.connected(time.monotonic_ns()):
            # Obeying whoever spoke last would fly two vehicles by turns.
            self._note_other(
                (*sender, source), "a second autopilot %d/%d sends from %s; it is ignored: give it its own id"
            )
            return
        self._source = source
        if self._link is not None:
            self._link.answer_to(source)
        self._newest_heartbeat = frame
        fields = {"custom_mode": custom_mode, "base_mode": base_mode, "system_status": system_status}
        self._handle("HEARTBEAT", fields)
        self._heard.set()

    def _time_from(self, frame: Frame) -> None:
        """An answer to `_synchronise`; the autopilot's own questions have no `tc1`."""
        now_ns = time.monotonic_ns()
        boot_ns, asked_ns, system, component = _TIMESYNC.unpack(frame.padded(_TIMESYNC.size))
        # Older autopilots do not say whom they answer; our own stamp tells.
        for_us = (system, component) in ((0, 0), (self._own_system_id, self._own_component_id))
        if (
            boot_ns > 0
            and asked_ns == self._asked_ns
            and for_us
            and self._clock.answer(asked_ns, boot_ns, now_ns)
        ):
            self._state = replace(self._state, clock=self._clock.offset(now_ns))

    def _note_other(self, sender: tuple[Any, ...], text: str) -> None:
        if sender not in self._others:
            self._others.add(sender)
            logger.info("%s: " + text, self.url, *sender)

    def _handle(self, name: str, fields: Fields) -> None:
        """One message of the autopilot: into the state, and to whoever waits for it."""
        now_ns = time.monotonic_ns()
        if name == "LOCAL_POSITION_NED":
            self._watch_clock(fields["time_boot_ms"], now_ns)
        if name in ("HEARTBEAT", "CURRENT_MODE"):
            self._mode_ns = now_ns
        if name in _OF_ITS_PLACE and self._two_autopilots(now_ns):
            return  # Nobody can tell whose it is: what is known grows stale, and what needs it ends.
        stamp_ns = self._clock.stamp(fields["time_boot_ms"], now_ns) if "time_boot_ms" in fields else now_ns
        state = fold(self._state, name, fields, stamp_ns)
        changed, self._state = state is not self._state, state
        for watcher in list(self._watchers.values()):
            watcher(name, fields)
        if changed:
            for callback in list(self._subscribers.values()):
                try:
                    callback(state)
                except Exception:  # a subscriber's fault must not stop the vehicle's state
                    logger.exception("%s: a subscriber of the state failed", self.url)

    def _watch_clock(self, boot_ms: int, now_ns: int) -> None:
        """The autopilot's clock goes back: it has restarted, or another one speaks with its id by turns."""
        if boot_ms < self._boot_ms - _BOOT_TOLERANCE_MS:
            self._setbacks_ns.append(now_ns)
            first_ns = self._setbacks_ns[0]
            if len(self._setbacks_ns) == _SETBACKS_OF_TWO and now_ns - first_ns < _TWO_CLOCKS_S * 1e9:
                if not self._two_autopilots(now_ns):
                    logger.error(
                        "%s: two autopilots send as system %s from one address: give each an id of its own",
                        self.url,
                        self._system_id,
                    )
                self._two_heard_ns = now_ns
                self._restarted.clear()
            else:
                self._restarted.set()
                # What held before the restart is not known to hold now, home least of all.
                self._clock.forget()
                self._state = replace(
                    self._state,
                    ready_to_arm=False,
                    home_altitude_amsl_m=None,
                    home_position_ned_m=None,
                    clock=None,
                )
        self._boot_ms = boot_ms

    def _two_autopilots(self, now_ns: int) -> bool:
        """Two of the same id were heard a moment ago: their states cannot be told apart."""
        return self._two_heard_ns > 0 and now_ns - self._two_heard_ns < HEARTBEAT_MAX_AGE_S * 1e9

    @property
    def state(self) -> VehicleState:
        """See Driver."""
        return self._state

    def subscribe(self, callback: Callable[[VehicleState], None]) -> Callable[[], None]:
        """See Driver."""
        key = object()
        self._subscribers[key] = callback
        return lambda: self._subscribers.pop(key, None) and None

    @contextlib.asynccontextmanager
    async def _watching(self, watcher: Callable[[str, Fields], None]) -> AsyncIterator[None]:
        key = object()
        self._watchers[key] = watcher
        try:
            yield
        finally:
            del self._watchers[key]

    async def _until(self, met: Callable[[], bool], timeout_s: float | None) -> bool:
        """Wait until a message makes the condition true; False when it did not in time."""
        done = asyncio.get_running_loop().create_future()

        def check(_name: str, _fields: Fields) -> None:
            if not done.done() and met():
                done.set_result(None)

        async with self._watching(check):
            check("", {})
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(timeout_s):
                    await done
        return met()

    # --- sending ------------------------------------------------------------------------------------

    def _transmit(self, frame: bytes) -> None:
        if self._link is not None:
            self._link.send(frame)

    def _next_sequence(self) -> int:
        sequence, self._sequence = self._sequence, (self._sequence + 1) & 0xFF
        return sequence

    def _transmit_payload(self, message_id: int, payload: bytes) -> None:
        self._transmit(
            pack_frame(
                message_id,
                payload,
                system_id=self._own_system_id,
                component_id=self._own_component_id,
                sequence=self._next_sequence(),
            )
        )

    def send_heartbeat(self, status: SystemStatus) -> None:
        """See Driver."""
        payload = _HEARTBEAT.pack(0, _ONBOARD_CONTROLLER, _AUTOPILOT_INVALID, 0, int(status), 3)
        self._transmit_payload(HEARTBEAT_ID, payload)

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """See Driver."""
        if self._link is None or self._system_id is None:
            return
        zero = (0.0, 0.0, 0.0)  # the type mask says what counts
        kinematics = (*(setpoint.position_ned_m or zero), *(setpoint.velocity_ned_mps or zero), *zero)
        self._send_message(
            "SET_POSITION_TARGET_LOCAL_NED",
            {
                "time_boot_ms": (time.monotonic_ns() - self._started_ns) // 1_000_000 & 0xFFFF_FFFF,
                "target_system": self._system_id,
                "target_component": AUTOPILOT_COMPONENT,
                "coordinate_frame": _FRAME_LOCAL_NED,
                "type_mask": setpoint.type_mask,
                **dict(zip(("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz"), kinematics, strict=True)),
                "yaw": setpoint.yaw_rad or 0.0,
                "yaw_rate": setpoint.yaw_rate_radps or 0.0,
            },
        )

    def send_landing_target(self, target: LandingTarget) -> None:
        """See Driver."""
        if self._link is not None and self._system_id is not None:
            self._send_message("LANDING_TARGET", landing_target_fields(target, self._autopilot_kind or 0))

    # --- commands -----------------------------------------------------------------------------------

    async def _command(self, command: int, *parameters: float, fill: float = 0.0) -> int:
        """One command at a time of each kind, as the command protocol wants it. Its MAV_RESULT."""
        if self._link is None:
            raise CommandRefusedError(f"{self.url}: not connected, so command {command} cannot be sent")
        lock = self._command_locks.setdefault(command, asyncio.Lock())
        async with lock:
            return await self._exchange_command(command, (*parameters, *[fill] * (7 - len(parameters))))

    async def arm(self) -> None:
        """See Driver."""
        await self._arm_or_disarm(True)

    async def disarm(self) -> None:
        """See Driver."""
        await self._arm_or_disarm(False)

    async def _arm_or_disarm(self, armed: bool) -> None:
        word = "arm" if armed else "disarm"
        if armed and self._two_autopilots(time.monotonic_ns()):
            raise CommandRefusedError(
                f"{self.url}: two autopilots answer as system {self._system_id}, so neither is armed; "
                "give each an id of its own (MAV_SYS_ID)"
            )
        result = await self._command(_COMPONENT_ARM_DISARM, 1.0 if armed else 0.0)
        if result != ACCEPTED:
            if not armed:
                reason = f"it is {self._state.landed.replace('_', ' ')}"
            elif self._state.ready_to_arm:
                reason = f"in mode {self._state.mode}"
            else:
                reason = f"its pre-arm checks fail in mode {self._state.mode}"
            raise CommandRefusedError(f"the vehicle refused to {word} ({_named(result)}): {reason}")
        if not await self._until(lambda: self._state.armed is armed, _SHOWN_TIMEOUT_S):
            raise CommandRefusedError(
                f"the vehicle accepted to {word} but does not show it after {_SHOWN_TIMEOUT_S:g} s"
            )

    async def set_mode(self, mode: FlightMode, *, timeout_s: float = 3.0) -> None:
        """See Driver."""
        main, sub = request_of_mode(mode)
        refusals: list[int] = []

        def watch(name: str, fields: Fields) -> None:
            # PX4 >= 1.16: the first acknowledgement always accepts, the second is the Commander's.
            if name != "COMMAND_ACK" or fields["command"] != _DO_SET_MODE or not self._ack_is_ours(fields):
                return
            if fields["result"] not in (ACCEPTED, IN_PROGRESS):
                refusals.append(fields["result"])

        asked_ns = time.monotonic_ns()
        deadline = time.monotonic() + timeout_s

        def shown() -> bool:
            return self._mode_ns > asked_ns and self._state.mode is mode

        async with self._watching(watch):
            result = await self._command(_DO_SET_MODE, _MODE_FLAG_CUSTOM, main, sub)
            if result != ACCEPTED:
                refusals.append(result)
            await self._until(lambda: bool(refusals) or shown(), max(deadline - time.monotonic(), 0.0))
        if refusals:
            hint = " (is a setpoint stream running?)" if mode is FlightMode.OFFBOARD else ""
            raise CommandRefusedError(
                f"the vehicle refused mode {mode} ({_named(refusals[0])}){hint}: it shows {self._state.mode}"
            )
        if not shown():
            raise CommandRefusedError(
                f"the vehicle did not enter mode {mode} within {timeout_s:g} s: it shows {self._state.mode}"
            )

    async def takeoff(self, altitude_m: float) -> None:
        """See Driver."""
        if not (math.isfinite(altitude_m) and altitude_m > 0.0):
            raise CommandRefusedError(f"a take-off altitude must be above 0 m, got {altitude_m}")
        if not await self._until(lambda: self._state.home_altitude_amsl_m is not None, _SHOWN_TIMEOUT_S):
            raise CommandRefusedError(
                "take-off needs home's altitude, and the vehicle has not told it (no position yet?)"
            )
        target_amsl_m = (self._state.home_altitude_amsl_m or 0.0) + altitude_m
        nan = math.nan  # PX4: here, with this heading
        result = await self._command(_NAV_TAKEOFF, nan, nan, nan, nan, nan, nan, target_amsl_m)
        if result != ACCEPTED:
            raise CommandRefusedError(
                f"the vehicle refused to take off ({_named(result)}) in mode {self._state.mode}"
            )

    def _ack_is_ours(self, fields: Fields) -> bool:
        """MAVLink 1 and broadcasting autopilots leave the target 0."""
        target = (fields.get("target_system", 0), fields.get("target_component", 0))
        return target[0] in (0, self._own_system_id) and target[1] in (0, self._own_component_id)

    # --- keeping the link ---------------------------------------------------------------------------

    async def _keep(self) -> None:
        """Ask for the streams we need, and say when the autopilot goes silent and when it comes back."""
        while True:
            await self._ask_for_streams()
            if not await self._silence():
                logger.warning("%s: system %s has restarted", self.url, self._system_id)
                continue
            logger.error(
                "%s: system %s is silent: no heartbeat for %g s",
                self.url,
                self._system_id,
                HEARTBEAT_MAX_AGE_S,
            )
            await self._until(lambda: self._state.connected(time.monotonic_ns()), None)
            logger.warning("%s: system %s is back", self.url, self._system_id)

    async def _synchronise(self) -> None:
        """Ask the autopilot for its time, for ever."""
        while True:
            self._asked_ns = time.monotonic_ns()
            question = _TIMESYNC.pack(0, self._asked_ns, self._system_id or 0, AUTOPILOT_COMPONENT)
            self._transmit_payload(_TIMESYNC_ID, question)
            await asyncio.sleep(_TIMESYNC_PERIOD_S)

    async def _silence(self) -> bool:
        """Wait until the newest heartbeat is too old (True) or the autopilot's clock began anew (False)."""
        while self._state.connected(time.monotonic_ns()):
            left_s = (self._state.heartbeat_ns - time.monotonic_ns()) / 1e9 + HEARTBEAT_MAX_AGE_S
            if await _happens(self._restarted, max(left_s, 0.0) + 1e-3):
                return False
        return True

    async def _ask_for_streams(self) -> None:
        """SET_MESSAGE_INTERVAL for what comes too slowly, and home's position if it has not come."""
        self._restarted.clear()
        self._received_count.clear()
        began = time.monotonic()
        await asyncio.sleep(_MEASURE_S)
        elapsed_s = time.monotonic() - began
        requests: list[tuple[int, tuple[Any, ...]]] = [
            (_SET_MESSAGE_INTERVAL, (message_id, round(1e6 / rate_hz)))
            for message_id, rate_hz in WANTED_RATES_HZ.items()
            if self._received_count[message_id] / elapsed_s < _RATE_TOLERANCE * rate_hz
        ]
        if self._state.home_altitude_amsl_m is None:
            requests.append((_REQUEST_MESSAGE, (_HOME_POSITION_ID,)))
        for command, parameters in requests:
            try:
                result = await self._command(command, *parameters)
            except CommandRefusedError as error:
                logger.warning("%s: asking for message %d: %s", self.url, parameters[0], error)
                return  # the link is down; it is asked again when it is back
            if result != ACCEPTED:
                what = "at the rate wanted" if command == _SET_MESSAGE_INTERVAL else "now"
                logger.info(
                    "%s: the autopilot does not send message %d %s (%s)",
                    self.url,
                    parameters[0],
                    what,
                    _named(result),
                )


async def _happens(event: asyncio.Event, timeout_s: float) -> bool:
    # Not asyncio.wait_for: until Python 3.12 it loses a cancellation that comes together with the event.
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(timeout_s):
            await event.wait()
    return event.is_set()


def _named(result: int) -> str:
    return RESULT_NAMES.get(result, f"MAV_RESULT {result}")
