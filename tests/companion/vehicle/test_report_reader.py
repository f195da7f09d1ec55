"""STATUSTEXT, EVENT and MAVLink FTP at the lowest layer: frames in, reports and requests out."""

import asyncio
import struct
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.file_reader import FileReader, FileReadError
from companion.vehicle.framing import (
    CURRENT_EVENT_SEQUENCE_ID,
    EVENT_ID,
    REQUEST_EVENT_ID,
    Frame,
    frames_of,
    pack_frame,
)
from companion.vehicle.report import Report
from companion.vehicle.report_reader import ReportReader
from companion.vehicle.status_texts import StatusTexts
from companion.vehicle.telemetry_state import TelemetryState


def frame(message_id: int, payload: bytes) -> Frame:
    packed = pack_frame(message_id, payload, system_id=1, component_id=1, sequence=0)
    (read,) = frames_of(packed)
    return read


def text(words: bytes, identifier: int = 0, chunk: int = 0, severity: int = 2) -> Frame:
    payload = struct.pack("<B50sHB", severity, words, identifier, chunk)
    return frame(mavlink.MAVLINK_MSG_ID_STATUSTEXT, payload)


def event(sequence: int, identifier: int = 0x01000005) -> Frame:
    return frame(EVENT_ID, struct.pack("<IIHBBB40s", identifier, 0, sequence, 0, 0, 0x62, bytes(40)))


def test_a_short_text_is_told_at_once_without_its_tab() -> None:
    assert StatusTexts().take(text(b"Arm: Need Position Estimate\t"), 7) == Report(
        7, 2, "Arm: Need Position Estimate"
    )
    assert StatusTexts().take(text(b"\t"), 7) is None


def test_a_fence_breach_that_is_only_a_notice_is_a_warning() -> None:
    report = StatusTexts().take(text(b"Circle fence breached", severity=5), 7)
    assert report == Report(7, 4, "Circle fence breached")


def test_a_long_text_is_put_together() -> None:
    texts, words = StatusTexts(), b"x" * 50 + b"y" * 50 + b"z"
    assert texts.take(text(words[:50], 4, 0), 1) is None
    assert texts.take(text(words[50:100], 4, 1), 2) is None
    whole = texts.take(text(words[100:], 4, 2), 3)
    assert whole is not None
    assert whole.text == words.decode()


def test_a_text_whose_chunk_was_lost_does_not_become_another() -> None:
    texts = StatusTexts()
    assert texts.take(text(b"a" * 50, 4, 0), 1) is None
    assert texts.take(text(b"c", 4, 2), 2) is None
    assert texts.take(text(b"b" * 50, 5, 0), 3) is None
    told = texts.take(text(b"!", 5, 1), 4)
    assert told is not None
    assert told.text == "b" * 50 + "!"


class Autopilot:
    """Serves one file by MAVLink FTP to a reader, losing every `loses`-th answer.

    Attributes:
        asked: (message id, payload) of everything it was sent.
    """

    def __init__(self, content: bytes = b"", loses: int = 0) -> None:
        self.asked: list[tuple[int, bytes]] = []
        self._content, self._loses = content, loses
        self.reader = FileReader(self.send, lambda: (1, 1))

    def send(self, message_id: int, payload: bytes) -> None:
        self.asked.append((message_id, payload))
        if self._loses and len(self.asked) % self._loses == 0:
            return
        sequence, session, opcode, size, _, _, _, offset = struct.unpack_from("<HBBBBBBI", payload, 3)
        data, answer = b"", 128
        if opcode == 4:
            known = payload[15 : 15 + size] == b"etc/a.json"
            data, answer = (struct.pack("<I", len(self._content)), 128) if known else (b"\x0a", 129)
        elif opcode == 5:
            data = self._content[offset : offset + size]
        header = struct.pack(
            "<3BHBBBBBBI", 0, 1, 191, sequence + 1, session, answer, len(data), opcode, 0, 0, offset
        )
        answered = frame(110, (header + data).ljust(254, b"\0"))
        asyncio.get_running_loop().call_soon(self.reader.take, answered)


@pytest.mark.parametrize(("size", "loses"), [(0, 0), (1, 0), (239, 0), (240, 0), (2000, 0), (2000, 4)])
async def test_a_file_is_read_whole_also_when_answers_are_lost(
    size: int, loses: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.vehicle.file_reader._ATTEMPT_S", 0.02)
    content = bytes(number % 251 for number in range(size))
    assert await Autopilot(content, loses).reader.read("etc/a.json") == content


async def test_a_file_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.vehicle.file_reader._ATTEMPT_S", 0.01)
    with pytest.raises(FileReadError, match=r"etc/b\.json: no such file"):
        await Autopilot().reader.read("etc/b.json")
    with pytest.raises(FileReadError, match="does not answer by MAVLink FTP"):
        await FileReader(lambda *_: None, lambda: (1, 1)).read("etc/b.json")


class Link:
    """A reader of reports whose autopilot accepts everything and tells no metadata."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.heard = TelemetryState("udpin://test", lambda: None)
        self.reader = ReportReader("udpin://test", self.heard, self.send, self.command, lambda: (1, 1))

    def send(self, message_id: int, payload: bytes) -> None:
        self.sent.append((message_id, payload))

    async def command(self, *_: float) -> int:
        return 0

    @property
    def missed(self) -> list[tuple[int, int]]:
        asked = [payload for number, payload in self.sent if number == REQUEST_EVENT_ID]
        return [struct.unpack_from("<HH", payload) for payload in asked]


async def test_a_lost_event_is_asked_for_and_what_was_before_us_is_not() -> None:
    link = Link()
    link.reader.take(event(65533))
    link.reader.take(event(65534))
    assert link.missed == []
    link.reader.take(event(2))
    assert link.missed == [(65535, 1)]
    link.reader.take(frame(CURRENT_EVENT_SEQUENCE_ID, struct.pack("<HB", 2, 0)))
    assert link.missed == [(65535, 1)]
    link.reader.take(frame(CURRENT_EVENT_SEQUENCE_ID, struct.pack("<HB", 4, 0)))
    assert link.missed == [(65535, 1), (3, 4)]


async def test_events_that_come_before_their_words_wait_for_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("companion.vehicle.report_reader._METADATA_S", 0.02)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    link = Link()
    link.reader.take(event(1))
    assert link.heard.state.reports == ()
    await link.reader.learn_events()
    assert "events have no words: it tells no COMPONENT_METADATA" in caplog.text
    reports: tuple[Report, ...] = link.heard.state.reports
    assert [told.text for told in reports] == ["event 0x01000005, which its metadata does not name"]
