"""PX4's log in a recording: the same clock, every value, and no log of another flight."""

from __future__ import annotations

import itertools
import json
import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from companion.recording import RecordingError
from companion.recording.boot_clock import Boot, BootClock, align
from companion.recording.files import RecordingReader
from companion.recording.ulog import merge_ulog
from tests.companion.command_line import companion_here
from tests.companion.recording.test_recorded_service import schema_errors
from tests.companion.recording.ulog_flight import (
    Flight,
    link_pieces,
    ulog_of,
    write_recording,
    write_ulog,
)

MIXED = (
    "uint64_t timestamp;double lat;float[3] v;part[2] parts;part one;char[8] text;int8_t small;"
    "uint8_t[2] _padding0;"
)


def bodies(path: Path, topic: str) -> list[tuple[int, Any]]:
    return [
        (message.log_time_ns, json.loads(message.data)) for message in RecordingReader(path).messages(topic)
    ]


@pytest.mark.parametrize(
    "flight",
    [
        Flight(1),
        Flight(3, booted_s=90_000.0, drift=-80e-6, delay_s=0.003, seconds=120.0),
    ],
    ids=["short", "drift and slow link"],
)
def test_clocks_are_aligned_within_the_stated_error(flight: Flight, tmp_path: Path) -> None:
    path, offset_ns = write_recording(tmp_path, link_pieces(flight))
    write_ulog(tmp_path / "a.ulg", flight, 10.0, flight.seconds - 5)
    merged = merge_ulog(path, tmp_path / "a.ulg", tmp_path / "b.mcap")
    found = bodies(tmp_path / "b.mcap", "ulog/vehicle_attitude")
    assert len(found) > 800
    errors = [log_ns - (flight.now_ns(body["timestamp"]) + offset_ns) for log_ns, body in found]
    assert max(map(abs, errors)) <= min(5e6, merged.alignment.error_ns)
    assert merged.alignment.error_ns <= 3e6 + flight.delay_s * 1e9
    assert merged.alignment.least_delay_ns > flight.delay_s * 1e9 - merged.alignment.error_ns - 1e6
    assert 1 + merged.alignment.drift == pytest.approx(1 / (1 + flight.drift), abs=40e-6)


def test_error_grows_outside_of_the_answers(tmp_path: Path) -> None:
    flight = Flight(4, seconds=400.0)
    pieces = link_pieces(flight)
    path, offset_ns = write_recording(tmp_path, [piece for piece in pieces if piece.stamp_ns > 800e9])
    write_ulog(tmp_path / "a.ulg", flight, 10.0, 390.0)
    merged = merge_ulog(path, tmp_path / "a.ulg", tmp_path / "b.mcap")
    errors = [
        abs(log_ns - (flight.now_ns(body["timestamp"]) + offset_ns))
        for log_ns, body in bodies(tmp_path / "b.mcap", "ulog/vehicle_attitude")
    ]
    # 290 s before the first answer, by a clock that is fast by 60 ppm.
    assert 10e6 < max(errors) <= merged.alignment.error_ns < 40e6


def test_answers_that_contradict_the_lines_widen_the_error() -> None:
    second, steps_ns = 10**9, [0, 0, 4_000_000, 0, 0]
    answers = [(at * second, 10**18 + step, 200_000 + at) for at, step in enumerate(steps_ns)]
    clock = BootClock(answers, 10 * second)  # the first is used
    assert clock.error_ns(0, 4 * second) == 200_000 + 4_000_000 - 200_002
    assert clock.error_ns(0, second // 2) == 200_000
    assert clock.to_unix(np.array([2 * second])).tolist() == [10**18 + 2 * second]
    every = BootClock(answers, 1)
    assert every.error_ns(0, 4 * second) == 200_004
    assert every.to_unix(np.array([2 * second, second // 2])).tolist() == [
        10**18 + 2 * second + 4_000_000,
        10**18 + second // 2,
    ]


@pytest.mark.parametrize(
    ("early_ns", "error_ns"), [(0, 200_000), (150_000, 200_000), (30_000_000, 30_200_000)]
)
def test_sample_that_arrives_before_its_stamp_widens_the_error(early_ns: int, error_ns: int) -> None:
    boot = Boot([(at * 500_000_000, 10**18, 200_000) for at in range(10)])
    samples = [struct.pack("<I4f", 500 * at + 250, *[at] * 4) for at in range(9)]
    boot.samples[31] = [
        (10**18 + (500 * at + 250) * 1_000_000 - (early_ns if at == 5 else -1_000_000), sample)
        for at, sample in enumerate(samples)
    ]
    found = align([boot], 0, 4_000_000_000, {31: set(samples), 32: set()})
    assert (found.error_ns, found.equal) == (error_ns, 9)
    assert (found.least_delay_ns, found.median_delay_ns) == (-early_ns, 1_000_000)


def test_every_type_of_value_is_json_by_its_schema(tmp_path: Path) -> None:
    flight = Flight(5)
    path, _ = write_recording(tmp_path, link_pieces(flight))
    ulog = ulog_of(flight, 10.0, 50.0, part="float x;bool on;", mixed=MIXED)
    numbers = [ulog.subscribe("mixed"), ulog.subscribe("mixed", 2)]
    stamp_us = flight.boot_us(530e9)
    for number in numbers:
        ulog.add(
            number,
            struct.pack(
                "<Qd3ff?f?f?8sb",
                stamp_us,
                47.123456789012,
                0.1,
                math.nan,
                math.inf,
                1.5,
                True,
                -2.0,
                False,
                3.0,
                True,
                b"abc",
                -7,
            ),
        )
    # Written when the log began, long after its own stamp.
    ulog.add(numbers[0], struct.pack("<Qd3ff?f?f?8sb", 1, *[0.0] * 5, False, 0.0, False, 0.0, False, b"", 0))
    ulog.gap(20)
    (tmp_path / "c.ulg").write_bytes(ulog.data)
    merged = merge_ulog(path, tmp_path / "c.ulg", tmp_path / "out.mcap")
    assert merged.topics == 3
    (gap,) = merged.problems
    assert "20 ms" in gap
    expected = {
        "timestamp": stamp_us,
        "lat": 47.123456789012,
        "v": [0.1, None, None],
        "parts": [{"x": 1.5, "on": True}, {"x": -2.0, "on": False}],
        "one": {"x": 3.0, "on": True},
        "text": "abc",
        "small": -7,
    }
    early, (_, first) = sorted(bodies(tmp_path / "out.mcap", "ulog/mixed"), key=lambda each: each[0])
    ((_, second),) = bodies(tmp_path / "out.mcap", "ulog/mixed_2")
    assert first == second == expected
    assert early[1]["timestamp"] == 1
    begin_ns = bodies(tmp_path / "out.mcap", "ulog/vehicle_attitude")[0][0]
    assert abs(early[0] - begin_ns) < 10_000_000
    assert schema_errors(tmp_path / "out.mcap") == []


def test_merged_file_has_the_recording_the_log_and_the_clock(tmp_path: Path) -> None:
    flight = Flight(6)
    path, _ = write_recording(tmp_path, link_pieces(flight))
    write_ulog(tmp_path / "a.ulg", flight, 10.0, 50.0)
    done = companion_here("log", "ulog", path, "a.ulg", "-o", "out.mcap", cwd=tmp_path)
    assert (done.returncode, done.stderr, len(done.stdout.splitlines())) == (0, "", 3)
    with (tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file)
        (metadata,) = reader.iter_metadata()
        times = [message.log_time for _, _, message in reader.iter_messages(log_time_order=False)]
    assert metadata.name == "ulog/a.ulg"
    assert 0 < int(metadata.metadata["error_ns"]) < 5_000_000
    assert f"{int(metadata.metadata['error_ns']) / 1e6:.2f} ms" in done.stdout
    assert int(metadata.metadata["boot_begin_ns"]) == flight.boot_us(510e9) * 1000
    assert max(old - new for old, new in itertools.pairwise(times)) < 1_000_000_000
    original = list(RecordingReader(path).messages())
    copied = list(RecordingReader(tmp_path / "out.mcap").messages(*{each.channel.topic for each in original}))
    assert copied == original
    ((_, entry),) = bodies(tmp_path / "out.mcap", "/log")
    assert (entry["level"], entry["message"], entry["name"]) == (3, "high wind", "ulog")
    shown = json.loads(companion_here("log", "show", "out.mcap", "--json", cwd=tmp_path).stdout)
    assert [(line["kind"], line["text"]) for line in shown["lines"]] == [("ulog", "high wind")]
    assert shown["metadata"] == {metadata.name: metadata.metadata}
    companion_here("log", "recover", "out.mcap", "again.mcap", cwd=tmp_path)
    assert (tmp_path / "again.mcap").read_bytes() == (tmp_path / "out.mcap").read_bytes()


def test_log_of_another_boot_or_time_is_refused(tmp_path: Path) -> None:
    flight = Flight(7)
    path, _ = write_recording(tmp_path, link_pieces(flight))
    write_ulog(tmp_path / "other.ulg", replace(flight, seed=8), 10.0, 50.0)
    write_ulog(tmp_path / "later.ulg", replace(flight, seconds=400.0), 300.0, 390.0)
    for name, word in (("other.ulg", "0 samples"), ("later.ulg", "boot time 340.0 to 430.0 s")):
        done = companion_here("log", "ulog", path, name, "-o", "out.mcap", cwd=tmp_path)
        assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
        assert f"{name}: another flight" in done.stderr
        assert word in done.stderr
        assert not (tmp_path / "out.mcap").exists()


def test_boot_of_the_log_is_found_after_a_restart(tmp_path: Path) -> None:
    first = Flight(9)
    second = Flight(10, booted_s=-50.0)  # restarted 50 s after the recording began
    pieces = link_pieces(first)
    later = [
        piece._replace(stamp_ns=piece.stamp_ns + 60_000_000_000)
        for piece in link_pieces(replace(second, booted_s=10.0))
    ]
    path, offset_ns = write_recording(tmp_path, [*pieces, *later])
    for name, flight, shift_ns in (("a", first, 0), ("b", replace(second, booted_s=10.0), 60_000_000_000)):
        write_ulog(tmp_path / f"{name}.ulg", flight, 15.0, 50.0)
        merge_ulog(path, tmp_path / f"{name}.ulg", tmp_path / f"{name}.mcap")
        for log_ns, body in bodies(tmp_path / f"{name}.mcap", "ulog/vehicle_attitude"):
            assert abs(log_ns - flight.now_ns(body["timestamp"]) - shift_ns - offset_ns) < 5e6


def test_recording_without_answers_is_refused(tmp_path: Path) -> None:
    flight = Flight(11, seconds=20.0)
    path, _ = write_recording(tmp_path, link_pieces(flight, answers=False))
    write_ulog(tmp_path / "a.ulg", flight, 5.0, 15.0)
    with pytest.raises(RecordingError, match="TIMESYNC"):
        merge_ulog(path, tmp_path / "a.ulg", tmp_path / "out.mcap")


def test_cut_ulog_is_read_up_to_the_cut_and_others_are_refused(tmp_path: Path) -> None:
    flight = Flight(12)
    path, _ = write_recording(tmp_path, link_pieces(flight))
    write_ulog(tmp_path / "a.ulg", flight, 10.0, 50.0)
    content = (tmp_path / "a.ulg").read_bytes()
    (tmp_path / "cut.ulg").write_bytes(content[: len(content) // 2])
    merge_ulog(path, tmp_path / "cut.ulg", tmp_path / "cut.mcap")
    assert 200 < len(bodies(tmp_path / "cut.mcap", "ulog/vehicle_attitude")) < 500
    damaged = bytearray(content)
    damaged[9000:9100] = bytes(100)
    (tmp_path / "damaged.ulg").write_bytes(damaged)
    merged = merge_ulog(path, tmp_path / "damaged.ulg", tmp_path / "damaged.mcap")
    assert [problem for problem in merged.problems if "damaged.ulg" in problem]
    for name, text in {"empty.ulg": b"", "other.ulg": b"#!/bin/sh\n" * 9, "head.ulg": content[:200]}.items():
        (tmp_path / name).write_bytes(text)
        with pytest.raises(RecordingError, match=name):
            merge_ulog(path, tmp_path / name, tmp_path / "out.mcap")
    with pytest.raises(RecordingError, match=r"none\.ulg"):
        merge_ulog(path, tmp_path / "none.ulg", tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()
