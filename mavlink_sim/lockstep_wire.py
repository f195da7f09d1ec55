"""The wire of a vehicle in lockstep: its links as datagrams, with signing and faults.

Messages between a `LockstepVehicle` and its client are objects, which is fast and sufficient for a good link.
While a fault is on a link, or it has a signing key, they are packed, signed, delayed, corrupted or refused
here as the datagrams of a real one.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from mavlink_sim.faults.context import FaultTarget
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import Outgoing, parser


class LockstepWire:
    """One link's wire. `codec` numbers what the vehicle packs on it."""

    def __init__(self, vehicle: FaultTarget, link: Link) -> None:
        self._vehicle = vehicle
        self._link = link
        self._stage = vehicle.faults.stage(link.name)
        self.codec = parser(vehicle.system_id)
        self._reader = parser()
        self._vehicle_reader = parser(vehicle.system_id)
        self._senders: dict[tuple[int, int], Any] = {}

    @property
    def engaged(self) -> bool:
        """A fault is on the link, or datagrams are still in transit."""
        return self._stage.inbound.engaged or self._stage.outbound.engaged

    @property
    def matters(self) -> bool:
        """Messages have to become datagrams: the link is engaged or signs."""
        return self.engaged or self._link.signing.has_key

    def outbound(self, outgoing: Iterable[Outgoing]) -> list[Outgoing]:
        """Send messages; returns those that have arrived at the client by now, corrupted ones as BAD_DATA."""
        now_s, channel, signing = self._vehicle.faults.now_s, self._stage.outbound, self._link.signing
        for item in outgoing:
            frame = item.pack(self.codec)
            channel.push(now_s, frame if item.forwarded else signing.signed(frame))
        return [
            self._sealed(message)
            for datagram, _ in channel.due(now_s)
            for message in self._reader.parse_buffer(datagram) or []
        ]

    def sealed(self, outgoing: Iterable[Outgoing]) -> list[Outgoing]:
        """The same messages as packed bytes with sequence numbers."""
        found = []
        for item in outgoing:
            if item.forwarded:
                found.append(item)
            else:
                messages = self._reader.parse_buffer(item.pack(self.codec)) or []
                found += [self._sealed(message) for message in messages]
        return found

    @staticmethod
    def _sealed(message: Any) -> Outgoing:
        return Outgoing(message, message.get_srcSystem(), message.get_srcComponent(), True)

    def send(self, message: Any, source: tuple[int, int]) -> int:
        """Send a message of a client, unsigned. Returns the number of messages delivered to the vehicle."""
        sender = self._senders.get(source)
        if sender is None:
            sender = self._senders[source] = parser(*source)
        frame = bytes(message.pack(sender))
        sender.seq = (sender.seq + 1) % 256
        return self.send_bytes(frame)

    def send_bytes(self, datagram: bytes) -> int:
        """Send a datagram of a client. Returns the number of messages delivered to the vehicle."""
        if not self._stage.inbound.engaged:
            return self._read(datagram)
        self._stage.inbound.push(self._vehicle.faults.now_s, datagram)
        return self.deliver()

    def deliver(self) -> int:
        """Deliver what has arrived by now. Returns the number of messages."""
        arrived = self._stage.inbound.due(self._vehicle.faults.now_s)
        return sum(self._read(datagram) for datagram, _ in arrived)

    def _read(self, datagram: bytes) -> int:
        count = 0
        for message in self._vehicle_reader.parse_buffer(datagram) or []:
            if message.get_type() != "BAD_DATA" and self._link.signing.accepts(bytes(message.get_msgbuf())):
                self._vehicle.handle(self._link.name, message)
                count += 1
        return count
