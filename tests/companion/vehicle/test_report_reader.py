"""STATUSTEXT, EVENT and MAVLink FTP at the lowest layer: frames in, reports and requests out."""

import asyncio
import json
import lzma
import struct
import tracemalloc
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.framing import (
    COMPONENT_METADATA_ID,
    CURRENT_EVENT_SEQUENCE_ID,
    EVENT_ID,
    REQUEST_EVENT_ID,
    Frame,
    frames_of,
    pack_frame,
)
from companion.vehicle.report import Report
from companion.vehicle.report_reader import (
    LARGEST_FILE,
    FileReader,
    FileReadError,
    ReportReader,
    StatusTexts,
    cache_folder,
)
from companion.vehicle.telemetry_state import TelemetryState
from mavlink_sim.services.file_transfer import checksum


def frame(message_id: int, payload: bytes) -> Frame:
    packed = pack_frame(message_id, payload, system_id=1, component_id=1, sequence=0)
    (read,) = frames_of(packed)
    return read


def text(words: bytes, identifier: int = 0, chunk: int = 0, severity: int = 2) -> Frame:
    payload = struct.pack("<B50sHB", severity, words, identifier, chunk)
    return frame(mavlink.MAVLINK_MSG_ID_STATUSTEXT, payload)


def event(sequence: int, identifier: int = 0x01000005) -> Frame:
    return frame(EVENT_ID, struct.pack("<IIHBBB40s", identifier, 0, sequence, 0, 0, 0x62, bytes(40)))


def test_short_text_is_reported_without_its_tab() -> None:
    sent = b"Arm: Need Position Estimate\t"
    assert StatusTexts().add(text(sent), 7) == Report(7, 2, sent[:-1].decode())
    assert StatusTexts().add(text(b"\t"), 7) is None


def test_fence_breach_notice_is_a_warning() -> None:
    sent = b"Circle fence breached"
    assert StatusTexts().add(text(sent, severity=5), 7) == Report(7, 4, sent.decode())


def test_long_text_is_reassembled() -> None:
    texts, words = StatusTexts(), b"x" * 50 + b"y" * 50 + b"z"
    assert texts.add(text(words[:50], 4, 0), 1) is None
    assert texts.add(text(words[50:100], 4, 1), 2) is None
    whole = texts.add(text(words[100:], 4, 2), 3)
    assert whole is not None
    assert whole.text == words.decode()


def test_text_with_a_lost_chunk_is_dropped() -> None:
    texts = StatusTexts()
    assert texts.add(text(b"a" * 50, 4, 0), 1) is None
    assert texts.add(text(b"c", 4, 2), 2) is None
    assert texts.add(text(b"b" * 50, 5, 0), 3) is None
    report = texts.add(text(b"!", 5, 1), 4)
    assert report is not None
    assert report.text == "b" * 50 + "!"


class Autopilot:
    """Serves files by MAVLink FTP, losing every `loses`-th reply.

    Attributes:
        on_frame: receives the replies.
        asked: (message id, payload) of every received message.
    """

    def __init__(self, files: Mapping[str, bytes] | None = None, loses: int = 0) -> None:
        self.asked: list[tuple[int, bytes]] = []
        self._files, self._content, self._loses = dict(files or {}), b"", loses
        self.reader = FileReader(self.send, lambda: (1, 1))
        self.on_frame: Callable[[Frame], object] = self.reader.on_frame

    def send(self, message_id: int, payload: bytes) -> None:
        self.asked.append((message_id, payload))
        if self._loses and len(self.asked) % self._loses == 0:
            return
        sequence, session, opcode, size, _, _, _, offset = struct.unpack_from("<HBBBBBBI", payload, 3)
        data, answer = b"", 128
        if opcode == 4:
            content = self._files.get(payload[15 : 15 + size].decode())
            self._content = content or b""
            known = content is not None
            data, answer = (struct.pack("<I", len(self._content)), 128) if known else (b"\x0a", 129)
        elif opcode == 5:
            data = self._content[offset : offset + size]
        header = struct.pack(
            "<3BHBBBBBBI", 0, 1, 191, sequence + 1, session, answer, len(data), opcode, 0, 0, offset
        )
        answered = frame(110, (header + data).ljust(254, b"\0"))
        asyncio.get_running_loop().call_soon(self.on_frame, answered)


@pytest.mark.parametrize(("size", "loses"), [(0, 0), (1, 0), (239, 0), (240, 0), (2000, 0), (2000, 4)])
async def test_file_is_read_despite_lost_replies(
    size: int, loses: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.vehicle.report_reader._ATTEMPT_S", 0.02)
    content = bytes(number % 251 for number in range(size))
    assert await Autopilot({"etc/a.json": content}, loses).reader.read("etc/a.json") == content


async def test_missing_file_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.vehicle.report_reader._ATTEMPT_S", 0.01)
    with pytest.raises(FileReadError, match=r"b\.json: .*such file"):
        await Autopilot().reader.read("etc/b.json")
    with pytest.raises(FileReadError, match=r"b\.json: .*MAVLink FTP "):
        await FileReader(lambda *_: None, lambda: (1, 1)).read("etc/b.json")


async def test_file_that_is_too_large_is_not_read() -> None:
    autopilot = Autopilot({"etc/a.json": bytes(LARGEST_FILE + 1)})
    with pytest.raises(FileReadError, match=str(LARGEST_FILE)):
        await autopilot.reader.read("etc/a.json")
    assert 5 not in [payload[6] for _, payload in autopilot.asked]  # the opcode of a read


class Link:
    """A report reader whose autopilot accepts every command and has no metadata."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.telemetry = TelemetryState("udpin://test", lambda: None)
        self.reader = ReportReader("udpin://test", self.telemetry, self.send, self.command, lambda: (1, 1))

    def send(self, message_id: int, payload: bytes) -> None:
        self.sent.append((message_id, payload))

    async def command(self, *_: float) -> int:
        return 0

    @property
    def missed(self) -> list[tuple[int, int]]:
        asked = [payload for number, payload in self.sent if number == REQUEST_EVENT_ID]
        return [struct.unpack_from("<HH", payload) for payload in asked]


async def test_lost_events_are_requested() -> None:
    link = Link()
    link.reader.on_frame(event(65533))
    link.reader.on_frame(event(65534))
    assert link.missed == []
    link.reader.on_frame(event(2))
    assert link.missed == [(65535, 1)]
    link.reader.on_frame(frame(CURRENT_EVENT_SEQUENCE_ID, struct.pack("<HB", 2, 0)))
    assert link.missed == [(65535, 1)]
    link.reader.on_frame(frame(CURRENT_EVENT_SEQUENCE_ID, struct.pack("<HB", 4, 0)))
    assert link.missed == [(65535, 1), (3, 4)]


async def test_events_wait_for_the_metadata(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("companion.vehicle.report_reader._METADATA_S", 0.02)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    link = Link()
    link.reader.on_frame(event(1))
    assert link.telemetry.state.reports == ()
    await link.reader.load_events()
    assert "COMPONENT_METADATA not " in caplog.text
    reports: tuple[Report, ...] = link.telemetry.state.reports
    (report,) = reports
    assert report.text.startswith("event 0x01000005 (not ")
    assert report.text.endswith(" metadata)")


class AutopilotWithMetadata(Autopilot):
    """Has the text of one event. Its checksum is that of the file as served, as PX4's.

    Args:
        root: before the path that a client has to ask for.
    """

    def __init__(
        self,
        *,
        wrong_checksum: bool = False,
        general: bytes | None = None,
        changed: Mapping[str, bytes] | None = None,
        root: str = "",
    ) -> None:
        named = {"5": {"name": "tested", "message": "Tested"}}
        group = {"namespace": "px4", "event_groups": {"default": {"events": named}}}
        events = lzma.compress(json.dumps({"version": 2, "components": {"1": group}}).encode())
        kind = {"type": 4, "uri": "mftp://events.xz", "fileCrc": checksum(events) ^ wrong_checksum}
        self._general = general or json.dumps({"version": 1, "metadataTypes": [kind]}).encode()
        files = {f"{root}general.xz": lzma.compress(self._general), f"{root}events.xz": events}
        super().__init__({**files, **(changed or {})})

    async def read_texts(self) -> tuple[list[str], int]:
        """Start with this autopilot; returns the texts of its event, and how many messages that took."""
        telemetry, before = TelemetryState("udpin://test", lambda: None), len(self.asked)
        reports = ReportReader("udpin://test", telemetry, self.send, self.command, lambda: (1, 1))
        self.on_frame = reports.on_frame
        reports.on_frame(event(1))
        await reports.load_events()
        return [report.text for report in telemetry.state.reports], len(self.asked) - before

    async def command(self, *_: float) -> int:
        # PX4's checksum of this file is the unpacked one's.
        payload = struct.pack("<II100s", 0, checksum(self._general), b"mftp://general.xz")
        asyncio.get_running_loop().call_soon(self.on_frame, frame(COMPONENT_METADATA_ID, payload))
        return 0


@pytest.fixture
def cached(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], list[Path]]:
    """Returns the cached event metadata."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return lambda: list(cache_folder().glob("events-*"))


@pytest.mark.parametrize("root", ["", "/"])
async def test_metadata_is_asked_for_with_and_without_a_slash(
    root: str, cached: Callable[[], list[Path]], caplog: pytest.LogCaptureFixture
) -> None:
    """PX4 announces a path without one; before v1.16, in SITL, only one with it is found."""
    autopilot = AutopilotWithMetadata(root=root)
    assert (await autopilot.read_texts())[0] == ["Tested"]
    assert caplog.messages == []
    assert len(cached()) == 1


@pytest.mark.parametrize("spoil", [lambda content: content[:40], lambda content: b"", lambda content: b"{}"])
async def test_spoilt_cache_is_read_again(
    cached: Callable[[], list[Path]], spoil: Callable[[bytes], bytes], caplog: pytest.LogCaptureFixture
) -> None:
    autopilot = AutopilotWithMetadata()
    first = await autopilot.read_texts()
    assert first[0] == ["Tested"]
    assert await autopilot.read_texts() == (["Tested"], 0)
    (events,) = cached()
    events.write_bytes(spoil(events.read_bytes()))
    assert caplog.messages == []
    again = await autopilot.read_texts()
    assert again[0] == ["Tested"]
    assert 0 < again[1] < first[1]
    assert [str(events) in message for message in caplog.messages] == [True]
    assert await autopilot.read_texts() == (["Tested"], 0)


async def test_metadata_with_a_wrong_checksum_is_used_but_not_cached(
    cached: Callable[[], list[Path]], caplog: pytest.LogCaptureFixture
) -> None:
    assert (await AutopilotWithMetadata(wrong_checksum=True).read_texts())[0] == ["Tested"]
    assert len(caplog.messages) == 1
    assert cached() == []


async def assert_unusable(autopilot: AutopilotWithMetadata, caplog: pytest.LogCaptureFixture) -> None:
    """Little memory, numbers instead of texts, and one short line."""
    tracemalloc.start()
    try:
        texts, _ = await autopilot.read_texts()
        assert tracemalloc.get_traced_memory()[1] < 40e6
    finally:
        tracemalloc.stop()
    assert [text.startswith("event 0x01000005") for text in texts] == [True]
    lines = [message for message in caplog.messages if "events are numbers" in message]
    assert len(lines) == 1
    assert "\n" not in lines[0]
    assert len(lines[0]) < 400


@pytest.mark.parametrize(
    ("general", "changed"),
    [
        (None, {"events.xz": b""}),
        (None, {"events.xz": lzma.compress(b"{}")[:-10]}),
        (None, {"events.xz": b"not xz"}),
        (None, {"events.xz": lzma.compress(b"[" * 100_000)}),
        (None, {"events.xz": bytes(LARGEST_FILE + 1)}),
        (b"{}", None),
        (b"[]", None),
        (b'{"metadataTypes": [{}]}', None),
        (b'{"metadataTypes": [{"type": 4}]}', None),
        (b'{"metadataTypes": [{"type": 4, "uri": 5, "fileCrc": 1}]}', None),
        (b'{"metadataTypes": [{"type": 4, "uri": "http://x", "fileCrc": 1}]}', None),
        (b'{"metadataTypes": ' + b"[" * 5000, None),
    ],
)
async def test_unusable_metadata_leaves_numbers_and_one_line(
    cached: Callable[[], list[Path]],
    caplog: pytest.LogCaptureFixture,
    general: bytes | None,
    changed: Mapping[str, bytes] | None,
) -> None:
    await assert_unusable(AutopilotWithMetadata(general=general, changed=changed), caplog)


@cache
def bomb() -> bytes:
    return lzma.compress(b" " * (200 * 1024 * 1024), preset=1)


@pytest.mark.parametrize("name", ["events.xz", "general.xz"])
async def test_compressed_file_of_200_mb_is_unusable_metadata(
    name: str, cached: Callable[[], list[Path]], caplog: pytest.LogCaptureFixture
) -> None:
    await assert_unusable(AutopilotWithMetadata(changed={name: bomb()}), caplog)
