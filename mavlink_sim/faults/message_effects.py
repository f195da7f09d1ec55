"""Effects on what a vehicle says and when: missing messages, another clock, a second autopilot, a stall."""

from __future__ import annotations

import copy
import struct
from functools import partial
from typing import Any

from mavlink_sim.faults.context import ActiveFault, FaultTarget
from mavlink_sim.faults.link_effects import chosen_links
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import Outgoing, parser
from mavlink_sim.wire.streams import ONBOARD_RATES_HZ

_U32, _U64 = 2**32, 2**64
_I64_MAX = 2**63 - 1
_EVENT_ID, _LINK_NODE_STATUS_ID = 410, 8
# time_usec of these is the boot time; elsewhere it is UTC or zero
_BOOT_TIME_USEC = {
    "ALTITUDE",
    "ESTIMATOR_STATUS",
    "GPS_GLOBAL_ORIGIN",
    "HIGHRES_IMU",
    "HOME_POSITION",
    "ODOMETRY",
    "VIBRATION",
}
# Where the second autopilot starts, east of the vehicle's start.
SECOND_START_EAST_M = 25.0


def heartbeat_only(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Stop the streams; answers to clients are still sent."""
    names = chosen_links(vehicle, one.fault.values["link"])

    def gate(link: Link, message: Any) -> Any:
        kind = message.get_type()
        if link.name not in names or kind == "HEARTBEAT" or kind not in link.streams:
            return message
        answer = (kind == "TIMESYNC" and message.tc1 != 0) or (kind == "PING" and message.target_system != 0)
        return message if answer else None

    _gated(vehicle, one, gate)


def lost_ack(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Drop COMMAND_ACK: every one, or the Nth from now on."""
    values = one.fault.values
    names = chosen_links(vehicle, values["link"])
    left = None if values["which"] == "all" else int(values["which"])

    def gate(link: Link, message: Any) -> Any:
        nonlocal left
        if message.get_type() != "COMMAND_ACK" or link.name not in names:
            return message
        if values["command"] not in (0, message.command):
            return message
        if left is None:
            return None
        left -= 1
        if left > 0:
            return message
        vehicle.after(0.0, partial(vehicle.faults.finish, one.number))
        return None if left == 0 else message

    _gated(vehicle, one, gate)


def _gated(vehicle: FaultTarget, one: ActiveFault, gate: Any) -> None:
    vehicle.faults.gates[one.number] = gate
    one.undo.append(partial(vehicle.faults.gates.pop, one.number))


def time_jump(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Shift the boot clock, in every stamp and in TIMESYNC, until the fault ends."""
    jump_us = round(one.fault.values["seconds"] * 1e6)
    vehicle.faults.boot_offset_us += jump_us

    def undo() -> None:
        vehicle.faults.boot_offset_us -= jump_us

    one.undo.append(undo)


def shifted(message: Any, boot_offset_us: int) -> Any:
    """The message with its boot times shifted, TIMESYNC's too."""
    kind = message.get_type()
    moved = copy.copy(message)
    if kind == "TIMESYNC":
        field = "ts1" if message.tc1 == 0 else "tc1"
        stamp = getattr(message, field) + boot_offset_us * 1000
        setattr(moved, field, max(min(stamp, _I64_MAX), -_I64_MAX))
    elif kind in _BOOT_TIME_USEC or (kind == "PING" and message.target_system == 0):
        moved.time_usec = (message.time_usec + boot_offset_us) % _U64
    elif hasattr(message, "time_boot_ms"):
        moved.time_boot_ms = (message.time_boot_ms + boot_offset_us // 1000) % _U32
    elif kind == "SERVO_OUTPUT_RAW":
        moved.time_usec = (message.time_usec + boot_offset_us) % _U32
    elif message.get_msgId() == _EVENT_ID:
        stamp = (message.event_time_boot_ms + boot_offset_us // 1000) % _U32
        moved.event_time_boot_ms = stamp
        moved._packed = message._packed[:4] + struct.pack("<I", stamp) + message._packed[8:]
    elif message.get_msgId() == _LINK_NODE_STATUS_ID:
        stamp = (message.timestamp + boot_offset_us // 1000) % _U64
        moved.timestamp = stamp
        moved._packed = struct.pack("<Q", stamp) + message._packed[8:]
    else:
        return message
    return moved


class _Spoken:
    """A message of the second autopilot with its packet, with that autopilot's sequence number."""

    def __init__(self, message: Any, packet: bytes, system: int) -> None:
        self._message = message
        self._packet = packet
        self._system = system

    def get_msgbuf(self) -> bytes:
        return self._packet

    def get_srcSystem(self) -> int:  # noqa: N802 - pymavlink's name
        return self._system

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._message, name)


def second_autopilot(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Attach the autopilot of another vehicle, disarmed on the ground, to every link of this one."""
    system = one.fault.values["system"] or vehicle.system_id
    other = vehicle.second_autopilot(system, one.seed, SECOND_START_EAST_M)
    codecs = {}
    for name, link in vehicle.links.items():
        other.add_link(name, {stream: link.streams.rate_hz(stream) for stream in ONBOARD_RATES_HZ})
        codecs[name] = parser(system)

    def speak(dt_s: float) -> None:
        other.step(dt_s)
        for name, codec in codecs.items():
            for item in other.outgoing(name):
                if not item.forwarded:  # what it would forward has been on these links already
                    spoken = _Spoken(item.message, item.pack(codec), system)
                    vehicle.links[name].outbox.append(Outgoing(spoken, system, item.component, True))

    vehicle.faults.second[one.number] = other
    one.each_step, one.apart = speak, True
    one.undo.append(partial(vehicle.faults.second.pop, one.number))


def stall(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Stop or slow down the vehicle's time; messages to it wait, and are all read afterwards."""
    vehicle.faults.pace = one.fault.values["pace"]

    def undo() -> None:
        others = [each for each in vehicle.faults.active if each.fault.kind.name == "stall"]
        vehicle.faults.pace = others[-1].fault.values["pace"] if others else 1.0
        if vehicle.faults.pace > 0.0:
            vehicle.faults.take_in_held()

    one.undo.append(undo)
