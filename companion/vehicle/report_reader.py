"""Converts STATUSTEXT and EVENT of one autopilot into reports; event texts are read from the autopilot."""

from __future__ import annotations

import json
import logging
import lzma
import os
import re
import struct
import time
from collections import deque
from collections.abc import Awaitable, Callable
from pathlib import Path

from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.event_catalogue import Event, EventCatalogue
from companion.vehicle.file_reader import FTP_ID, FileReader, FileReadError
from companion.vehicle.framing import (
    COMPONENT_METADATA_ID,
    CURRENT_EVENT_SEQUENCE_ID,
    EVENT_ID,
    REQUEST_EVENT_ID,
    Frame,
)
from companion.vehicle.status_texts import STATUSTEXT_ID, StatusTexts
from companion.vehicle.telemetry_state import TelemetryState

logger = logging.getLogger(__name__)

_REQUEST_MESSAGE = 512
_EVENT = struct.Struct(
    "<IIHBBB40s"
)  # id, boot ms, sequence, destination component and system, levels, arguments
_METADATA = struct.Struct("<II100s")  # boot ms, CRC-32 of the file, its URI
_EVENTS_TYPE = 4  # COMP_METADATA_TYPE_EVENTS
_MFTP = re.compile(r"mftp://(?:\[;comp=\d+\])?/?(.+)")
_METADATA_S = 3.0
_WAITING_EVENTS = 40
_LONGEST_GAP = 20  # PX4 buffers this many events


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
        """Read the event metadata once. On failure, log the reason and report events by number."""
        try:
            catalogue = EventCatalogue(await self._read_metadata())
        except (FileReadError, CommandRefusedError, ValueError, lzma.LZMAError) as error:
            logger.warning("%s: event metadata not available, events are numbers: %s", self._url, error)
            catalogue = EventCatalogue(None)
        self._catalogue = catalogue
        while self._waiting:
            event, now_ns = self._waiting.popleft()
            self._telemetry.on_report(catalogue.report(event, now_ns))

    async def _read_metadata(self) -> bytes:
        self._metadata = None
        await self._command(_REQUEST_MESSAGE, COMPONENT_METADATA_ID)
        if not await self._telemetry.until(lambda: self._metadata is not None, _METADATA_S):
            raise FileReadError("COMPONENT_METADATA not received (PX4 1.13 and newer send it)")
        assert self._metadata is not None
        crc, uri = self._metadata
        general = json.loads(await self._file("general", crc, uri))
        for entry in general["metadataTypes"]:
            if entry["type"] == _EVENTS_TYPE:
                return await self._file("events", int(entry["fileCrc"]), str(entry["uri"]))
        raise FileReadError(f"{uri} lists no events metadata")

    async def _file(self, what: str, crc: int, uri: str) -> bytes:
        """Read a metadata file from the cache, by its checksum, else from the autopilot."""
        cached = cache_folder() / f"{what}-{crc:08x}.json"
        if cached.is_file():
            return cached.read_bytes()
        path = _MFTP.fullmatch(uri)
        if path is None:
            raise FileReadError(f"{uri}: only mftp:// is supported")
        content = await self._files.read(path[1])
        if path[1].endswith(".xz"):
            content = lzma.decompress(content)
        json.loads(content)
        try:
            cached.parent.mkdir(parents=True, exist_ok=True)
            part = cached.with_suffix(f".{os.getpid()}")
            part.write_bytes(content)
            part.replace(cached)
        except OSError as error:
            logger.info("%s: metadata cannot be cached, it is read at every start: %s", self._url, error)
        return content


def cache_folder() -> Path:
    """Return the folder of cached metadata, in `$XDG_CACHE_HOME` or `~/.cache`."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(home) if home else Path.home() / ".cache") / "companion" / "metadata"
