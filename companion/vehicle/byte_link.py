"""Byte transport of the link: UDP, TCP or a serial line, in the asyncio loop, without threads.

A TCP peer or a serial device that is lost is reopened until `close`. What cannot be sent at once is dropped,
never queued: an old setpoint must not arrive late.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import logging
import os
import socket
import termios
import tty
from collections.abc import Callable
from typing import Any, Protocol

from companion.host.clock import boottime_ns
from companion.host.tasks import keep_running, spawn
from companion.vehicle.driver import LinkError, LinkUnavailableError
from companion.vehicle.link_url import LinkScheme, LinkUrl

logger = logging.getLogger(__name__)

# The address a datagram came from; None on a stream.
Source = Any
Received = Callable[[bytes, Source], None]

_READ_BYTES = 65535
_MAX_READS_PER_CALLBACK = 64  # then other work of the loop runs
_MAX_DISCARDED = 10_000  # more than a socket's buffer holds
_REOPEN_S = 0.5
# The unsent rest of a frame is dropped after this time.
_PARTIAL_FRAME_S = 0.3


class ByteLink(Protocol):
    """An open link. Received data goes to `received(data, source)`, which may be replaced."""

    datagrams: bool
    received: Received
    dropped_count: int

    def send(self, data: bytes) -> None:
        """Send now or drop. Never raises and never waits."""

    def answer_to(self, source: Source) -> None:
        """Set the peer to send to. Has an effect only on a listening UDP link."""

    def discard_received(self) -> None:
        """Read and drop what waits in the system's buffer. Never raises."""

    async def close(self) -> None:
        """Release everything. Never raises; can be called twice."""


async def open_link(url: LinkUrl, received: Received) -> ByteLink:
    """Open a link.

    Raises:
        LinkError: the endpoint cannot be opened; one line with the reason and what to do.
    """
    if url.scheme is LinkScheme.NONE:
        raise LinkError("there is no vehicle: vehicle.url is none")
    if url.scheme in (LinkScheme.UDP_IN, LinkScheme.UDP_OUT):
        return await _open_udp(url, received)
    link = _StreamLink(url, received)
    await link.open()
    return link


async def _resolve(url: LinkUrl, kind: socket.SocketKind) -> tuple[int, Any]:
    try:
        found = await asyncio.get_running_loop().getaddrinfo(*url.address, type=kind)
    except OSError as error:
        raise LinkUnavailableError(
            f"{url}: the host cannot be resolved: {error.strerror or error}"
        ) from error
    # Autopilots and simulators listen on IPv4; "localhost" may name both.
    family, _, _, _, address = min(found, key=lambda entry: entry[0] != socket.AF_INET)
    return family, address


async def _open_udp(url: LinkUrl, received: Received) -> _UdpLink:
    family, address = await _resolve(url, socket.SOCK_DGRAM)
    endpoint = socket.socket(family, socket.SOCK_DGRAM)
    try:
        endpoint.setblocking(False)
        if url.scheme is LinkScheme.UDP_IN:
            endpoint.bind(address)
            return _UdpLink(url, endpoint, received, peer=None)
        return _UdpLink(url, endpoint, received, peer=address)
    except OSError as error:
        endpoint.close()
        raise LinkUnavailableError(_bind_error_text(url, error)) from error


def _reason(error: OSError) -> str:
    """Return the system's error text; asyncio replaces it with another."""
    return os.strerror(error.errno) if error.errno is not None and error.errno > 0 else str(error)


def _bind_error_text(url: LinkUrl, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return (
            f"{url}: UDP port {url.address[1]} is in use: another program (a MAVLink router, QGroundControl, "
            "another companion) listens there; stop it or choose another port"
        )
    if error.errno == errno.EADDRNOTAVAIL:
        return f"{url}: no interface of this computer has the address {url.address[0]}; use 0.0.0.0 for all"
    return f"{url}: the port cannot be opened: {_reason(error)}"


class _UdpLink:
    datagrams = True

    def __init__(self, url: LinkUrl, endpoint: socket.socket, received: Received, peer: Source) -> None:
        self._url = url
        self._socket = endpoint
        self.received = received
        self._peer = peer
        self._peer_is_fixed = peer is not None
        self._send_failing = False
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(endpoint.fileno(), self._readable)
        self.dropped_count = 0

    def _readable(self) -> None:
        for _ in range(_MAX_READS_PER_CALLBACK):
            if self._socket.fileno() < 0:  # closed by the callback
                return
            try:
                data, source = self._socket.recvfrom(_READ_BYTES)
            except BlockingIOError:
                return
            except OSError as error:  # ICMP port unreachable: nothing listens at the peer yet
                logger.debug("%s: %s", self._url, error)
                continue
            if not self._peer_is_fixed or source == self._peer:
                self.received(data, source)

    def send(self, data: bytes) -> None:
        if self._peer is None or self._socket.fileno() < 0:
            self.dropped_count += 1
            return
        try:
            self._socket.sendto(data, self._peer)
        except OSError as error:
            self.dropped_count += 1
            if not self._send_failing:
                logger.warning("%s: sending to %s failed: %s", self._url, self._peer, _reason(error))
            self._send_failing = True
        else:
            self._send_failing = False

    def discard_received(self) -> None:
        for _ in range(_MAX_DISCARDED):
            try:
                self._socket.recv(_READ_BYTES)
            except BlockingIOError:
                return
            except OSError as error:
                logger.debug("%s: %s", self._url, error)
                return

    def answer_to(self, source: Source) -> None:
        if not self._peer_is_fixed and source != self._peer:
            if self._peer is not None:
                logger.info("%s: the autopilot now sends from %s:%s", self._url, *source[:2])
            self._peer = source

    async def close(self) -> None:
        if self._socket.fileno() >= 0:
            self._loop.remove_reader(self._socket.fileno())
            self._socket.close()


class _StreamLink:
    """A TCP socket or a serial line, read and written when its descriptor is ready."""

    datagrams = False

    def __init__(self, url: LinkUrl, received: Received) -> None:
        self._url = url
        self.received = received
        self._loop = asyncio.get_running_loop()
        self._descriptor = -1
        self._unsent = b""  # the rest of a partially sent frame
        self._unsent_since_ns = 0
        self._reopening: asyncio.Task[None] | None = None
        self.dropped_count = 0

    async def open(self) -> None:
        opener = _open_serial if self._url.scheme is LinkScheme.SERIAL else _open_tcp
        self._descriptor = await opener(self._url)
        self._unsent = b""
        self._loop.add_reader(self._descriptor, self._readable)

    def _readable(self) -> None:
        try:
            data = os.read(self._descriptor, _READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            self._on_lost(_reason(error))
            return
        if data:
            self.received(data, None)
        else:
            self._on_lost("closed by the peer")

    def send(self, data: bytes) -> None:
        if self._descriptor < 0 or self._unsent:
            self.dropped_count += 1
            return
        self._write(data)

    def _write(self, data: bytes) -> None:
        try:
            written = os.write(self._descriptor, data)
        except BlockingIOError:
            written = 0
        except OSError as error:
            self.dropped_count += 1
            self._on_lost(_reason(error))
            return
        if written == 0 and not self._unsent:
            self.dropped_count += 1
            return
        was_waiting, self._unsent = bool(self._unsent), data[written:]
        if self._unsent and not was_waiting:
            self._unsent_since_ns = boottime_ns()
            self._loop.add_writer(self._descriptor, self._write_rest)
        elif was_waiting and not self._unsent:
            self._loop.remove_writer(self._descriptor)

    def _write_rest(self) -> None:
        waited_s = (boottime_ns() - self._unsent_since_ns) / 1e9
        if waited_s <= _PARTIAL_FRAME_S:
            self._write(self._unsent)
            return
        # The line, this process or the computer stood still. The frame may be a setpoint: not completed now.
        logger.warning("%s: partial frame dropped after %.1f s", self._url, waited_s)
        self.dropped_count += 1
        self._unsent = b""
        self._loop.remove_writer(self._descriptor)

    def discard_received(self) -> None:
        for _ in range(_MAX_DISCARDED):
            try:
                if self._descriptor < 0 or not os.read(self._descriptor, _READ_BYTES):
                    return
            except OSError as error:  # empty, or lost, which the next read reports
                logger.debug("%s: %s", self._url, error)
                return

    def answer_to(self, source: Source) -> None:
        """Does nothing: a stream has one peer."""

    def _on_lost(self, reason: str) -> None:
        logger.error("%s: link lost: %s; reopening", self._url, reason)
        self._release()
        name = f"reopening of {self._url}"
        self._reopening = spawn(keep_running(name, self._reopen), name)

    async def _reopen(self) -> None:
        while self._descriptor < 0:
            await asyncio.sleep(_REOPEN_S)
            try:
                await self.open()
            except LinkError as error:
                logger.debug("%s", error)
        logger.info("%s: link reopened", self._url)

    def _release(self) -> None:
        if self._descriptor >= 0:
            self._loop.remove_reader(self._descriptor)
            self._loop.remove_writer(self._descriptor)
            os.close(self._descriptor)
        self._descriptor, self._unsent = -1, b""

    async def close(self) -> None:
        if self._reopening is not None:
            self._reopening.cancel()
            await asyncio.gather(self._reopening, return_exceptions=True)
            self._reopening = None
        self._release()


async def _open_tcp(url: LinkUrl) -> int:
    family, address = await _resolve(url, socket.SOCK_STREAM)
    endpoint = socket.socket(family, socket.SOCK_STREAM)
    try:
        endpoint.setblocking(False)
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        await asyncio.get_running_loop().sock_connect(endpoint, address)
        return endpoint.detach()
    except OSError as error:
        reason = _reason(error)
        raise LinkUnavailableError(
            f"{url}: cannot connect: {reason}; check that a vehicle or a router listens there"
        ) from error
    finally:
        endpoint.close()  # does nothing to a detached descriptor


async def _open_serial(url: LinkUrl) -> int:
    device, baud = url.address
    speed = getattr(termios, f"B{baud}")
    descriptor = -1
    try:
        descriptor = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        # A second reader would take bytes. TIOCEXCL blocks later opens, `fcntl.flock` other users of it.
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        fcntl.ioctl(descriptor, termios.TIOCEXCL)
        tty.setraw(descriptor)
        settings = termios.tcgetattr(descriptor)
        settings[2] = (settings[2] | termios.CLOCAL | termios.CREAD) & ~termios.CRTSCTS
        settings[4] = settings[5] = speed
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
    except (OSError, termios.error) as error:
        if descriptor >= 0:
            with contextlib.suppress(OSError):
                os.close(descriptor)
        raise LinkUnavailableError(_serial_error_text(url, error)) from error
    return descriptor


def _serial_error_text(url: LinkUrl, error: Exception) -> str:
    device, _ = url.address
    number = error.args[0] if error.args else None
    if number == errno.ENOENT:
        return f"{url}: no device {device}; check that it is plugged in"
    if number == errno.EACCES:
        return (
            f"{url}: no permission to open {device}; add the user to the group that owns it (often dialout)"
        )
    if number in (errno.EBUSY, errno.EWOULDBLOCK):
        return f"{url}: another program has {device} open; stop it"
    if number == errno.ENOTTY:
        return f"{url}: {device} is not a serial device"
    return f"{url}: {device} cannot be opened: {error.args[1] if len(error.args) > 1 else error}"
