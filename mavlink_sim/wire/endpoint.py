"""UDP endpoints of a vehicle's links: bound as PX4's, sending to a fixed port until a peer answers.

The traffic goes through a `LinkStage`, where faults of a link act; without an impairment a call goes directly
to the socket. Delayed datagrams leave and arrive when the owner calls `pump`, at every simulated step.
"""

from __future__ import annotations

import errno
import logging
import socket
import time
from collections.abc import Callable, Iterable
from typing import Any

from mavlink_sim.wire.faulty_socket import Address, FaultySocket
from mavlink_sim.wire.messages import Outgoing, parser
from mavlink_sim.wire.signing import Signing

logger = logging.getLogger(__name__)

# A peer that was silent this long may be replaced by another one (PX4 itself keeps its first peer forever).
PEER_SILENCE_S = 5.0
# A socket buffer's worth of full-size datagrams; more in one go means a client that floods us.
MAX_DATAGRAMS_PER_READ = 200
# Whose split frames are put together; the one that has been silent longest is forgotten.
MAX_SENDERS = 16


class PortInUseError(OSError):
    """The port that an endpoint should bind is taken."""


class UdpEndpoint:
    """One bound UDP socket, non-blocking.

    Sends to `peer_port` from the start, as PX4 does, then to the first peer that sends, until that is silent.
    Each outgoing message is one datagram. `on_packet` is called with every packet, sent or received.

    Raises:
        PortInUseError: `bind_port` is taken; 0 chooses a free one.
        OSError: `host` is no address of this machine.
    """

    def __init__(self, host: str, bind_port: int, peer_port: int, system_id: int = 1) -> None:
        self.socket: socket.socket | FaultySocket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        try:
            self.socket.bind((host, bind_port))
        except OSError as error:
            self.socket.close()
            if error.errno == errno.EADDRINUSE:
                raise PortInUseError(
                    f"UDP port {host}:{bind_port} is already in use; stop its user or choose another port"
                ) from error
            raise OSError(f"cannot bind UDP {host}:{bind_port}: {error}") from error
        self.peer: tuple[str, int] = (host, peer_port)
        self._peer_seen_s: float | None = None
        self._codec = parser(system_id)
        self._readers: dict[Address, Any] = {}
        self.signing = Signing()
        self._refused = False
        self.on_packet: Callable[[bytes], None] | None = None

    @property
    def port(self) -> int:
        """The port it is bound to."""
        return int(self.socket.getsockname()[1])

    def fileno(self) -> int:
        return self.socket.fileno()

    def receive(self) -> list[Any]:
        """Every message that has arrived; damaged bytes are skipped and counted by the codec."""
        return [message for message, _ in self.receive_from()]

    def receive_from(self) -> list[tuple[Any, Address]]:
        """As `receive`, each message with its sender."""
        messages: list[tuple[Any, Address]] = []
        for _ in range(MAX_DATAGRAMS_PER_READ):
            try:
                datagram, sender = self.socket.recvfrom(65535)
            except BlockingIOError:
                break
            except ConnectionRefusedError:
                continue  # an ICMP answer to an earlier datagram: no listener there now
            found = [
                message
                for message in self._reader_of(sender).parse_buffer(datagram) or []
                if message.get_type() != "BAD_DATA" and self.signing.accepts(message.get_msgbuf())
            ]
            if found:
                self._note_sender(sender)
                messages += [(message, sender) for message in found]
                if self.on_packet is not None:
                    for message in found:
                        self.on_packet(bytes(message.get_msgbuf()))
        return messages

    def _reader_of(self, sender: Address) -> Any:
        """The sender's own parser: a frame may be cut over its datagrams, between those of others."""
        reader = self._readers.pop(sender, None)
        if reader is None:
            if len(self._readers) >= MAX_SENDERS:
                del self._readers[next(each for each in self._readers if each != self.peer)]
            reader = parser()
        self._readers[sender] = reader  # the newest last
        return reader

    def _note_sender(self, sender: tuple[str, int]) -> None:
        now = time.monotonic()
        if self._peer_seen_s is None or sender == self.peer or now - self._peer_seen_s > PEER_SILENCE_S:
            if sender != self.peer:
                logger.info("the link on port %d talks to %s:%d", self.port, *sender)
            self.peer = sender
            self._peer_seen_s = now

    def send(self, outgoing: Iterable[Outgoing]) -> None:
        """Send each message; what the network does not accept now is dropped, as by a radio."""
        for item in outgoing:
            packet = item.pack(self._codec)
            if self.signing.has_key and not item.forwarded:
                packet = self.signing.signed(packet)
            if self.on_packet is not None:
                self.on_packet(packet)
            try:
                self.socket.sendto(packet, self.peer)
            except (BlockingIOError, ConnectionRefusedError):
                continue
            except OSError as error:
                if not self._refused:
                    logger.warning("cannot send to %s:%d: %s", *self.peer, error)
                    self._refused = True

    def close(self) -> None:
        self.socket.close()
