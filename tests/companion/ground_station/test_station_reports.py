"""STATUSTEXT and ONBOARD_COMPUTER_STATUS."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station.reports import ComputerStatus, StatusTexts, chunks_of, reported_losses
from tests.companion.ground_station.station_harness import S, received


def texts_of(texts: StatusTexts, now_ns: int) -> list[str]:
    whole: list[str] = []
    for message in map(received, texts.due(now_ns)):
        whole = [*whole[:-1], whole[-1] + message.text] if message.chunk_seq else [*whole, message.text]
    return whole


def test_only_warnings_and_errors_are_sent() -> None:
    texts = StatusTexts()
    for level in ("info", "warning", "error", "debug"):
        texts.on_event(level, level, 9 * S, 10 * S)
    sent = [received(message) for message in texts.due(10 * S)]
    assert [(each.severity, each.text) for each in sent] == [
        (mavlink.MAV_SEVERITY_WARNING, "warning"),
        (mavlink.MAV_SEVERITY_ERROR, "error"),
    ]


def test_old_events_and_lines_of_its_own_are_not_sent() -> None:
    texts = StatusTexts()
    texts.on_event("warning", "of before the start", 10 * S, 100 * S)
    texts.on_event("warning", "ground_station: said directly", 100 * S, 100 * S)
    texts.on_event("warning", "autopilot: said by itself", 100 * S, 100 * S)
    texts.on_event("warning", "select x=0.1 y=0.1: its click says why", 100 * S, 100 * S)
    assert texts_of(texts, 100 * S) == []


def test_five_at_once_then_one_a_second_and_the_rest_is_counted() -> None:
    texts = StatusTexts()
    for number in range(40):
        texts.add(mavlink.MAV_SEVERITY_WARNING, f"text {number}", 100 * S)
    assert len(texts_of(texts, 100 * S)) == 5
    sent = sum(len(texts_of(texts, 100 * S + tick * S // 20)) for tick in range(1, 200))
    assert sent == 9
    assert texts.lost == 20


def test_losses_are_said_every_ten_seconds_if_there_are_more() -> None:
    counts, lines = {"lost": 0, "late": 0}, list[str]()
    due = reported_losses({what: partial(counts.__getitem__, what) for what in counts}, lines.append)
    for second, lost in ((0, 2), (5, 5), (9, 6), (10, 7), (20, 7)):
        counts["lost"] = lost
        assert due(second * S) == []
    assert lines == ["2 lost", "5 lost"]


def test_same_text_is_sent_every_ten_seconds() -> None:
    texts, sent = StatusTexts(), 0
    for second in range(100, 130):
        texts.add(mavlink.MAV_SEVERITY_WARNING, "no camera", second * S)
        sent += len(texts_of(texts, second * S))
    assert sent == 3


def test_text_above_50_bytes_is_chunked() -> None:
    texts = StatusTexts()
    texts.add(mavlink.MAV_SEVERITY_WARNING, "x" * 120, 100 * S)
    texts.add(mavlink.MAV_SEVERITY_WARNING, "y" * 100, 100 * S)
    sent = [received(message) for message in texts.due(100 * S)]
    assert [(each.id, each.chunk_seq, len(each.text)) for each in sent] == [
        (1, 0, 50),
        (1, 1, 50),
        (1, 2, 20),
        (2, 0, 50),
        (2, 1, 50),
        (2, 2, 0),  # the last chunk has a final zero
    ]


@given(st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\0")))
def test_chunks_have_whole_characters_and_the_text(text: str) -> None:
    chunks = chunks_of(text)
    assert all(len(chunk) <= 50 for chunk in chunks)
    joined = "".join(chunk.decode() for chunk in chunks)
    assert " ".join(text.split()).startswith(joined)
    assert len(joined.encode()) > 396 or joined == " ".join(text.split())


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "proc").mkdir()
    zone = tmp_path / "sys/class/thermal/thermal_zone0"
    zone.mkdir(parents=True)
    (zone / "temp").write_text("48250\n")
    (tmp_path / "proc/meminfo").write_text("MemTotal: 4194304 kB\nMemAvailable: 1048576 kB\n")
    return tmp_path


def write_times(root: Path, *cores: tuple[int, int]) -> None:
    lines = ["cpu 0 0 0 0 0 0 0 0 0 0"]
    lines += [f"cpu{number} {busy} 0 0 {idle} 0 0 0 0 0 0" for number, (busy, idle) in enumerate(cores)]
    (root / "proc/stat").write_text("\n".join([*lines, "intr 1"]))


def test_computer_status_once_a_second(root: Path) -> None:
    status = ComputerStatus(root, root)
    write_times(root, (100, 100), (100, 100))
    times = [tick for tick in range(60) if list(status.due(100 * S + tick * S // 20))]
    assert times == [0, 20, 40]
    write_times(root, (150, 150), (200, 100))
    (message,) = map(received, status.due(104 * S))
    assert message.cpu_cores[:3] == [50, 100, 255]
    assert (message.ram_total, message.ram_usage) == (4096, 3072)
    assert message.temperature_board == 48
    assert message.storage_total[0] > 0


def test_computer_that_says_nothing_is_unknown(tmp_path: Path) -> None:
    (message,) = map(received, ComputerStatus(tmp_path / "missing", tmp_path).due(100 * S))
    assert set(message.cpu_cores) == {255}
    assert message.temperature_board == 127
    assert message.ram_total == message.storage_total[0] == 2**32 - 1
