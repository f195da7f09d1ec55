"""A MAVLink router with the rules of mavlink-router, between one autopilot and several programs."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.framing import Frame, frames_of

Address = tuple[int, int]
_DECODER = mavlink.MAVLink(None)


class _Endpoint:
    """One peer. `addresses`: with which it has sent."""

    def __init__(self, peer: tuple[str, int] | None, port: int = 0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.setblocking(False)
        self.peer = peer
        self.addresses: set[Address] = set()

    def accepts(self, sender: Address, target: Address) -> bool:
        """Whether the router delivers a message to it."""
        if sender in self.addresses:
            return False  # "this endpoint sent the message": never delivered
        system, component = target
        if system == 0:
            return True
        return any(one[0] == system and component in (0, one[1]) for one in self.addresses)


class MavlinkRouter:
    """The autopilot sends to `autopilot_port`; each program listens on one of `program_ports`."""

    def __init__(self, autopilot_port: int, program_ports: Sequence[int]) -> None:
        self._endpoints = [
            _Endpoint(None, autopilot_port),
            *(_Endpoint(("127.0.0.1", port)) for port in program_ports),
        ]
        loop = asyncio.get_running_loop()
        for endpoint in self._endpoints:
            loop.add_reader(endpoint.socket.fileno(), self._readable, endpoint)

    def port(self, program: int) -> int:
        """The router's own port towards a program, for one that does not listen."""
        port: int = self._endpoints[program + 1].socket.getsockname()[1]
        return port

    def close(self) -> None:
        for endpoint in self._endpoints:
            asyncio.get_running_loop().remove_reader(endpoint.socket.fileno())
            endpoint.socket.close()

    def _readable(self, origin: _Endpoint) -> None:
        try:
            data, source = origin.socket.recvfrom(65535)
        except (BlockingIOError, ConnectionRefusedError):  # the program is not up yet
            return
        origin.peer = source
        for frame in frames_of(data):
            sender, target = (frame.system_id, frame.component_id), _target(frame)
            origin.addresses.add(sender)
            for endpoint in self._endpoints:
                if endpoint is not origin and endpoint.peer and endpoint.accepts(sender, target):
                    endpoint.socket.sendto(frame.raw, endpoint.peer)


def _target(frame: Frame) -> Address:
    if frame.message_id == mavlink.MAVLINK_MSG_ID_TIMESYNC:  # its extension fields
        system, component = frame.padded(18)[16:]
        return (system, component)
    message = _DECODER.decode(bytearray(frame.raw))
    return (getattr(message, "target_system", 0), getattr(message, "target_component", 0))


@asynccontextmanager
async def mavlink_router(autopilot_port: int, program_ports: Sequence[int]) -> AsyncIterator[MavlinkRouter]:
    router = MavlinkRouter(autopilot_port, program_ports)
    try:
        yield router
    finally:
        router.close()
