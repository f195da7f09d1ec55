"""The driver on pymavlink's message definitions and our own asyncio link."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import struct
from collections.abc import Callable, Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.autopilot_driver import (
    AUTOPILOT_COMPONENT,
    EXTENDED_SYS_STATE_ID,
    HEARTBEAT_ID,
    AutopilotDriver,
)
from companion.vehicle.driver import CommandRefusedError, OnBytes
from companion.vehicle.framing import EKF_STATUS_REPORT_ID, Frame
from companion.vehicle.link_url import LinkUrl
from companion.vehicle.mav_result import IN_PROGRESS
from companion.vehicle.signing import FrameSigner
from companion.vehicle.telemetry import TELEMETRY_MESSAGES, Fields
from companion.vehicle.vehicle_type import ARDUPILOT, PX4

logger = logging.getLogger(__name__)

_PARAM_VALUE_ID, _PARAM_SET_ID = 22, 23
_GIMBAL_ATTITUDE_ID = 285
# In wire order: the value's bytes unchanged, not converted through a float.
_PARAM_SET = struct.Struct("<4sBB16sB")
_EKF_STATUS_REPORT = struct.Struct("<5fH")  # five variances, flags; airspeed_variance is not read
_DECODED_IDS = {
    message_id
    for message_id, message in mavlink.mavlink_map.items()
    if message.msgname in TELEMETRY_MESSAGES | {"PARAM_VALUE", "PARAM_ERROR", "GPS_GLOBAL_ORIGIN"}
} - {HEARTBEAT_ID, EXTENDED_SYS_STATE_ID}

# Command protocol: 5 attempts half a second apart; after IN_PROGRESS it only waits.
_ATTEMPTS = 5
_ATTEMPT_S = 0.5
_PROGRESS_S = 10.0

# MAV_PARAM_TYPE and the layout of its four bytes (MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE)
_REAL32 = 9
_PARAM_LAYOUT = {1: "<B3x", 2: "<b3x", 3: "<H2x", 4: "<h2x", 5: "<I", 6: "<i", _REAL32: "<f"}
_PARAM_ERRORS = {
    1: "no such parameter",
    2: "value out of range",
    3: "permission denied",
    4: "no such component",
    5: "read-only",
    6: "type not supported",
    7: "wrong type",
    8: "read failed",
}


class PymavlinkDriver(AutopilotDriver):
    """See `companion.vehicle.driver.Driver`."""

    library = "pymavlink"
    supported_autopilots = frozenset({PX4, ARDUPILOT})

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
        super().__init__(
            url,
            system_id=system_id,
            own_system_id=own_system_id,
            own_component_id=own_component_id,
            other_component_ids=other_component_ids,
            signer=signer,
            range_finder_height=range_finder_height,
            on_bytes=on_bytes,
        )
        self._codec = mavlink.MAVLink(None, own_system_id, own_component_id)

    async def _attach(self, timeout_s: float) -> None:
        """No preparation needed."""

    async def _detach(self) -> None:
        """No resources to release."""

    # --- encoding -----------------------------------------------------------------------------------

    def _on_frames(self, frames: list[Frame]) -> None:
        for frame in frames:
            from_autopilot = frame.component_id == AUTOPILOT_COMPONENT
            if not from_autopilot and frame.message_id != _GIMBAL_ATTITUDE_ID:
                continue
            if frame.message_id == EKF_STATUS_REPORT_ID:
                *_, flags = _EKF_STATUS_REPORT.unpack(frame.padded(_EKF_STATUS_REPORT.size))
                self._telemetry.handle("EKF_STATUS_REPORT", {"flags": flags})
            elif frame.message_id in _DECODED_IDS:
                try:
                    message = self._codec.decode(bytearray(frame.raw))
                except mavlink.MAVError as error:
                    logger.warning("%s: message %d cannot be decoded: %s", self.url, frame.message_id, error)
                    continue
                fields = message.to_dict()
                if frame.message_id == _PARAM_VALUE_ID:
                    # An integer's bytes decoded as float may be a signalling NaN, which decoding changes.
                    fields["value_bytes"] = frame.padded(4)
                if from_autopilot:
                    self._telemetry.handle(message.get_type(), fields)
                else:
                    self._telemetry.handle_device(message.get_type(), fields, frame.component_id)

    def _send_message(self, name: str, fields: dict[str, Any]) -> None:
        definition = getattr(mavlink, f"MAVLink_{name.lower()}_message")
        self._codec.seq, self._codec.srcComponent = self._next_sequence(), self.own_address[1]
        self._transmit(bytes(definition(**fields).pack(self._codec)))

    # --- commands -----------------------------------------------------------------------------------

    async def _exchange_command(self, command: int, parameters: tuple[float, ...]) -> int:
        results: asyncio.Queue[int] = asyncio.Queue()

        def watch(name: str, fields: Fields) -> None:
            if name == "COMMAND_ACK" and fields["command"] == command and self._ack_is_ours(fields):
                results.put_nowait(fields["result"])

        async with self._telemetry.watching(watch):
            for attempt in range(_ATTEMPTS):
                if self._link is None:
                    raise CommandRefusedError(
                        f"{self.url}: the link was closed before an answer was received"
                    )
                self._send_command(command, parameters, attempt)
                result = await _next_result(results, _ATTEMPT_S)
                while result == IN_PROGRESS:
                    result = await _next_result(results, _PROGRESS_S)
                    if result is None:
                        raise CommandRefusedError(
                            f"command {command} in progress, but no further answer for {_PROGRESS_S:g} s"
                        )
                if result is not None:
                    return result
        raise self._no_answer(
            f"no answer to command {command} ({_ATTEMPTS} attempts, {_ATTEMPT_S:g} s apart)"
        )

    # --- parameters ---------------------------------------------------------------------------------

    async def get_parameter(self, name: str) -> float:
        """See Driver."""
        value, _ = await self._read_parameter(name)
        return value

    async def set_parameter(self, name: str, value: float) -> None:
        """See Driver."""
        self._check_flown(f"parameter {name}")
        _, kind = await self._read_parameter(name)
        wanted = _parameter_bytes(name, value, kind, bytewise=self._telemetry.profile.parameters_bytewise)
        payload = _PARAM_SET.pack(
            wanted, self._system_id or 0, AUTOPILOT_COMPONENT, _parameter_id(name), kind
        )
        echo = await self._exchange_parameter(
            name,
            lambda: self._transmit_payload(_PARAM_SET_ID, payload),
            lambda fields: bool(fields["value_bytes"] == wanted),
        )
        if echo is None:
            raise CommandRefusedError(f"parameter {name}: the vehicle did not accept {value}")

    async def _read_parameter(self, name: str) -> tuple[float, int]:
        """Return value and MAV_PARAM_TYPE."""
        request = {
            "target_system": self._system_id or 0,
            "target_component": AUTOPILOT_COMPONENT,
            "param_id": _parameter_id(name),
            "param_index": -1,
        }
        fields = await self._exchange_parameter(
            name, lambda: self._send_message("PARAM_REQUEST_READ", request), lambda _: True
        )
        if fields is None:
            raise self._no_answer(
                f"parameter {name}: no answer from the vehicle: no such parameter, or the link is down"
            )
        kind = fields["param_type"]
        if kind not in _PARAM_LAYOUT:
            raise CommandRefusedError(f"parameter {name}: MAV_PARAM_TYPE {kind} is not supported")
        layout = _PARAM_LAYOUT[kind if self._telemetry.profile.parameters_bytewise else _REAL32]
        return float(struct.unpack(layout, fields["value_bytes"])[0]), kind

    async def _exchange_parameter(
        self, name: str, send: Callable[[], None], awaited: Callable[[Fields], bool]
    ) -> Fields | None:
        """Send until the awaited PARAM_VALUE of that name is received; None if it is not."""
        if self._link is None:
            raise CommandRefusedError(f"{self.url}: not connected; parameter {name} is not available")
        answer: asyncio.Future[Fields] = asyncio.get_running_loop().create_future()

        def watch(message: str, fields: Fields) -> None:
            if answer.done() or fields.get("param_id") != name:
                return
            if message == "PARAM_VALUE" and awaited(fields):
                answer.set_result(fields)
            elif message == "PARAM_ERROR":
                reason = _PARAM_ERRORS.get(fields["error"], f"PARAM_ERROR {fields['error']}")
                answer.set_exception(CommandRefusedError(f"parameter {name}: {reason}"))

        async with self._telemetry.watching(watch):
            for _ in range(_ATTEMPTS):
                send()
                await asyncio.wait([answer], timeout=_ATTEMPT_S)
                if answer.done():
                    return answer.result()
        return None


async def _next_result(results: asyncio.Queue[int], timeout_s: float) -> int | None:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(timeout_s):
            return await results.get()
    return None


def _parameter_id(name: str) -> bytes:
    try:
        encoded = name.encode("ascii")
    except UnicodeEncodeError as error:
        raise CommandRefusedError(f"parameter name {name!r}: must be ASCII") from error
    if not 1 <= len(encoded) <= 16:
        raise CommandRefusedError(f"parameter name {name!r}: must have 1 to 16 characters")
    return encoded


def _parameter_bytes(name: str, value: float, kind: int, *, bytewise: bool) -> bytes:
    if kind != _REAL32 and not float(value).is_integer():
        raise CommandRefusedError(f"parameter {name} is an integer and cannot hold {value}")
    try:
        packed = struct.pack(_PARAM_LAYOUT[kind], value if kind == _REAL32 else int(value))
        return packed if bytewise else struct.pack("<f", value)
    except (struct.error, OverflowError) as error:
        raise CommandRefusedError(f"parameter {name} cannot hold {value}: {error}") from error
