"""MCAP files: complete, cut anywhere, damaged, limited in size, and on a full disk."""

from __future__ import annotations

import os
import random
import re
import resource
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from companion.recording import RecordingError
from companion.recording.files import Channel, RecordingReader, recover
from tests.companion.recording.lockstep_recording import library_times, new_writer
from vision.video_writer import VideoWriter

NUMBERS = Channel("numbers", "companion.numbers", b'{"type":"object"}')
RAW = Channel("raw", encoding="mavlink")
CHUNKS, PER_CHUNK = 12, 20


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of `CHUNKS` chunks; message n has log time n."""
    rng = random.Random(1)
    writer = new_writer(tmp_path_factory.mktemp("whole"))
    for chunk in range(CHUNKS):
        for index in range(PER_CHUNK):
            number = chunk * PER_CHUNK + index
            writer.write(RAW if number % 2 else NUMBERS, number, rng.randbytes(rng.randrange(200)))
        writer.flush()
    writer.close()
    return writer.path


def times(path: Path) -> list[int]:
    return [message.log_time_ns for message in RecordingReader(path).messages()]


def chunk_ends(path: Path) -> list[int]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [index.chunk_start_offset + index.chunk_length for index in summary.chunk_indexes]


def test_library_reads_a_complete_file(whole: Path) -> None:
    with whole.open("rb") as file:
        found = [message.log_time for _, _, message in make_reader(file).iter_messages()]
    assert found == times(whole) == list(range(CHUNKS * PER_CHUNK))
    assert RecordingReader(whole).problems == []


def test_one_topic_is_read(whole: Path) -> None:
    found = list(RecordingReader(whole).messages("numbers"))
    assert {message.channel for message in found} == {NUMBERS}
    assert [message.log_time_ns for message in found] == list(range(0, CHUNKS * PER_CHUNK, 2))


def test_every_whole_chunk_of_a_cut_file_is_read(whole: Path, tmp_path: Path) -> None:
    content, ends = whole.read_bytes(), chunk_ends(whole)
    rng = random.Random(2)
    for at in [*rng.sample(range(8, len(content)), 50), ends[0] - 1, ends[0]]:
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(content[:at])
        reader = RecordingReader(cut)
        found = [message.log_time_ns for message in reader.messages()]
        assert found == list(range(PER_CHUNK * sum(end <= at for end in ends)))
        assert library_times(cut) == found
        # Beyond the last chunk and its index only the summary is missing.
        assert reader.problems or at > ends[-1]


def test_damaged_chunk_is_left_out(whole: Path, tmp_path: Path) -> None:
    content, ends = bytearray(whole.read_bytes()), chunk_ends(whole)
    content[ends[3] - 20] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(content)
    reader = RecordingReader(damaged)
    found = [message.log_time_ns for message in reader.messages()]
    assert found == [time for time in range(CHUNKS * PER_CHUNK) if time // PER_CHUNK != 3]
    assert len(reader.problems) == 1


def test_recovered_file_is_complete(whole: Path, tmp_path: Path) -> None:
    cut, output = tmp_path / "cut.mcap", tmp_path / "recovered.mcap"
    cut.write_bytes(whole.read_bytes()[: chunk_ends(whole)[4] + 1])
    problems, count = recover(cut, output)
    assert (len(problems), count) == (1, 5 * PER_CHUNK)
    with output.open("rb") as file:
        assert len(list(make_reader(file).iter_messages())) == count
    with pytest.raises(RecordingError):
        recover(cut, output)


def test_folder_inside_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="file"):
        new_writer(tmp_path / "file" / "folder")


def test_recordings_are_readable_by_their_owner_alone(tmp_path: Path, whole: Path) -> None:
    before = os.umask(0)
    try:
        writer = new_writer(tmp_path / "recordings")
        writer.begin_next()
        writer.close()
        recover(whole, tmp_path / "recovered.mcap")
        video = VideoWriter(tmp_path / "video.webm", 64, 48, 10.0)
        video.write(np.zeros((48, 64, 3), np.uint8), 0)
        video.close()
    finally:
        os.umask(before)
    made = [*(tmp_path / "recordings").iterdir(), tmp_path / "recovered.mcap", tmp_path / "video.webm"]
    assert len(made) == 4
    assert [path.stat().st_mode & 0o777 for path in made] == [0o600] * 4
    assert (tmp_path / "recordings").stat().st_mode & 0o777 == 0o700


def test_parts_begin_with_the_run_and_the_oldest_are_removed(tmp_path: Path) -> None:
    others = [tmp_path / "mine.mcap", tmp_path / "notes.txt"]
    for other in others:
        other.write_bytes(bytes(200_000))
        os.utime(other, (0, 0))
    writer = new_writer(tmp_path, max_bytes=50_000, max_total_bytes=120_000)
    run = Channel("run", "companion.run", b"{}")
    writer.begins["run"] = first = next(iter([(run, 7, b'{"run":1}')]))  # type: ignore[assignment]
    writer.write(*first)
    rng = random.Random(3)
    for number in range(20):
        writer.write(RAW, number, rng.randbytes(30_000))
        writer.flush()
    writer.close()
    parts = sorted(path for path in tmp_path.glob("vehicle1_*.mcap"))
    assert all(other.exists() for other in others)
    assert [path.name[-10:-5] for path in parts] == ["00009", "00010"][-len(parts) :]
    assert sum(path.stat().st_size for path in parts) <= 120_000
    for path in parts:
        messages = list(RecordingReader(path).messages())
        assert (messages[0].channel, messages[0].data) == (run, b'{"run":1}')


def test_part_ends_at_its_largest_duration(tmp_path: Path) -> None:
    writer = new_writer(tmp_path, max_duration_s=0.0)
    for number in range(3):
        writer.write(RAW, number, b"x")
        writer.flush()
    writer.close()
    assert len(list(tmp_path.iterdir())) == 4


def test_recorders_of_one_second_write_different_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "strftime", lambda *_: "20261125T141512Z")
    writers = [new_writer(tmp_path) for _ in range(3)]
    for part in range(2):
        for number, writer in enumerate(writers):
            writer.write(RAW, 10 * part + number, b"x")
            if part == 0:
                writer.begin_next()
    for writer in writers:
        writer.close()
    found = {path.name: times(path) for path in tmp_path.iterdir()}
    assert found == {
        f"vehicle1_20261125T141512Z{mark}_0000{part}.mcap": [10 * part + number]
        for number, mark in enumerate(("", "-2", "-3"))
        for part in range(2)
    }
    # All are known as recordings: of three limits' worth, the current file is left.
    writer = new_writer(tmp_path, max_total_bytes=1)
    writer.flush()
    assert list(tmp_path.iterdir()) == [writer.path]


def test_names_of_more_than_999_parts_are_in_order(tmp_path: Path) -> None:
    writer = new_writer(tmp_path)
    paths = []
    for writer._part in (8, 98, 998, 9998):
        writer.begin_next()
        paths.append(writer.path)
    writer.close()
    assert sorted(paths) == paths


def test_full_disk_leaves_a_file_of_whole_chunks(tmp_path: Path) -> None:
    """The limit of a file's size stands for a full disk: the same write fails, with EFBIG for ENOSPC."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handled = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    writer, rng, flushed = new_writer(tmp_path), random.Random(4), 0

    def flush_until_it_fails() -> None:
        nonlocal flushed
        while flushed < 100:
            writer.write(RAW, flushed, rng.randbytes(9_000))
            writer.flush()
            flushed += 1

    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        with pytest.raises(RecordingError, match=re.escape(str(writer.path))):
            flush_until_it_fails()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handled)
    assert 5 < flushed < 12
    assert times(writer.path) == list(range(flushed))
    assert writer.path.stat().st_size == chunk_end_of_last(writer.path)


def chunk_end_of_last(path: Path) -> int:
    """Where the last record ends: nothing of the failed write is left."""
    reader = RecordingReader(path)
    list(reader.messages())
    found = re.search(r"at byte (\d+)", reader.problems[0])
    assert found is not None
    return int(found[1])
