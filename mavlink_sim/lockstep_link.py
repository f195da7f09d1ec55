"""A link of a vehicle in lockstep, as bytes: as for a client on a socket, with faults.

>>> from mavlink_sim.vehicles.vehicle import Vehicle
>>> vehicle = Vehicle()
>>> _ = vehicle.add_link("onboard")
>>> link = LockstepLink(vehicle, "onboard")
>>> _ = vehicle.faults.begin("link_delay 0.5 way=out")
>>> vehicle.step(0.4), len(link.receive()) > 0
(None, False)
>>> vehicle.step(0.2), len(link.receive()) > 0
(None, True)
"""

from __future__ import annotations

from typing import Any

from mavlink_sim.faults.context import FaultTarget
from mavlink_sim.wire.messages import parser


class LockstepLink:
    """The client's end of one link. Call `receive` after every step: it also advances the link's time."""

    def __init__(self, vehicle: FaultTarget, name: str) -> None:
        self._vehicle = vehicle
        self._name = name
        self._stage = vehicle.faults.stage(name)
        self._codec = parser(vehicle.system_id)
        self._sequences: dict[tuple[int, int], int] = {}

    def send(self, message: Any, source: tuple[int, int] = (1, 191)) -> None:
        """Send a message from a (system, component), with that component's sequence number."""
        codec = parser(*source)
        codec.seq = self._sequences.get(source, 0)
        self._sequences[source] = (codec.seq + 1) % 256
        self.send_bytes(bytes(message.pack(codec)))

    def send_bytes(self, datagram: bytes) -> None:
        """Send one datagram."""
        self._stage.inbound.push(self._vehicle.faults.now_s, datagram)
        self._deliver()

    def receive(self) -> list[bytes]:
        """The datagrams received since the last call; due datagrams to the vehicle are delivered too."""
        self._deliver()
        now_s = self._vehicle.faults.now_s
        for item in self._vehicle.outgoing(self._name):
            self._stage.outbound.push(now_s, item.pack(self._codec))
        return [datagram for datagram, _ in self._stage.outbound.due(now_s)]

    def _deliver(self) -> None:
        for datagram, _ in self._stage.inbound.due(self._vehicle.faults.now_s):
            for message in self._codec.parse_buffer(datagram) or []:
                if message.get_type() != "BAD_DATA":
                    self._vehicle.handle(self._name, message)
