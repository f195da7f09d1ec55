"""The wire of a vehicle in lockstep: its links as datagrams, through signing and whatever faults are on them.

Messages go between a `LockstepVehicle` and its client as objects, which is fast and all that a sound link
needs. While a fault is on a link, or it has a signing key, they are packed, signed, delayed, damaged or
refused here as the datagrams of a real one are.
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
        """A fault is on the link, or something is still under way in it."""
        return self._stage.inbound.engaged or self._stage.outbound.engaged

    @property
    def matters(self) -> bool:
        """Messages have to become datagrams: the link is engaged or signs."""
        return self.engaged or self._link.signing.has_key

    def outbound(self, outgoing: Iterable[Outgoing]) -> list[Outgoing]:
        """What arrives at the client by now, after these were sent; damaged bytes come as BAD_DATA."""
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
        """The same messages as bytes that are numbered already."""
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
        """A client sends a message, unsigned. Returns how many the vehicle was handed."""
        sender = self._senders.get(source)
        if sender is None:
            sender = self._senders[source] = parser(*source)
        frame = bytes(message.pack(sender))
        sender.seq = (sender.seq + 1) % 256
        return self.send_bytes(frame)

    def send_bytes(self, datagram: bytes) -> int:
        """A client sends a datagram. Returns how many messages the vehicle was handed."""
        if not self._stage.inbound.engaged:
            return self._read(datagram)
        self._stage.inbound.push(self._vehicle.faults.now_s, datagram)
        return self.deliver()

    def deliver(self) -> int:
        """Hand the vehicle what has arrived by now. Returns how many messages."""
        arrived = self._stage.inbound.due(self._vehicle.faults.now_s)
        return sum(self._read(datagram) for datagram, _ in arrived)

    def _read(self, datagram: bytes) -> int:
        count = 0
        for message in self._vehicle_reader.parse_buffer(datagram) or []:
            if message.get_type() != "BAD_DATA" and self._link.signing.accepts(bytes(message.get_msgbuf())):
                self._vehicle.handle(self._link.name, message)
                count += 1
        return count
