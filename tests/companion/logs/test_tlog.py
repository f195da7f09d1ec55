"""The recorded MAVLink as a .tlog: pymavlink reads the same messages at the same times."""

from __future__ import annotations

import os
import random
import struct
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common

from companion.logs.tlog import link_frames, write_tlog
from companion.recording.convert import RECEIVED_CHANNEL, SENT_CHANNEL
from companion.recording.files import Channel, RecordingReader
from tests.companion.command_line import companion_here
from tests.companion.recording.lockstep_recording import new_writer

DATA = Path(os.environ.get("COMPANION_TEST_DATA", Path(__file__).parents[4] / "shared" / "data"))
PX4_TLOG = DATA / "px4" / "px4_sih_offboard_flight.tlog"
RECEIVED, SENT = (Channel(topic, encoding="mavlink") for topic in (RECEIVED_CHANNEL, SENT_CHANNEL))
BEGIN_NS = 1_764_080_000_000_000_777


def messages(count: int, seed: int) -> list[bytes]:
    """Frames of several types and lengths; the system's number is the seed."""
    mav, rng = common.MAVLink(None, srcSystem=seed, srcComponent=1), random.Random(seed)
    made = []
    for number in range(count):
        values = [rng.uniform(-3, 3) for _ in range(6)]
        choices: list[Any] = [
            mav.attitude_encode(number, *values),
            mav.statustext_encode(6, b"a" * rng.randrange(1, 50)),
            mav.ping_encode(number, 0, 0, 0),
        ]
        made.append(bytes(rng.choice(choices).pack(mav)))
    return made


def record(folder: Path, pieces: list[tuple[Channel, int, bytes]]) -> Path:
    writer = new_writer(folder)
    for piece in pieces:
        writer.write(*piece)
    writer.close()
    return writer.path


def read_with_pymavlink(path: Path) -> list[tuple[int, bytes]]:
    """(microseconds, frame) of each message."""
    log, found = mavutil.mavlogfile(str(path)), []
    while (message := log.recv_msg()) is not None:
        assert message.get_type() != "BAD_DATA"
        found.append((round(message._timestamp * 1e6), bytes(message.get_msgbuf())))
    log.close()
    return found


def test_datagrams_of_both_directions_are_in_order_of_time(tmp_path: Path) -> None:
    frames = messages(200, 7)
    pieces = [
        (SENT if number % 3 == 0 else RECEIVED, BEGIN_NS + number * 1_234_567, frame)
        for number, frame in enumerate(frames)
    ]
    done = companion_here("log", "convert", record(tmp_path, pieces), tmp_path / "out.tlog", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    found = read_with_pymavlink(tmp_path / "out.tlog")
    assert [frame for _, frame in found] == frames
    # A double holds Unix time to 0.24 us.
    assert all(
        abs(us - stamp_ns / 1000) <= 1 for (us, _), (_, stamp_ns, _) in zip(found, pieces, strict=True)
    )


def test_frame_across_reads_of_a_serial_link_has_the_last_time(tmp_path: Path) -> None:
    rng = random.Random(11)
    streams = {RECEIVED: messages(300, 1), SENT: messages(300, 2)}
    pieces: list[tuple[Channel, int, bytes]] = []
    ends: list[tuple[int, bytes]] = []
    rest = {channel: b"".join(frames) for channel, frames in streams.items()}
    offsets = dict.fromkeys(streams, 0)
    due = {channel: list(frames) for channel, frames in streams.items()}
    while any(rest.values()):
        channel = rng.choice([channel for channel in rest if rest[channel]])
        piece = rest[channel][: rng.randrange(1, 60)]
        stamp_ns = BEGIN_NS + len(pieces) * 1_000_000
        pieces.append((channel, stamp_ns, piece))
        rest[channel] = rest[channel][len(piece) :]
        offsets[channel] += len(piece)
        while due[channel] and offsets[channel] >= len(due[channel][0]):
            offsets[channel] -= len(due[channel][0])
            ends.append((stamp_ns // 1000, due[channel].pop(0)))
    write_tlog(record(tmp_path, pieces), tmp_path / "out.tlog")
    found = read_with_pymavlink(tmp_path / "out.tlog")
    assert [frame for _, frame in found] == [frame for _, frame in ends]
    assert all(abs(us - end_us) <= 1 for (us, _), (end_us, _) in zip(found, ends, strict=True))


def test_cut_frame_and_noise_cost_only_themselves(tmp_path: Path) -> None:
    frames = messages(40, 3)
    data = [frame[:-4] if number == 20 else frame for number, frame in enumerate(frames)]
    data[30:30] = [b"\xfd\xff noise"]
    path = record(tmp_path, [(RECEIVED, BEGIN_NS + number, each) for number, each in enumerate(data)])
    assert [frame.raw for _, _, frame in link_frames(RecordingReader(path))] == frames[:20] + frames[21:]


@pytest.mark.skipif(not PX4_TLOG.is_file(), reason=f"{PX4_TLOG} is not here; set COMPANION_TEST_DATA")
def test_tlog_of_a_px4_flight_is_written_as_it_was(tmp_path: Path) -> None:
    content, at, pieces = PX4_TLOG.read_bytes(), 0, []
    while at < len(content):
        (stamp_us,) = struct.unpack_from(">Q", content, at)
        length = content[at + 9] + 12 + 13 * (content[at + 10] & 1)
        pieces.append((RECEIVED, stamp_us * 1000, content[at + 8 : at + 8 + length]))
        at += 8 + length
    write_tlog(record(tmp_path, pieces), tmp_path / "out.tlog")
    assert (tmp_path / "out.tlog").read_bytes() == content
    assert len(pieces) > 10_000


def test_output_is_never_overwritten(tmp_path: Path) -> None:
    path = record(tmp_path, [(SENT, BEGIN_NS, messages(1, 1)[0])])
    assert companion_here("log", "convert", path, path.with_suffix(".tlog"), cwd=tmp_path).returncode == 0
    content = path.with_suffix(".tlog").read_bytes()
    again = companion_here("log", "convert", path, path.with_suffix(".tlog"), cwd=tmp_path)
    assert (again.returncode, len(again.stderr.splitlines())) == (2, 1)
    assert str(path.with_suffix(".tlog")) in again.stderr
    assert path.with_suffix(".tlog").read_bytes() == content


def test_recording_without_mavlink_is_refused(tmp_path: Path) -> None:
    path = record(tmp_path, [(Channel("events"), BEGIN_NS, b"{}")])
    done = companion_here("log", "convert", path, path.with_suffix(".tlog"), cwd=tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert not path.with_suffix(".tlog").exists()
