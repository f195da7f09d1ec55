"""MAVLink FTP (https://mavlink.io/en/services/ftp.html), as in PX4's server: one session per link.

`Server.answer` takes a FILE_TRANSFER_PROTOCOL payload and returns the reply's; `Server.burst` returns the due
packets of a burst read. The files are only read: what would change one is refused as protected.
"""

from __future__ import annotations

import errno
import logging
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, Protocol

from mavlink_sim.services.file_system import FileSystem
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import dialect

logger = logging.getLogger(__name__)

_HEADER = struct.Struct("<HBBBBBBI")
PAYLOAD_BYTES = 251
DATA_BYTES = PAYLOAD_BYTES - _HEADER.size  # 239
SESSION_TIMEOUT_S = 10.0
# The rate of a burst: packets per step (about 480 kB/s), and a pause, with burst_complete set, after 35 kB,
# as in PX4.
BURST_PACKETS = 8
BURST_BYTES = 35_000


class Opcode(IntEnum):
    NONE = 0
    TERMINATE_SESSION = 1
    RESET_SESSIONS = 2
    LIST_DIRECTORY = 3
    OPEN_FILE_RO = 4
    READ_FILE = 5
    CREATE_FILE = 6
    WRITE_FILE = 7
    REMOVE_FILE = 8
    CREATE_DIRECTORY = 9
    REMOVE_DIRECTORY = 10
    OPEN_FILE_WO = 11
    TRUNCATE_FILE = 12
    RENAME = 13
    CALC_FILE_CRC32 = 14
    BURST_READ_FILE = 15
    ACK = 128
    NAK = 129


class Failure(IntEnum):
    FAIL_ERRNO = 2
    INVALID_DATA_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS_AVAILABLE = 5
    END_OF_FILE = 6
    UNKNOWN_COMMAND = 7
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


WRITES = frozenset(
    {
        Opcode.CREATE_FILE,
        Opcode.WRITE_FILE,
        Opcode.REMOVE_FILE,
        Opcode.CREATE_DIRECTORY,
        Opcode.REMOVE_DIRECTORY,
        Opcode.OPEN_FILE_WO,
        Opcode.TRUNCATE_FILE,
        Opcode.RENAME,
    }
)


class RequestRefusedError(Exception):
    """A request that is answered by a NAK with this failure."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.name)
        self.failure = failure


@dataclass(frozen=True, slots=True)
class Packet:
    """The payload of FILE_TRANSFER_PROTOCOL. `size` is as received; `data` is at most 239 bytes."""

    sequence: int
    session: int
    opcode: int
    size: int
    requested: int
    burst_complete: bool
    offset: int
    data: bytes

    @classmethod
    def unpack(cls, payload: bytes) -> Packet:
        """Raises ValueError for a payload that is shorter than its header."""
        if len(payload) < _HEADER.size:
            raise ValueError(f"an FTP payload has at least {_HEADER.size} bytes, got {len(payload)}")
        sequence, session, opcode, size, requested, burst, _, offset = _HEADER.unpack_from(payload)
        data = payload[_HEADER.size : _HEADER.size + min(size, DATA_BYTES)]
        return cls(sequence, session, opcode, size, requested, bool(burst), offset, data)

    def pack(self) -> bytes:
        """251 bytes, padded with zeros."""
        header = _HEADER.pack(
            self.sequence & 0xFFFF,
            self.session,
            self.opcode,
            len(self.data),
            self.requested,
            self.burst_complete,
            0,
            self.offset,
        )
        return (header + self.data).ljust(PAYLOAD_BYTES, b"\0")

    @property
    def text(self) -> str:
        """The data up to the first NUL, as a path."""
        return self.data.split(b"\0", 1)[0].decode(errors="surrogateescape")


@dataclass(slots=True)
class _Burst:
    sequence: int
    offset: int
    sent_bytes: int
    target: tuple[int, int]


class Server:
    """The FTP server of one link. `now_s` must be monotonic."""

    def __init__(self, files: FileSystem) -> None:
        self._files = files
        self._content: bytes | None = None  # of the open file
        self._burst: _Burst | None = None
        self._received_s = 0.0
        self._last_reply: Packet | None = None

    @property
    def idle(self) -> bool:
        """No file is open: `burst` need not be called."""
        return self._content is None

    def answer(self, payload: bytes, source: tuple[int, int], now_s: float) -> bytes | None:
        """The reply to a request, None where a burst begins instead. Raises ValueError: no FTP payload."""
        request = Packet.unpack(payload)
        self._received_s = now_s
        if request.size <= DATA_BYTES and self._last_reply is not None:
            if (request.sequence + 1) & 0xFFFF == self._last_reply.sequence:
                return self._last_reply.pack()  # the answer was lost, the client repeats its request
            self._last_reply = None
        try:
            if request.size > DATA_BYTES:
                raise RequestRefusedError(Failure.INVALID_DATA_SIZE)
            if request.opcode == Opcode.BURST_READ_FILE:
                self._begin_burst(request, source)
                return None
            if request.opcode in WRITES:
                raise RequestRefusedError(Failure.FILE_PROTECTED)
            handler = _HANDLERS.get(request.opcode)
            if handler is None:
                raise RequestRefusedError(Failure.UNKNOWN_COMMAND)
            session, data = handler(self, request)
            reply = replace(request, opcode=Opcode.ACK, session=session, data=data)
        except RequestRefusedError as error:
            reply = _nak(request, bytes([error.failure]))
        except OSError as error:
            number = error.errno or errno.EIO
            missing = number == errno.ENOENT
            reason = [Failure.FILE_NOT_FOUND] if missing else [Failure.FAIL_ERRNO, number]
            reply = _nak(request, bytes(reason))
        reply = replace(reply, sequence=(request.sequence + 1) & 0xFFFF, requested=request.opcode)
        # Longer answers are data, which can be read again.
        busy = reply.opcode == Opcode.NAK and reply.data[0] == Failure.NO_SESSIONS_AVAILABLE
        if len(reply.data) <= 4 and not busy:
            self._last_reply = reply
        return reply.pack()

    def burst(self, now_s: float) -> list[tuple[tuple[int, int], bytes]]:
        """((system, component), payload) of the due burst packets; closes a session without requests."""
        if self._content is None:
            return []
        if now_s - self._received_s > SESSION_TIMEOUT_S:
            logger.info("the FTP session was closed after %g s without a request", SESSION_TIMEOUT_S)
            self._close()
            self._last_reply = None
            return []
        packets: list[tuple[tuple[int, int], bytes]] = []
        while self._burst is not None and len(packets) < BURST_PACKETS:
            last = len(packets) == BURST_PACKETS - 1
            packets.append((self._burst.target, self._next_of(self._content, self._burst, last)))
        return packets

    def _next_of(self, content: bytes, burst: _Burst, last_of_step: bool) -> bytes:
        packet = Packet(burst.sequence, 0, Opcode.ACK, 0, Opcode.BURST_READ_FILE, False, burst.offset, b"")
        burst.sequence = (burst.sequence + 1) & 0xFFFF
        if burst.offset >= len(content):
            self._burst = None
            return _nak(packet, bytes([Failure.END_OF_FILE])).pack()
        data = content[burst.offset : burst.offset + DATA_BYTES]
        burst.offset += len(data)
        burst.sent_bytes += len(data)
        complete = last_of_step and burst.sent_bytes > BURST_BYTES
        if complete:
            self._burst = None
        return replace(packet, data=data, burst_complete=complete).pack()

    # ---- one method per request; each returns the reply's session and data

    def _none(self, request: Packet) -> tuple[int, bytes]:
        return request.session, request.data

    def _terminate(self, request: Packet) -> tuple[int, bytes]:
        self._opened(request)
        self._close()
        return request.session, b""

    def _reset(self, request: Packet) -> tuple[int, bytes]:
        self._close()
        return request.session, b""

    def _list(self, request: Packet) -> tuple[int, bytes]:
        entries = [b"S", b"S"]  # "." and "..", which PX4 counts but does not list
        for name, size in self._files.list(request.text):
            encoded = name.encode(errors="surrogateescape")
            entries.append(b"D" + encoded if size is None else b"F%s\t%d" % (encoded, size))
        data = b""
        for entry in entries[request.offset :]:
            if len(data) + len(entry) + 1 > DATA_BYTES:
                break
            data += entry + b"\0"
        if not data:
            raise RequestRefusedError(Failure.END_OF_FILE)
        return request.session, data

    def _open(self, request: Packet) -> tuple[int, bytes]:
        if self._content is not None:
            raise RequestRefusedError(Failure.NO_SESSIONS_AVAILABLE)
        self._content = self._files.read(request.text)
        return 0, struct.pack("<I", len(self._content))

    def _opened(self, request: Packet) -> bytes:
        """The content of the open file."""
        if request.session != 0 or self._content is None:
            raise RequestRefusedError(Failure.INVALID_SESSION)
        return self._content

    def _read(self, request: Packet) -> tuple[int, bytes]:
        content = self._opened(request)
        if request.offset >= len(content):
            raise RequestRefusedError(Failure.END_OF_FILE)
        return 0, content[request.offset : request.offset + request.size]

    def _begin_burst(self, request: Packet, source: tuple[int, int]) -> None:
        self._opened(request)
        self._burst = _Burst((request.sequence + 1) & 0xFFFF, request.offset, 0, source)

    def _checksum(self, request: Packet) -> tuple[int, bytes]:
        return request.session, struct.pack("<I", checksum(self._files.read(request.text)))

    def _close(self) -> None:
        self._content = None
        self._burst = None


def checksum(content: bytes) -> int:
    """MAVLink FTP's CRC-32: the usual polynomial, without inversion before and after."""
    return zlib.crc32(content, 0xFFFFFFFF) ^ 0xFFFFFFFF


def _nak(packet: Packet, reason: bytes) -> Packet:
    return replace(packet, opcode=Opcode.NAK, data=reason)


_HANDLERS: dict[int, Callable[[Server, Packet], tuple[int, bytes]]] = {
    Opcode.NONE: Server._none,
    Opcode.TERMINATE_SESSION: Server._terminate,
    Opcode.RESET_SESSIONS: Server._reset,
    Opcode.LIST_DIRECTORY: Server._list,
    Opcode.OPEN_FILE_RO: Server._open,
    Opcode.READ_FILE: Server._read,
    Opcode.CALC_FILE_CRC32: Server._checksum,
}


class FileContext(Protocol):
    """What MAVLink FTP uses of a vehicle. `files`: the files it serves."""

    files: FileSystem

    @property
    def now_s(self) -> float:
        """Seconds since boot."""


def handle(vehicle: FileContext, link: Link, message: Any) -> None:
    """FILE_TRANSFER_PROTOCOL from a client."""
    if link.file_transfer is None:
        link.file_transfer = Server(vehicle.files)
    source = (message.get_srcSystem(), message.get_srcComponent())
    reply = link.file_transfer.answer(bytes(message.payload), source, vehicle.now_s)
    if reply is not None:
        link.send(dialect.MAVLink_file_transfer_protocol_message(0, *source, reply))


def continue_transfer(link: Link, now_s: float) -> None:
    """Send the due packets of a running burst."""
    if link.file_transfer is not None and not link.file_transfer.idle:
        for (system, component), payload in link.file_transfer.burst(now_s):
            link.send(dialect.MAVLink_file_transfer_protocol_message(0, system, component, payload))
