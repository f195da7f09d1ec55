"""MAVLink FTP (https://mavlink.io/en/services/ftp.html), as in PX4's server: one session per link.

`Server.answer` takes a FILE_TRANSFER_PROTOCOL payload and returns the reply's; `Server.burst` returns the due
packets of a burst read. Files are in a `FileSystem` in memory, without access to the host's disk: absolute
and relative paths both begin at its root, as in PX4, and `..` never leads above it.
"""

from __future__ import annotations

import errno
import logging
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, Protocol

from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import dialect

CAPACITY_BYTES = 16 * 1024 * 1024
MAX_ENTRIES = 2000
MAX_NAME_BYTES = 220  # with its size it must fit into one answer to a list request
# A flight controller's card is mounted here; PX4's simulation has the same files at its root.
STORAGE = ("fs", "microsd")

Path = tuple[str, ...]


class FileSystem:
    """Files written by clients, and read-only files provided by the vehicle, which are generated when read.

    Args:
        capacity_bytes: limit of all written files together; more is ENOSPC.
        joins_root: a path without a leading "/" is below the root; else there is no such file, as in PX4's
            SITL before v1.16, which appends it to its root "." (".etc").
    """

    def __init__(self, capacity_bytes: int = CAPACITY_BYTES, *, joins_root: bool = True) -> None:
        self._capacity_bytes, self._joins_root = capacity_bytes, joins_root
        self._files: dict[Path, bytearray] = {}
        self._provided: dict[Path, Callable[[], bytes]] = {}
        self._directories: set[Path] = {()}

    # ---- provided files

    def provide(self, path: str, content: Callable[[], bytes]) -> None:
        """Provide a read-only file, generated whenever it is opened; its folders are created."""
        parts = resolve(path)
        for depth in range(1, len(parts)):
            self._directories.add(parts[:depth])
        self._provided[parts] = content

    def is_protected(self, path: str) -> bool:
        """Whether this is a provided file, or a folder with one in it."""
        parts = resolve(path)
        return any(provided[: len(parts)] == parts for provided in self._provided)

    # ---- reading

    def list(self, path: str) -> Iterator[tuple[str, int | None]]:
        """(name, size) of a folder's entries by name; a folder's size is None. ENOENT, ENOTDIR."""
        parts = self._directory(path)
        entries = {
            directory[-1]: None for directory in self._directories if directory[:-1] == parts != directory
        }
        sizes: dict[str, int | None] = dict(entries)
        for found, content in self._files.items():
            if found[:-1] == parts:
                sizes[found[-1]] = len(content)
        for found, provider in self._provided.items():
            if found[:-1] == parts:
                sizes[found[-1]] = len(provider())
        return iter(sorted(sizes.items()))

    def read(self, path: str) -> bytes | bytearray:
        """A file's content: the live buffer of a written one. ENOENT, EISDIR."""
        parts = self._parts(path)
        if parts in self._files:
            return self._files[parts]
        if parts in self._provided:
            return self._provided[parts]()
        raise _error(errno.EISDIR, path) if parts in self._directories else self._missing(parts, path)

    # ---- writing

    def create(self, path: str, truncate: bool) -> bytearray:
        """Open for writing, creating the file if there is none. ENOENT (folder), EISDIR, ENOSPC, EROFS."""
        parts = self._writable(path)
        if parts in self._directories:
            raise _error(errno.EISDIR, path)
        if parts not in self._files:
            self._check_new(parts, path)
            self._files[parts] = bytearray()
        elif truncate:
            self.resize(self._files[parts], 0)
        return self._files[parts]

    def resize(self, content: bytearray, size: int) -> None:
        """Truncate a written file or pad it with zeros. ENOSPC."""
        growth = size - len(content)
        # the sum does not include a file removed while open, so its buffer is limited separately
        if growth > 0 and max(size, growth + sum(map(len, self._files.values()))) > self._capacity_bytes:
            raise _error(errno.ENOSPC, f"{growth} more bytes")
        if growth > 0:
            content.extend(bytes(growth))
        else:
            del content[size:]

    def write(self, content: bytearray, offset: int, data: bytes) -> int:
        """Write into an open file, padded with zeros up to the offset. ENOSPC."""
        end = offset + len(data)
        if end > len(content):
            self.resize(content, end)
        content[offset:end] = data
        return len(data)

    def truncate(self, path: str, size: int) -> None:
        parts = self._writable(path)
        if parts not in self._files:
            raise _error(errno.EISDIR, path) if parts in self._directories else self._missing(parts, path)
        self.resize(self._files[parts], size)

    def remove(self, path: str) -> None:
        parts = self._writable(path)
        if parts not in self._files:
            raise _error(errno.EISDIR, path) if parts in self._directories else self._missing(parts, path)
        del self._files[parts]  # a session that has it open keeps it, as in POSIX

    def make_directory(self, path: str) -> None:
        parts = self._parts(path)
        if parts in self._directories or parts in self._files or parts in self._provided:
            raise _error(errno.EEXIST, path)
        self._check_new(parts, path)
        self._directories.add(parts)

    def remove_directory(self, path: str) -> None:
        parts = self._writable(path)
        if parts in self._files:
            raise _error(errno.ENOTDIR, path)
        if parts not in self._directories:
            raise self._missing(parts, path)
        self._check_empty(parts, path)
        if not parts:
            raise _error(errno.EBUSY, path)  # the root
        self._directories.remove(parts)

    def rename(self, old: str, new: str) -> None:
        """Rename a file or a folder; it replaces another file or an empty folder."""
        source, target = self._writable(old), self._writable(new)
        for parts, path in ((source, old), (target, new)):
            self._check_parent(parts, path)
        is_folder = source in self._directories
        if not is_folder and source not in self._files:
            raise _error(errno.ENOENT, old)
        if target == source:
            return
        if target[: len(source)] == source:
            raise _error(errno.EINVAL, new)
        if source[: len(target)] == target:
            raise _error(errno.ENOTEMPTY, new)
        if target in self._files and is_folder:
            raise _error(errno.ENOTDIR, new)
        if target in self._directories:
            if not is_folder:
                raise _error(errno.EISDIR, new)
            self._check_empty(target, new)
        elif target not in self._files:
            self._check_new(target, new)
        depth = len(source)
        self._directories = {
            target + parts[depth:] if parts[:depth] == source else parts for parts in self._directories
        }
        self._files = {
            target + parts[depth:] if parts[:depth] == source else parts: content
            for parts, content in self._files.items()
            if parts != target
        }

    # ---- within

    def _parts(self, path: str) -> Path:
        """The components of a path in a request. ENOENT if it is not below the root."""
        if path and not path.startswith("/") and not self._joins_root:
            raise _error(errno.ENOENT, path)
        return resolve(path)

    def _entries(self) -> Iterator[Path]:
        yield from (parts for parts in self._directories if parts)
        yield from self._files
        yield from self._provided

    def _directory(self, path: str) -> Path:
        parts = self._parts(path)
        if parts not in self._directories:
            known = parts in self._files or parts in self._provided
            raise _error(errno.ENOTDIR, path) if known else self._missing(parts, path)
        return parts

    def _writable(self, path: str) -> Path:
        if self.is_protected(path):
            raise _error(errno.EROFS, path)
        return self._parts(path)

    def _missing(self, parts: Path, path: str) -> OSError:
        """The error of a missing path: ENOTDIR if it leads through a file, else ENOENT."""
        through = any(
            parts[:depth] in self._files or parts[:depth] in self._provided for depth in range(len(parts))
        )
        return _error(errno.ENOTDIR if through else errno.ENOENT, path)

    def _check_parent(self, parts: Path, path: str) -> None:
        if parts[:-1] not in self._directories:
            raise self._missing(parts, path)

    def _check_empty(self, parts: Path, path: str) -> None:
        if any(other[:-1] == parts for other in self._entries()):
            raise _error(errno.ENOTEMPTY, path)

    def _check_new(self, parts: Path, path: str) -> None:
        self._check_parent(parts, path)
        if len(parts[-1].encode(errors="surrogateescape")) > MAX_NAME_BYTES:
            raise _error(errno.ENAMETOOLONG, path)
        if len(self._files) + len(self._directories) >= MAX_ENTRIES:
            raise _error(errno.ENOSPC, path)


def resolve(path: str) -> Path:
    """The components of a path from the root; the two mount points of the storage card are the same."""
    names: list[str] = []
    for name in path.split("/"):
        if name == "..":
            del names[-1:]
        elif name not in ("", "."):
            names.append(name)
    if tuple(names[:2]) == STORAGE:
        del names[:2]
    return tuple(names)


def _error(number: int, path: str) -> OSError:
    return OSError(number, os.strerror(number), path)


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
    FAIL = 1
    FAIL_ERRNO = 2
    INVALID_DATA_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS_AVAILABLE = 5
    END_OF_FILE = 6
    UNKNOWN_COMMAND = 7
    FILE_EXISTS = 8
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


_FAILURE_OF_ERRNO = {
    errno.EEXIST: Failure.FILE_EXISTS,
    errno.ENOENT: Failure.FILE_NOT_FOUND,
    errno.EROFS: Failure.FILE_PROTECTED,
}


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
class _Session:
    content: bytes | bytearray
    size: int  # size at opening: reading ends there
    readable: bool
    writable: bool


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
        self._session: _Session | None = None
        self._burst: _Burst | None = None
        self._received_s = 0.0
        self._last_reply: Packet | None = None

    @property
    def idle(self) -> bool:
        """No file is open: `burst` need not be called."""
        return self._session is None

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
            handler = _HANDLERS.get(request.opcode)
            if handler is None:
                raise RequestRefusedError(Failure.UNKNOWN_COMMAND)
            session, data = handler(self, request)
            reply = replace(request, opcode=Opcode.ACK, session=session, data=data)
        except RequestRefusedError as error:
            reply = _nak(request, bytes([error.failure]))
        except OSError as error:
            number = error.errno or errno.EIO
            failure = _FAILURE_OF_ERRNO.get(number)
            reason = bytes([Failure.FAIL_ERRNO, number]) if failure is None else bytes([failure])
            reply = _nak(request, reason)
        reply = replace(reply, sequence=(request.sequence + 1) & 0xFFFF, requested=request.opcode)
        # Longer answers are data, which can be read again.
        if len(reply.data) <= 4 and reply.data[:1] != bytes([Failure.NO_SESSIONS_AVAILABLE]):
            self._last_reply = reply
        return reply.pack()

    def burst(self, now_s: float) -> list[tuple[tuple[int, int], bytes]]:
        """((system, component), payload) of the due burst packets; closes a session without requests."""
        if self._session is None:
            return []
        if now_s - self._received_s > SESSION_TIMEOUT_S:
            logger.info("the FTP session was closed after %g s without a request", SESSION_TIMEOUT_S)
            self._close()
            self._last_reply = None
            return []
        packets: list[tuple[tuple[int, int], bytes]] = []
        while self._burst is not None and len(packets) < BURST_PACKETS:
            last = len(packets) == BURST_PACKETS - 1
            packets.append((self._burst.target, self._next_of(self._session, self._burst, last)))
        return packets

    def _next_of(self, session: _Session, burst: _Burst, last_of_step: bool) -> bytes:
        packet = Packet(burst.sequence, 0, Opcode.ACK, 0, Opcode.BURST_READ_FILE, False, burst.offset, b"")
        burst.sequence = (burst.sequence + 1) & 0xFFFF
        if burst.offset >= session.size:
            self._burst = None
            return _nak(packet, bytes([Failure.END_OF_FILE])).pack()
        data = bytes(session.content[burst.offset : min(burst.offset + DATA_BYTES, session.size)])
        burst.offset += len(data)
        burst.sent_bytes += len(data)
        complete = last_of_step and burst.sent_bytes > BURST_BYTES
        if complete or not data:
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

    def _open(self, content: bytes | bytearray, size: int, writable: bool) -> tuple[int, bytes]:
        self._session = _Session(content, size, not writable, writable)
        self._burst = None
        return 0, struct.pack("<I", size)

    def _open_read(self, request: Packet) -> tuple[int, bytes]:
        self._check_free()
        content = self._files.read(request.text)
        return self._open(content, len(content), False)

    def _open_write(self, request: Packet) -> tuple[int, bytes]:
        self._check_free()
        content = self._files.create(request.text, truncate=False)
        return self._open(content, len(content), True)

    def _create(self, request: Packet) -> tuple[int, bytes]:
        self._check_free()
        content = self._files.create(request.text, truncate=True)
        return self._open(content, 0, True)

    def _check_free(self) -> None:
        if self._session is not None:
            raise RequestRefusedError(Failure.NO_SESSIONS_AVAILABLE)

    def _opened(self, request: Packet) -> _Session:
        if request.session != 0 or self._session is None:
            raise RequestRefusedError(Failure.INVALID_SESSION)
        return self._session

    def _read(self, request: Packet) -> tuple[int, bytes]:
        session = self._opened(request)
        if request.offset >= session.size:
            raise RequestRefusedError(Failure.END_OF_FILE)
        if not session.readable:
            raise OSError(errno.EBADF, "opened for writing")
        return 0, bytes(session.content[request.offset : request.offset + request.size])

    def _begin_burst(self, request: Packet, source: tuple[int, int]) -> None:
        session = self._opened(request)
        if not session.readable:
            raise OSError(errno.EBADF, "opened for writing")
        self._burst = _Burst((request.sequence + 1) & 0xFFFF, request.offset, 0, source)

    def _write(self, request: Packet) -> tuple[int, bytes]:
        session = self._opened(request)
        if not session.writable or not isinstance(session.content, bytearray):
            raise OSError(errno.EBADF, "opened for reading")
        written = self._files.write(session.content, request.offset, request.data)
        return 0, struct.pack("<I", written)

    def _remove(self, request: Packet) -> tuple[int, bytes]:
        self._files.remove(request.text)
        return request.session, b""

    def _make_directory(self, request: Packet) -> tuple[int, bytes]:
        self._files.make_directory(request.text)
        return request.session, b""

    def _remove_directory(self, request: Packet) -> tuple[int, bytes]:
        self._files.remove_directory(request.text)
        return request.session, b""

    def _truncate(self, request: Packet) -> tuple[int, bytes]:
        self._files.truncate(request.text, request.offset)
        return request.session, b""

    def _rename(self, request: Packet) -> tuple[int, bytes]:
        old, nul, rest = request.data.partition(b"\0")
        new = rest.split(b"\0", 1)[0]
        if not nul or not new:
            raise OSError(errno.EINVAL, "expected two paths separated by a NUL")
        self._files.rename(old.decode(errors="surrogateescape"), new.decode(errors="surrogateescape"))
        return request.session, b""

    def _checksum(self, request: Packet) -> tuple[int, bytes]:
        return request.session, struct.pack("<I", checksum(self._files.read(request.text)))

    def _close(self) -> None:
        self._session = None
        self._burst = None


def checksum(content: bytes | bytearray) -> int:
    """MAVLink FTP's CRC-32: the usual polynomial, without inversion before and after."""
    return zlib.crc32(content, 0xFFFFFFFF) ^ 0xFFFFFFFF


def _nak(packet: Packet, reason: bytes) -> Packet:
    return replace(packet, opcode=Opcode.NAK, data=reason)


_HANDLERS: dict[int, Callable[[Server, Packet], tuple[int, bytes]]] = {
    Opcode.NONE: Server._none,
    Opcode.TERMINATE_SESSION: Server._terminate,
    Opcode.RESET_SESSIONS: Server._reset,
    Opcode.LIST_DIRECTORY: Server._list,
    Opcode.OPEN_FILE_RO: Server._open_read,
    Opcode.READ_FILE: Server._read,
    Opcode.CREATE_FILE: Server._create,
    Opcode.WRITE_FILE: Server._write,
    Opcode.REMOVE_FILE: Server._remove,
    Opcode.CREATE_DIRECTORY: Server._make_directory,
    Opcode.REMOVE_DIRECTORY: Server._remove_directory,
    Opcode.OPEN_FILE_WO: Server._open_write,
    Opcode.TRUNCATE_FILE: Server._truncate,
    Opcode.RENAME: Server._rename,
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
