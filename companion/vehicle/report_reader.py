"""Reports of an autopilot, from its STATUSTEXT and EVENT messages.

STATUSTEXT is reassembled (https://mavlink.io/en/messages/common.html#STATUSTEXT). The texts of PX4's events
come from MAVLink's events metadata (https://mavlink.io/en/services/events.html), a file that is read from the
autopilot by MAVLink FTP (https://mavlink.io/en/services/ftp.html).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import lzma
import os
import re
import struct
import time
import zlib
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple, NotRequired, TypeVar

from pydantic import Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from companion.host.peer_data import PeerDataError, check_size
from companion.vehicle.framing import (
    COMPONENT_METADATA_ID,
    CURRENT_EVENT_SEQUENCE_ID,
    EVENT_ID,
    REQUEST_EVENT_ID,
    Frame,
)
from companion.vehicle.report import ALL_MODES, WARNING, Report
from companion.vehicle.telemetry_state import TelemetryState
from vision.home import home_folder

logger = logging.getLogger(__name__)

STATUSTEXT_ID = 253
_STATUSTEXT = struct.Struct("<B50sHB")  # severity, text, id, chunk_seq
_CHUNK = 50
_LONGEST_TEXT = 500
_LAYOUTS = {
    "uint8_t": "<B",
    "int8_t": "<b",
    "uint16_t": "<H",
    "int16_t": "<h",
    "uint32_t": "<I",
    "int32_t": "<i",
    "uint64_t": "<Q",
    "int64_t": "<q",
    "float": "<f",
}
# {argument, from 1}{decimals}{unit}; literal braces are escaped.
# Digits and unit are bounded: the width of a text is not the autopilot's to choose.
_ARGUMENT = re.compile(r"(?<!\\)\{(\d{1,2})(?::\.(\d{1,2}))?([^}]{0,20})\}")
_TAG = re.compile(r"(?<!\\)<[^>]{0,100}>")
_UNITS = {"m": " m", "m_v": " m", "m^2": " m²", "m/s": " m/s", "C": " °C"}
_MODES_TYPE = "navigation_mode_group_t"
_MAX_LEVEL = 7  # MAV_SEVERITY_DEBUG; above it are messages between machines
FTP_ID = 110  # FILE_TRANSFER_PROTOCOL
_TERMINATE, _RESET, _OPEN, _READ, _ACK = 1, 2, 4, 5, 128
_END_OF_FILE, _NO_SUCH_FILE = 6, 10
_ERRORS = {
    1: "failed",
    2: "failed: errno",
    4: "wrong session",
    5: "no free session",
    _NO_SUCH_FILE: "no such file",
}
# target network, system, component; sequence, session, opcode, size, request opcode, burst, padding, offset
_HEADER = struct.Struct("<3BHBBBBBBI")
_DATA = 239
_ATTEMPTS, _ATTEMPT_S = 6, 0.5
# PX4 1.16: 16,508 bytes, unpacked 164,112.
LARGEST_FILE, LARGEST_UNPACKED = 256 * 1024, 2 * 1024 * 1024
# Reading takes 20 s on a slow radio. Parsing takes 10 ms, in a thread; a longer one is not waited for.
_READING_S, _PARSING_S = 180.0, 10.0
_XZ_MEMORY = 128 * 1024 * 1024  # of the decoder; xz -9 needs 65 MiB
_Kind = TypeVar("_Kind")
_REQUEST_MESSAGE = 512
# id, boot ms, sequence, destination component and system, levels, arguments
_EVENT = struct.Struct("<IIHBBB40s")
_METADATA = struct.Struct("<II100s")  # boot ms, CRC-32 of the file, its URI
_EVENTS_TYPE = 4  # COMP_METADATA_TYPE_EVENTS
_MFTP = re.compile(r"mftp://(?:\[;comp=\d+\])?/?(.+)")
_METADATA_S = 3.0
_WAITING_EVENTS = 40
_LONGEST_GAP = 20  # PX4 buffers this many events


class StatusTexts:
    """Reassembles texts from STATUSTEXT: long ones are sent in chunks of 50 bytes with one id."""

    def __init__(self) -> None:
        self._id = 0
        self._chunks: list[bytes] = []

    def add(self, frame: Frame, now_ns: int) -> Report | None:
        """Return the text that a frame completes. A text with a lost chunk is dropped at the next text."""
        severity, chunk, identifier, sequence = _STATUSTEXT.unpack(frame.padded(_STATUSTEXT.size))
        ends = b"\0" in chunk
        if identifier == 0:
            return _text_report(severity, chunk, now_ns)
        if sequence == 0 or identifier != self._id:
            self._id, self._chunks = identifier, []
        if sequence != len(self._chunks):
            return None
        self._chunks.append(chunk)
        if not ends and len(self._chunks) * _CHUNK < _LONGEST_TEXT:
            return None
        whole, self._chunks, self._id = b"".join(self._chunks), [], 0
        return _text_report(severity, whole, now_ns)


def _text_report(severity: int, text: bytes, now_ns: int) -> Report | None:
    words = text.split(b"\0")[0].decode("utf-8", "replace").strip()
    if words.endswith("fence breached"):
        severity = min(severity, WARNING)  # ArduPilot 4.7 sends the reason of its mode change as NOTICE
    return Report(now_ns, severity, words) if words else None


class Event(NamedTuple):
    """The fields of EVENT (410). `log_levels`: external level in the lower 4 bits; `arguments`: 40 bytes."""

    identifier: int
    sequence: int
    log_levels: int
    arguments: bytes


_Name = Annotated[str, Field(max_length=100)]
_Words = Annotated[str, Field(max_length=1000)]
_Byte = Annotated[int, Field(ge=0, le=0xFF)]
_MAX_ENTRIES, _MAX_ARGUMENTS = 256, 40


class _Argument(TypedDict):
    type: _Name


class _EventEntry(TypedDict, total=False):
    name: _Name
    message: _Words
    type: _Name
    arguments: Annotated[list[_Argument], Field(max_length=_MAX_ARGUMENTS)]


class _EnumEntry(TypedDict):
    name: _Name
    description: NotRequired[_Words]


class _Enum(TypedDict):
    type: _Name
    is_bitfield: NotRequired[bool]
    entries: Annotated[
        dict[Annotated[int, Field(ge=0, lt=2**64)], _EnumEntry], Field(max_length=_MAX_ENTRIES)
    ]


class _Group(TypedDict, total=False):
    events: dict[Annotated[int, Field(ge=0, le=0xFFFFFF)], _EventEntry]


class _Component(TypedDict):
    namespace: _Name
    enums: NotRequired[dict[_Name, _Enum]]
    event_groups: NotRequired[dict[_Name, _Group]]


class _Events(TypedDict):
    """The part that is used of MAVLink's schema of events metadata, with limits."""

    components: dict[_Byte, _Component]


class _MetadataFile(TypedDict):
    type: int
    uri: NotRequired[_Words]
    fileCrc: NotRequired[Annotated[int, Field(ge=0, lt=2**32)]]


class _General(TypedDict):
    """The part that is used of MAVLink's schema of general metadata."""

    metadataTypes: Annotated[list[_MetadataFile], Field(max_length=100)]


_EVENTS, _GENERAL = TypeAdapter(_Events), TypeAdapter(_General)


def _checked(schema: TypeAdapter[_Kind], content: bytes) -> _Kind:
    """Parse JSON by a schema. Raises PeerDataError."""
    check_size(len(content), LARGEST_UNPACKED)
    try:
        return schema.validate_json(content)
    except ValidationError as error:
        first = error.errors(include_input=False)[0]
        where = ".".join(map(str, first["loc"]))[:100]
        raise PeerDataError(f"not metadata{where and f', {where}'}: {first['msg']}") from None


def _unpacked(path: str, served: bytes) -> bytes:
    """Return the content of a file; of `.xz` no more is unpacked than is accepted. Raises PeerDataError."""
    if not path.endswith(".xz"):
        check_size(len(served), LARGEST_UNPACKED)
        return served
    try:
        unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY)
        content = unpacker.decompress(served, LARGEST_UNPACKED + 1)
    except (lzma.LZMAError, EOFError, MemoryError) as error:
        raise PeerDataError(f"{path}: not xz: {error}") from error
    check_size(len(content), LARGEST_UNPACKED)
    if not unpacker.eof:
        raise PeerDataError(f"{path}: truncated xz")
    return content


class EventCatalogue:
    """The events of one autopilot's metadata.

    Args:
        metadata: the events JSON; None: not available, so events are reported by number.

    Raises:
        PeerDataError: `metadata` is not events JSON.
    """

    def __init__(self, metadata: bytes | None) -> None:
        self._events: dict[int, tuple[str, _EventEntry]] = {}
        self._enums: dict[str, _Enum] = {}
        if metadata is None:
            return
        for number, component in _checked(_EVENTS, metadata)["components"].items():
            for name, enum in component.get("enums", {}).items():
                self._enums[f"{component['namespace']}::{name}"] = enum
            for group, content in component.get("event_groups", {}).items():
                for identifier, event in content.get("events", {}).items():
                    self._events[number << 24 | identifier] = (group, event)

    def report(self, event: Event, now_ns: int) -> Report | None:
        """Convert an event to a report. None for summaries and for levels beyond debug."""
        level = event.log_levels & 0x0F
        group, known = self._events.get(event.identifier, ("", _EventEntry()))
        if level > _MAX_LEVEL or known.get("type") == "summary":
            return None
        if "message" not in known:
            return Report(now_ns, level, f"event {event.identifier:#010x} (not in the metadata)")
        arguments = known.get("arguments", [])
        values = self._values(arguments, event.arguments)
        of_modes = len(arguments) > 0 and arguments[0]["type"].endswith(_MODES_TYPE)
        modes = int.from_bytes(event.arguments[:4], "little") if of_modes else ALL_MODES

        def formatted(match: re.Match[str]) -> str:
            number = int(match[1]) - 1
            return _value(values[number], match[2], match[3]) if 0 <= number < len(values) else "?"

        text = _ARGUMENT.sub(formatted, _TAG.sub("", str(known["message"])))
        text = re.sub(r"\\(.)", r"\1", text).strip()[:_LONGEST_TEXT]
        return Report(now_ns, level, text, group, known.get("name", ""), modes)

    def _values(self, arguments: Sequence[_Argument], packed: bytes) -> list[str | float]:
        """Decode the arguments in order, up to the first that the metadata does not describe."""
        values: list[str | float] = []
        offset = 0
        for argument in arguments:
            enum = self._enums.get(argument["type"]) or self._enums.get(f"px4::{argument['type']}")
            layout = _LAYOUTS.get(argument["type"] if enum is None else enum["type"])
            if layout is None or offset + struct.calcsize(layout) > len(packed):
                break
            (number,) = struct.unpack_from(layout, packed, offset)
            offset += struct.calcsize(layout)
            values.append(number if enum is None else _named(enum, number))
        return values


def _named(enum: _Enum, number: int) -> str:
    entries = {value: entry.get("description") or entry["name"] for value, entry in enum["entries"].items()}
    if not enum.get("is_bitfield"):
        return str(entries.get(number, number))
    return ", ".join(words for bit, words in sorted(entries.items()) if number & bit) or "none"


def _value(value: str | float, decimals: str | None, unit: str) -> str:
    words = f"{value:.{decimals}f}" if decimals is not None and not isinstance(value, str) else f"{value}"
    return words + _UNITS.get(unit, unit)


class FileReadError(OSError):
    """The file cannot be read. The message says which and why."""


class NoSuchFileError(FileReadError):
    """The autopilot has no file of this name."""


class FileReader:
    """Reads one file at a time.

    Args:
        send: sends one payload of FILE_TRANSFER_PROTOCOL.
        target: returns system and component id of the autopilot.
    """

    def __init__(self, send: Callable[[int, bytes], None], target: Callable[[], tuple[int, int]]) -> None:
        self._send, self._target = send, target
        self._sequence = 0
        self._answer: asyncio.Future[bytes] | None = None

    def on_frame(self, frame: Frame) -> None:
        """Process a reply of the autopilot."""
        payload = frame.padded(_HEADER.size + _DATA)
        sequence = _HEADER.unpack_from(payload)[3]
        if self._answer is not None and not self._answer.done() and sequence == self._sequence + 1 & 0xFFFF:
            self._answer.set_result(payload)

    async def read(self, path: str) -> bytes:
        """Return the content of a file. Raises FileReadError."""
        await self._request(path, _RESET)  # closes sessions that were left open
        session, opened = await self._request(path, _OPEN, path.encode())
        size = int.from_bytes(opened[:4], "little")
        if size > LARGEST_FILE:
            raise FileReadError(f"{path}: {size} bytes exceed the limit of {LARGEST_FILE}")
        content = bytearray()
        try:
            while len(content) < size:
                _, part = await self._request(path, _READ, session=session, offset=len(content), size=_DATA)
                if not part:
                    raise FileReadError(f"{path}: truncated after {len(content)} of {size} bytes")
                content += part
        finally:
            with contextlib.suppress(FileReadError):
                await self._request(path, _TERMINATE, session=session)
        return bytes(content)

    async def _request(
        self, path: str, opcode: int, data: bytes = b"", *, session: int = 0, offset: int = 0, size: int = 0
    ) -> tuple[int, bytes]:
        """Send one request, repeated until answered; returns the session and the reply's data."""
        self._sequence = self._sequence + 2 & 0xFFFF
        system, component = self._target()
        header = _HEADER.pack(
            0, system, component, self._sequence, session, opcode, size or len(data), 0, 0, 0, offset
        )
        for _ in range(_ATTEMPTS):
            self._answer = asyncio.get_running_loop().create_future()
            self._send(FTP_ID, (header + data).ljust(_HEADER.size + _DATA, b"\0"))
            await asyncio.wait([self._answer], timeout=_ATTEMPT_S)
            if self._answer.done():
                break
        else:
            raise FileReadError(f"{path}: no MAVLink FTP answer from the autopilot")
        payload = self._answer.result()
        _, _, _, _, answered, code, length, _, _, _, _ = _HEADER.unpack_from(payload)
        part = payload[_HEADER.size : _HEADER.size + min(length, _DATA)]
        if code == _ACK:
            return answered, part
        error = part[0] if part else 0
        if opcode in (_RESET, _TERMINATE) or (opcode == _READ and error == _END_OF_FILE):
            return answered, b""
        kind = NoSuchFileError if error == _NO_SUCH_FILE else FileReadError
        raise kind(f"{path}: {_ERRORS.get(error, f'MAVLink FTP error {error}')}")


class ReportReader:
    """Processes the frames that carry reports, and reads the event metadata.

    Args:
        url: of the link, for the log. telemetry: receives the reports.
        send: sends a message's payload. command: sends one command and returns the MAV_RESULT.
        target: returns system and component id of the autopilot.
    """

    def __init__(
        self,
        url: object,
        telemetry: TelemetryState,
        send: Callable[[int, bytes], None],
        command: Callable[..., Awaitable[int]],
        target: Callable[[], tuple[int, int]],
    ) -> None:
        self._url, self._telemetry, self._send = url, telemetry, send
        self._command, self._target = command, target
        self._texts, self._files = StatusTexts(), FileReader(send, target)
        self._catalogue: EventCatalogue | None = None
        self._waiting: deque[tuple[Event, int]] = deque(maxlen=_WAITING_EVENTS)
        self._newest: int | None = None
        self._metadata: tuple[int, str] | None = None

    def on_frame(self, frame: Frame) -> bool:
        """Process a frame of the autopilot; returns whether it was handled here."""
        now_ns = time.monotonic_ns()
        kind = frame.message_id
        if kind == STATUSTEXT_ID:
            self._telemetry.on_report(self._texts.add(frame, now_ns))
        elif kind == EVENT_ID:
            identifier, _, sequence, _, _, levels, arguments = _EVENT.unpack(frame.padded(_EVENT.size))
            self._on_event(Event(identifier, sequence, levels, arguments), now_ns)
        elif kind == CURRENT_EVENT_SEQUENCE_ID:
            self._request_missed(int.from_bytes(frame.padded(2), "little") + 1 & 0xFFFF)
        elif kind == COMPONENT_METADATA_ID:
            _, crc, uri = _METADATA.unpack(frame.padded(_METADATA.size))
            self._metadata = (crc, uri.split(b"\0")[0].decode("ascii", "replace"))
            self._telemetry.apply("COMPONENT_METADATA", {})
        elif kind == FTP_ID:
            self._files.on_frame(frame)
        else:
            return False
        return True

    def _on_event(self, event: Event, now_ns: int) -> None:
        self._request_missed(event.sequence)
        ahead = 1 if self._newest is None else event.sequence - self._newest & 0xFFFF
        if 0 < ahead < 0x8000:
            self._newest = event.sequence
        if self._catalogue is None:
            self._waiting.append((event, now_ns))
        else:
            self._telemetry.on_report(self._catalogue.report(event, now_ns))

    def _request_missed(self, following: int) -> None:
        """Request the events between the newest received one and this sequence number."""
        if self._newest is None:
            self._newest = following - 1 & 0xFFFF  # events before the connection are not requested
            return
        missed = following - self._newest - 1 & 0xFFFF
        if 0 < missed < 0x8000:
            first = following - min(missed, _LONGEST_GAP) & 0xFFFF
            self._send(REQUEST_EVENT_ID, struct.pack("<HHBB", first, following - 1 & 0xFFFF, *self._target()))

    async def load_events(self) -> None:
        """Read the event metadata once. On any failure, log the reason and report events by number."""
        try:
            async with asyncio.timeout(_READING_S):
                metadata = await self._read_metadata()
            async with asyncio.timeout(_PARSING_S):
                catalogue = await asyncio.to_thread(EventCatalogue, metadata)
        except TimeoutError:
            self._without_metadata(f"not read within {_READING_S:g} s")
            return
        except Exception as error:  # whatever the file has, reasons are reported
            self._without_metadata(f"{type(error).__name__}: {error}")
            return
        self._use(catalogue)

    def _without_metadata(self, reason: str) -> None:
        logger.warning("%s: event metadata not available, events are numbers: %s", self._url, reason)
        self._use(EventCatalogue(None))

    def _use(self, catalogue: EventCatalogue) -> None:
        self._catalogue = catalogue
        while self._waiting:
            event, now_ns = self._waiting.popleft()
            self._telemetry.on_report(catalogue.report(event, now_ns))

    async def _read_metadata(self) -> bytes:
        self._metadata = None
        await self._command(_REQUEST_MESSAGE, COMPONENT_METADATA_ID)
        if not await self._telemetry.until(lambda: self._metadata is not None, _METADATA_S):
            raise FileReadError("COMPONENT_METADATA not received (PX4 1.13 and newer send it)")
        crc, uri = self._metadata or (0, "")
        for entry in _checked(_GENERAL, await self._file("general", crc, uri))["metadataTypes"]:
            if entry["type"] == _EVENTS_TYPE:
                return await self._file("events", entry["fileCrc"], entry["uri"])
        raise FileReadError(f"{uri} lists no events metadata")

    async def _file(self, what: str, crc: int, uri: str) -> bytes:
        """Return the JSON of a metadata file from the cache, by its checksum, else from the autopilot."""
        path = _MFTP.fullmatch(uri)
        if path is None:
            raise FileReadError(f"{uri}: only mftp:// is supported")
        cached = cache_folder() / f"{what}-{crc:08x}.json{'.xz' * path[1].endswith('.xz')}"
        if cached.exists():
            with contextlib.suppress(OSError, PeerDataError):
                served = _read_limited(cached)
                content = await asyncio.to_thread(_unpacked, path[1], served)
                if _matches(crc, served, content):
                    return content
            logger.warning("%s: %s does not match its checksum: read again", self._url, cached)
        try:
            served = await self._files.read(path[1])
        except NoSuchFileError:  # PX4 before v1.16, in SITL, appends the path to its root without a "/"
            served = await self._files.read(f"/{path[1]}")
        content = await asyncio.to_thread(_unpacked, path[1], served)
        if not _matches(crc, served, content):
            logger.warning("%s: %s does not match its checksum: not cached", self._url, uri)
            return content
        try:
            cached.parent.mkdir(parents=True, exist_ok=True)
            part = cached.with_suffix(f".{os.getpid()}")
            part.write_bytes(served)
            part.replace(cached)
        except OSError as error:
            logger.info("%s: metadata cannot be cached, it is read at every start: %s", self._url, error)
        return content


def _read_limited(path: Path) -> bytes:
    """Return a file's content, and no more than is accepted of it."""
    with path.open("rb") as file:
        return file.read(LARGEST_FILE + 1)


def _matches(crc: int, served: bytes, content: bytes) -> bool:
    """Whether a checksum is that of a file, as served or unpacked: PX4 computes its general one unpacked."""
    return crc in (zlib.crc32(each, 0xFFFFFFFF) ^ 0xFFFFFFFF for each in (served, content))


def cache_folder() -> Path:
    """Return the folder of cached metadata, in `$XDG_CACHE_HOME` or `~/.cache`."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(home) if home else home_folder() / ".cache") / "companion" / "metadata"
