"""The driver on MAVSDK 4: its command and parameter protocols and message definitions, our link.

MAVSDK runs on its `raw://` connection: received bytes are passed to it, and the bytes it sends come back and
are sent from our asyncio loop. So its C++ threads send nothing to the vehicle by themselves: a program that
hangs is silent. Its own HEARTBEAT (once a second; MAVSDK 4.1 for Python cannot turn it off) is dropped, so
the only heartbeats on the wire are those of `send_heartbeat`. Its offboard plugin, which repeats the last
setpoint from such a thread, is not used: setpoints are sent one by one through `mavlink_direct`. Nor is its
events plugin: `report_reader` serves both drivers and autopilots, also STATUSTEXT, and reads which modes an
event affects, which that plugin does not give.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import mavsdk
from mavsdk.plugins.mavlink_direct import (
    MavlinkDirect,
    MavlinkDirectError,
    MavlinkDirectResult,
    MavlinkMessage,
)
from mavsdk.plugins.param import Param, ParamError, ParamResult

from companion.vehicle.autopilot_driver import AUTOPILOT_COMPONENT, HEARTBEAT_ID, AutopilotDriver
from companion.vehicle.driver import CommandRefusedError, LinkUnavailableError
from companion.vehicle.framing import Frame, frames_of, with_sequence
from companion.vehicle.gimbal_telemetry import ATTITUDE_STATUS
from companion.vehicle.setpoint import DEFAULT_LIFETIME_S
from companion.vehicle.telemetry import TELEMETRY_MESSAGES

logger = logging.getLogger(__name__)
_library_logger = logging.getLogger("mavsdk")

_T = TypeVar("_T")
# The base class applies modes, VTOL states and acknowledgements in their order of arrival.
_SUBSCRIBED = sorted(TELEMETRY_MESSAGES - {"HEARTBEAT", "CURRENT_MODE", "EXTENDED_SYS_STATE"})
# After a hang of the loop: neither a setpoint nor a repeated command may arrive late.
_STALE_NS = round(DEFAULT_LIFETIME_S * 1e9)
_PARAM_REASONS = {
    ParamResult.DOES_NOT_EXIST: "no such parameter",
    ParamResult.TIMEOUT: "no answer from the vehicle: no such parameter, or the link is down",
    ParamResult.PARAM_NAME_TOO_LONG: "the name has more than 16 characters",
    ParamResult.VALUE_OUT_OF_RANGE: "the value is out of range",
}


class MavsdkDriver(AutopilotDriver):
    """See `companion.vehicle.driver.Driver`."""

    library = "mavsdk"
    _mavsdk: mavsdk.Mavsdk | None = None
    _search: ctypes.c_void_p | None = None
    _direct: MavlinkDirect | None = None
    _parameters: Param | None = None

    async def _attach(self, timeout_s: float) -> None:
        _log_through_python()
        self._loop = asyncio.get_running_loop()
        self._awaited: set[asyncio.Future[Any]] = set()
        self._blocking = ThreadPoolExecutor(1, thread_name_prefix="mavsdk-driver")
        configuration = mavsdk.Configuration.create_manual(*self.own_address, False)
        self._mavsdk = mavsdk.Mavsdk(configuration)
        configuration.destroy()
        self._mavsdk.subscribe_raw_bytes_to_be_sent(self._library_sends)  # first: else it logs an error
        self._mavsdk.add_any_connection_with_handle("raw://")
        found: asyncio.Future[Any] = self._loop.create_future()
        self._search = self._mavsdk.first_autopilot_async(
            timeout_s, lambda system: self._hop(_resolve, found, system)
        )
        if self._newest_heartbeat is not None:
            self._on_frames([self._newest_heartbeat])  # the next one may take a second
        system = await found
        if system is None:
            raise LinkUnavailableError(
                f"{self.url}: MAVSDK did not find the autopilot within {timeout_s:g} s"
            )
        direct = MavlinkDirect(system)
        for name in _SUBSCRIBED:
            direct.subscribe_message(name, lambda message, _: self._hop(self._message, message))
        if not hasattr(direct, "_callbacks"):  # see `_destroy`
            logger.warning("%s: with this MAVSDK, closing during a command may crash", self.url)
        self._parameters = Param(system)
        self._direct = direct

    @property
    def _can_change_address(self) -> bool:
        return self._mavsdk is None  # it is fixed when the library starts

    async def _detach(self) -> None:
        library, self._mavsdk = self._mavsdk, None
        direct, self._direct, self._parameters = self._direct, None, None
        search, self._search = self._search, None
        if library is None:
            return
        for future in list(self._awaited):  # MAVSDK forgets them when it is destroyed
            if not future.done():
                future.set_exception(
                    CommandRefusedError(f"{self.url}: the link was closed before an answer was received")
                )
        # A parameter request in progress occupies the only thread; destroying waits for it.
        await self._loop.run_in_executor(self._blocking, _destroy, library, search, direct)
        self._blocking.shutdown(wait=False)

    # --- between MAVSDK's threads and our loop ------------------------------------------------------

    def _hop(self, call: Callable[..., None], *arguments: object) -> None:
        """Call a function in the loop, from any thread."""
        try:
            self._loop.call_soon_threadsafe(call, *arguments)
        except RuntimeError:  # the loop is closed
            logger.debug("%s: dropped a call of MAVSDK after the loop had closed", self.url)

    def _library_sends(self, data: bytes) -> None:
        self._hop(self._transmit_for_library, data, self.watch.now_ns())

    def _transmit_for_library(self, data: bytes, handed_over_ns: int) -> None:
        if self.watch.now_ns() - handed_over_ns > _STALE_NS:
            logger.warning("%s: the loop hung; dropped what MAVSDK sent meanwhile", self.url)
            return
        for frame in frames_of(data):
            # Renumbered, so that the vehicle does not count the dropped heartbeats as lost.
            if frame.message_id != HEARTBEAT_ID:
                own = frame.component_id == self.own_address[1]
                self._transmit(with_sequence(frame, self._next_sequence()) if own else frame.raw)

    def _on_frames(self, frames: list[Frame]) -> None:
        if self._mavsdk is not None:
            self._mavsdk.pass_received_raw_bytes(b"".join(frame.raw for frame in frames))

    def _message(self, message: MavlinkMessage) -> None:
        if self._mavsdk is None:
            return
        if message.component_id == AUTOPILOT_COMPONENT:
            self._telemetry.handle(message.message_name, json.loads(message.fields_json))
        elif message.message_name == ATTITUDE_STATUS:
            self._telemetry.handle_device(
                message.message_name, json.loads(message.fields_json), message.component_id
            )

    async def _in_thread(self, call: Callable[..., _T], *arguments: object) -> _T:
        return await self._loop.run_in_executor(self._blocking, call, *arguments)

    # --- encoding -----------------------------------------------------------------------------------

    def _send_message(self, name: str, fields: dict[str, Any]) -> None:
        if self._direct is None:
            return
        try:
            self._direct.send_message(self._direct_message(name, fields))
        except MavlinkDirectError as error:
            logger.error("%s: MAVSDK did not send %s: %s", self.url, name, error.result.name)

    def _direct_message(self, name: str, fields: dict[str, Any]) -> MavlinkMessage:
        return MavlinkMessage(
            message_name=name,
            system_id=self._own_system_id,
            component_id=self.own_address[1],
            target_system_id=self._system_id,
            target_component_id=AUTOPILOT_COMPONENT,
            fields_json=json.dumps(fields, allow_nan=False),
        )

    # --- commands and parameters --------------------------------------------------------------------

    async def _exchange_command(self, command: int, parameters: tuple[float, ...]) -> int:
        fields: dict[str, Any] = {
            "target_system": self._system_id,
            "target_component": AUTOPILOT_COMPONENT,
            "command": command,
            "confirmation": 0,
        }
        for number, value in enumerate(parameters, start=1):
            fields[f"param{number}"] = None if value != value else float(value)  # JSON has no NaN
        if self._direct is None:
            raise CommandRefusedError(f"{self.url}: not connected; command {command} was not sent")
        answered: asyncio.Future[tuple[MavlinkDirectResult, MavlinkMessage]] = self._loop.create_future()
        self._awaited.add(answered)
        answered.add_done_callback(self._awaited.discard)
        self._direct.send_command_async(
            self._direct_message("COMMAND_LONG", fields),
            lambda result, ack, _: self._hop(_resolve, answered, (result, ack)),
        )
        result, ack = await answered
        if result != MavlinkDirectResult.SUCCESS:
            raise self._no_answer(f"no answer to command {command} ({result.name.lower()})")
        return int(json.loads(ack.fields_json)["result"])

    async def get_parameter(self, name: str) -> float:
        """See Driver."""
        value = await self._read_parameter(name)
        return float(value)

    async def set_parameter(self, name: str, value: float) -> None:
        """See Driver."""
        self._check_flown(f"parameter {name}")
        before = await self._read_parameter(name)
        if isinstance(before, int):
            if not float(value).is_integer() or not -(2**31) <= value < 2**31:
                raise CommandRefusedError(f"parameter {name} is an integer and cannot hold {value}")
            await self._with_parameters(name, Param.set_param_int, name, int(value))
        else:
            await self._with_parameters(name, Param.set_param_float, name, float(value))

    async def _read_parameter(self, name: str) -> int | float:
        """Return an int for an integer parameter, a float for a real one."""
        try:
            return float(await self._with_parameters(name, Param.get_param_float, name))
        except _WrongTypeError:
            return int(await self._with_parameters(name, Param.get_param_int, name))

    async def _with_parameters(self, name: str, call: Callable[..., Any], *arguments: object) -> Any:
        if self._parameters is None:
            raise CommandRefusedError(f"{self.url}: not connected; parameter {name} is not available")
        try:
            return await self._in_thread(call, self._parameters, *arguments)
        except ParamError as error:
            if error.result in (ParamResult.WRONG_TYPE, ParamResult.TYPE_MISMATCH):
                raise _WrongTypeError(f"parameter {name}: wrong type") from error
            if error.result is ParamResult.TIMEOUT:
                raise self._no_answer(f"parameter {name}: {_PARAM_REASONS[error.result]}") from error
            reason = _PARAM_REASONS.get(error.result, error.result.name.lower())
            raise CommandRefusedError(f"parameter {name}: {reason}") from error


def _destroy(library: mavsdk.Mavsdk, search: ctypes.c_void_p | None, direct: MavlinkDirect | None) -> None:
    if search is not None:  # first: a system found from here on would outlive the library
        library.cancel_first_autopilot(search)
    # MAVSDK 4.1 frees the callbacks of subscriptions and pending commands before it stops the thread that
    # calls them: an answer at that moment crashes the process. So they are held until the thread has ended.
    # (A driver that is never closed is destroyed by MAVSDK at exit, without this.)
    callbacks = [*getattr(direct, "_callbacks", ()), *getattr(direct, "_subscriptions", {}).values()]
    library.destroy()
    callbacks.clear()


class _WrongTypeError(CommandRefusedError):
    """The parameter is an integer where a real was requested, or vice versa."""


def _resolve(future: asyncio.Future[Any], result: object) -> None:
    if not future.done():
        future.set_result(result)


def _log_through_python() -> None:
    """Redirect MAVSDK's log: by default it prints to standard output, which may carry JSON."""
    levels = {
        mavsdk.LogLevel.DEBUG: logging.DEBUG,
        mavsdk.LogLevel.INFO: logging.DEBUG,  # routine remarks
        mavsdk.LogLevel.WARN: logging.INFO,  # also for conditions that it handles
        mavsdk.LogLevel.ERROR: logging.WARNING,
    }

    def write(level: mavsdk.LogLevel, text: str, _file: str | None, _line: int) -> bool:
        _library_logger.log(levels[level], "%s", text)
        return True

    mavsdk.log_subscribe(write)
