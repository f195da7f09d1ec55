"""Bytes on a serial line as a receiver of another baud rate reads them: 8 bits, no parity, one stop bit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from companion.doctor.listening import Received, Sender
from companion.vehicle.framing import Framer
from companion.vehicle.link_url import LinkScheme, LinkUrl

_HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT


def telemetry(
    system_id: int = 1, mav_type: int = mavlink.MAV_TYPE_QUADROTOR, autopilot: int = mavlink.MAV_AUTOPILOT_PX4
) -> bytes:
    """One second of an autopilot's messages: a heartbeat among attitudes."""
    codec = mavlink.MAVLink(None, system_id, 1)
    attitudes = b"".join(
        mavlink.MAVLink_attitude_message(at * 20, 0.1 * at, -0.2, 0.3, 0.01, 0.02, 0.03).pack(codec)
        for at in range(50)
    )
    heartbeat = mavlink.MAVLink_heartbeat_message(mav_type, autopilot, 0, 0, 3, 3).pack(codec)
    return bytes(attitudes + heartbeat + attitudes)


def as_read_at(data: bytes, sent_baud: int, read_baud: int) -> bytes:
    """What a receiver makes of the line's levels; a byte without a stop bit is 0, as Linux delivers it."""
    if sent_baud == read_baud:
        return data
    levels = [1, 1]
    for byte in data:
        levels += [0, *(byte >> bit & 1 for bit in range(8)), 1]
    levels += [1] * 20
    ratio = sent_baud / read_baud  # bits sent in one bit read
    read, at = bytearray(), 0.0
    while (edge := _falling_edge(levels, at)) is not None:
        samples = [int(edge + (bit + 0.5) * ratio) for bit in range(10)]
        if samples[-1] >= len(levels):
            break
        bits = [levels[each] for each in samples]
        if bits[0] == 0:
            value = sum(bit << place for place, bit in enumerate(bits[1:9]))
            read.append(value if bits[9] else 0)
        at = edge + 9.5 * ratio
    return bytes(read)


def _falling_edge(levels: list[int], at: float) -> int | None:
    for each in range(max(math.ceil(at), 1), len(levels)):
        if levels[each] == 0 and levels[each - 1] == 1:
            return each
    return None


def received_of(data: bytes) -> Received:
    """What listening makes of a stream of bytes."""
    framer = Framer()
    senders = {}
    frames = framer.feed(data, datagram=False)
    for frame in frames:
        if frame.message_id == _HEARTBEAT:
            payload = frame.padded(9)
            senders[frame.system_id, frame.component_id] = Sender(payload[4], payload[5], 1, signed=False)
    return Received(1.0, senders, len(frames), framer.skipped_bytes)


class Wires:
    """Serial lines and ports for `find_autopilots`, in place of `listen`.

    Attributes:
        opened: the links that were opened, in order.
    """

    def __init__(
        self,
        lines: Mapping[Path, tuple[int, bytes]] | None = None,
        network: Mapping[str, Received] | None = None,
    ) -> None:
        self._lines, self._network = lines or {}, network or {}
        self.opened: list[LinkUrl] = []

    def listen(
        self, url: LinkUrl, seconds: float, enough: Callable[[Received], bool] | None = None
    ) -> Received:
        self.opened.append(url)
        if url.scheme is not LinkScheme.SERIAL:
            return self._network.get(str(url), Received(seconds))
        path, baud = url.address
        if Path(path) not in self._lines:
            return Received(seconds)
        sent_baud, data = self._lines[Path(path)]
        return received_of(as_read_at(data, sent_baud, baud))
