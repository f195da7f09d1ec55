"""A UDP socket whose traffic goes through a `LinkStage`, where faults of a link act."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable

from mavlink_sim.wire.link_faults import LinkStage

logger = logging.getLogger(__name__)


Address = tuple[str, int]
# The receive buffer of a kernel socket.
MAX_DATAGRAMS_PER_PUMP = 200
DATAGRAM_BYTES = 65535


class FaultySocket:
    """The part of a non-blocking UDP socket that an endpoint uses.

    Args:
        socket: the real one, bound.
        stage: what its datagrams go through.
        now_s: simulated seconds, the clock of the stage.
    """

    def __init__(
        self, socket: socket.socket | FaultySocket, stage: LinkStage, now_s: Callable[[], float]
    ) -> None:
        self.socket = socket
        self._stage = stage
        self._now_s = now_s
        self._arrived: list[tuple[bytes, Address]] = []

    def fileno(self) -> int:
        return self.socket.fileno()

    def getsockname(self) -> Address:
        host, port = self.socket.getsockname()
        return host, port

    def close(self) -> None:
        self.socket.close()

    @property
    def has_arrivals(self) -> bool:
        """Whether delayed datagrams are due to be read."""
        self._arrived += self._stage.inbound.due(self._now_s())
        return bool(self._arrived)

    def recvfrom(self, size: int) -> tuple[bytes, Address]:
        """The next datagram that has passed the stage. Raises BlockingIOError if there is none now."""
        inbound = self._stage.inbound
        if not inbound.engaged and not self._arrived:
            datagram, sender = self.socket.recvfrom(size)
            return datagram, sender
        if not self._arrived:
            self._take_in()
        if not self._arrived:
            raise BlockingIOError("nothing has come through the link")
        return self._arrived.pop(0)

    def _take_in(self) -> None:
        """Move received datagrams into the stage, and due datagrams out of it."""
        inbound, now_s = self._stage.inbound, self._now_s()
        for _ in range(MAX_DATAGRAMS_PER_PUMP):
            try:
                datagram, sender = self.socket.recvfrom(DATAGRAM_BYTES)
            except BlockingIOError:
                break
            except ConnectionRefusedError:
                continue  # an ICMP answer to an earlier datagram
            inbound.push(now_s, datagram, sender)
        self._arrived += inbound.due(now_s)

    def sendto(self, packet: bytes, address: Address) -> int:
        """Send, through the stage if it is engaged. Raises what a socket raises."""
        if not self._stage.outbound.engaged:
            return self.socket.sendto(packet, address)
        self._stage.outbound.push(self._now_s(), packet, address)
        return len(packet)

    def pump(self) -> None:
        """Send what is due; what the network does not accept now is lost."""
        outbound = self._stage.outbound
        if not outbound.waiting:
            return
        for packet, address in outbound.due(self._now_s()):
            try:
                self.socket.sendto(packet, address)
            except (BlockingIOError, ConnectionRefusedError):
                continue
            except OSError as error:
                logger.warning("cannot send to %s:%d: %s", *address, error)
