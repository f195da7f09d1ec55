"""Frames across processes: complete, newest first, and the death of writers."""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vision.camera_model import CameraCalibration, CameraModel, CameraMount, DistortionModel
from vision.frame import Frame
from vision.shared_frame import (
    SHARED_MEMORY_DIRECTORY,
    SharedFrameReader,
    SharedFrameWriter,
    remove_leavings,
    segment_path,
)

pytestmark = [
    pytest.mark.skipif(not SHARED_MEMORY_DIRECTORY.is_dir(), reason="needs Linux's /dev/shm"),
    pytest.mark.realtime,
]
DEADLINE_S = 60.0

STAMPING_WRITER = """
import sys, time
import numpy as np
from vision.frame import Frame
from vision.shared_frame import SharedFrameWriter
name, first, count, pause = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
writer = SharedFrameWriter(name, 320, 240, depth=True)
image, depth = np.empty((240, 320, 3), np.uint8), np.empty((240, 320), np.float32)
print("ready", flush=True)
for sequence in range(first, first + count):
    image[:] = sequence % 251
    depth[:] = sequence
    writer.write(Frame(image, sequence * 1000, sequence, depth))
    if pause:
        time.sleep(pause)
print("done", flush=True)
sys.stdin.read()
writer.close()
"""


@pytest.fixture
def name() -> Iterator[str]:
    chosen = f"test-frames-{os.getpid()}-{secrets.token_hex(4)}"
    yield chosen
    segment_path(chosen).unlink(missing_ok=True)


@pytest.fixture
def start_writer(name: str) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []

    def start(first: int, count: int, pause_s: float = 0.0) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", STAMPING_WRITER, name, str(first), str(count), str(pause_s)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline().strip() == "ready"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def frame(sequence: int, width: int = 16, height: int = 12, depth: bool = True) -> Frame:
    rng = np.random.default_rng(sequence)
    image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    plane = rng.random((height, width), dtype=np.float32) if depth else None
    return Frame(image, 10 + sequence, sequence, plane)


def same(one: Frame, other: Frame) -> bool:
    if one.depth_m is None or other.depth_m is None:
        depth = one.depth_m is other.depth_m
    else:
        depth = np.array_equal(one.depth_m, other.depth_m, equal_nan=True)
    stamps = (one.sequence, one.captured_ns) == (other.sequence, other.captured_ns)
    return stamps and depth and np.array_equal(one.image, other.image)


def wait_for(read: Callable[[], Frame | None]) -> Frame:
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        found = read()
        if found is not None:
            return found
        time.sleep(0.002)
    raise AssertionError(f"no frame within {DEADLINE_S} s")


@settings(max_examples=25, deadline=None)
@given(
    width=st.integers(1, 70), height=st.integers(1, 50), depth=st.booleans(), slots=st.integers(2, 6),
    count=st.integers(1, 15),
)  # fmt: skip
def test_newest_frame_is_read_unchanged(width: int, height: int, depth: bool, slots: int, count: int) -> None:
    name = f"test-frames-{os.getpid()}-{secrets.token_hex(4)}"
    with SharedFrameWriter(name, width, height, depth, slots) as writer, SharedFrameReader(name) as reader:
        assert reader.latest() is None
        for sequence in range(count):
            sent = frame(sequence, width, height, depth)
            writer.write(sent)
            got = reader.latest()
            assert got is not None
            assert same(got, sent)
        assert reader.latest(count - 1) is None
        assert reader.latest(count - 2) is not None
    assert not segment_path(name).exists()


def test_a_frame_read_is_a_copy_that_later_writes_do_not_touch(name: str) -> None:
    with SharedFrameWriter(name, 16, 12, True, 2) as writer, SharedFrameReader(name) as reader:
        writer.write(frame(0))
        got = reader.latest()
        for sequence in range(1, 9):
            writer.write(frame(sequence))
        assert got is not None
        assert same(got, frame(0))


def test_fast_writer_in_another_process_shows_no_torn_frame(
    name: str, start_writer: Callable[..., subprocess.Popen[str]]
) -> None:
    process = start_writer(0, 1500)
    last, seen = -1, 0
    with SharedFrameReader(name) as reader:
        while last < 1499:
            got = wait_for(partial(reader.latest, last))
            assert got.sequence > last
            assert got.captured_ns == got.sequence * 1000
            assert got.depth_m is not None
            assert int(got.image.min()) == int(got.image.max()) == got.sequence % 251
            assert float(got.depth_m.min()) == float(got.depth_m.max()) == got.sequence
            last, seen = got.sequence, seen + 1
    assert seen >= 2
    assert process.poll() is None


def test_many_threads_read_whole_frames_while_one_writes(name: str) -> None:
    problems: list[str] = []
    stop = threading.Event()

    def read() -> None:
        with SharedFrameReader(name) as reader:
            while not stop.is_set():
                got = reader.latest()
                if got is not None and (got.image != got.sequence % 251).any():
                    problems.append(f"frame {got.sequence} is torn")

    with SharedFrameWriter(name, 200, 150, False, 2) as writer:
        readers = [threading.Thread(target=read) for _ in range(3)]
        for thread in readers:
            thread.start()
        for sequence in range(800):
            image = np.full((150, 200, 3), sequence % 251, np.uint8)
            writer.write(Frame(image, sequence, sequence))
        stop.set()
        for thread in readers:
            thread.join(DEADLINE_S)
    assert problems == []


def test_a_reader_that_exits_leaves_the_segment(name: str) -> None:
    with SharedFrameWriter(name, 16, 12, True) as writer:
        writer.write(frame(4))
        script = (
            "import sys; from vision.shared_frame import SharedFrameReader;"
            "print(SharedFrameReader(sys.argv[1]).latest().sequence)"
        )
        done = subprocess.run(
            [sys.executable, "-c", script, name], capture_output=True, text=True, timeout=60, check=True
        )
        assert (done.stdout.strip(), done.stderr) == ("4", "")
        writer.write(frame(5))
        with SharedFrameReader(name) as reader:
            got = reader.latest()
            assert got is not None
            assert got.sequence == 5


def test_killed_writers_segment_is_replaced_and_followed(
    name: str, start_writer: Callable[..., subprocess.Popen[str]]
) -> None:
    first = start_writer(500, 3)
    with SharedFrameReader(name) as reader:
        last = wait_for(lambda: reader.latest(501))
        assert last.sequence == 502
        first.send_signal(signal.SIGKILL)
        first.wait(DEADLINE_S)
        assert segment_path(name).exists()
        start_writer(0, 1)
        again = wait_for(lambda: reader.latest(last.sequence))
        assert again.sequence == 0
        assert reader.reopened == 1
        assert reader.latest(0) is None


def test_only_a_killed_writers_segment_is_removed(
    name: str, start_writer: Callable[..., subprocess.Popen[str]]
) -> None:
    assert not remove_leavings(name), "nothing is there"
    writer = start_writer(0, 1, 0.0)
    assert not remove_leavings(name), "its writer lives"
    assert segment_path(name).exists()
    writer.send_signal(signal.SIGKILL)
    writer.wait(DEADLINE_S)
    assert remove_leavings(name)
    assert not segment_path(name).exists()


def test_a_reader_follows_a_writer_of_another_size(name: str) -> None:
    writer = SharedFrameWriter(name, 16, 12, True)
    writer.write(frame(9))
    with SharedFrameReader(name) as reader:
        assert reader.latest() is not None
        writer.close()
        assert reader.latest(9) is None
        assert reader.writer_heartbeat_ns is None
        with SharedFrameWriter(name, 40, 30, False) as second:
            second.write(frame(0, 40, 30, False))
            got = wait_for(lambda: reader.latest(9))
            assert same(got, frame(0, 40, 30, False))
            assert (reader.width, reader.height, reader.depth) == (40, 30, False)


def test_two_writers_of_one_name_are_rejected(name: str) -> None:
    with SharedFrameWriter(name, 16, 12, True) as writer:
        with pytest.raises(FileExistsError, match="another process"):
            SharedFrameWriter(name, 16, 12, True)
        writer.write(frame(1))
        with SharedFrameReader(name) as reader:
            assert reader.latest() is not None
    left = [path for path in SHARED_MEMORY_DIRECTORY.iterdir() if name in path.name]
    assert left == []


def test_the_heartbeat_follows_the_writes(name: str) -> None:
    with SharedFrameWriter(name, 16, 12, True) as writer, SharedFrameReader(name) as reader:
        before = time.monotonic_ns()
        writer.write(frame(0))
        heartbeat = reader.writer_heartbeat_ns
        assert heartbeat is not None
        assert before <= heartbeat <= time.monotonic_ns()


def test_frame_of_another_size_is_rejected_with_both_sizes(name: str) -> None:
    with SharedFrameWriter(name, 16, 12, True) as writer:
        with pytest.raises(ValueError, match=r"16x12 .*8x6"):
            writer.write(frame(0, 8, 6))
        with pytest.raises(ValueError, match=r"with depth, .*none"):
            writer.write(frame(0, depth=False))
    with pytest.raises(ValueError, match="closed"):
        writer.write(frame(0))


def test_reader_without_segment_names_it(name: str) -> None:
    with pytest.raises(FileNotFoundError):
        SharedFrameReader(name)


@pytest.mark.parametrize("content", [b"", b"x" * 100, b"\0" * 8192, bytes(range(256)) * 64])
def test_file_that_is_not_a_segment_is_rejected(name: str, content: bytes) -> None:
    segment_path(name).write_bytes(content)
    with pytest.raises(ValueError, match="not a segment"):
        SharedFrameReader(name)


def test_a_truncated_segment_is_rejected(name: str) -> None:
    with SharedFrameWriter(name, 64, 48, True):
        whole = segment_path(name).read_bytes()
    segment_path(name).write_bytes(whole[:9000])
    with pytest.raises(ValueError, match="damaged"):
        SharedFrameReader(name)


def test_long_segment_name_is_rejected() -> None:
    with pytest.raises(ValueError, match="200 characters, got 'nnn"):
        SharedFrameReader("n" * 300)


def test_the_segment_is_for_its_owner_only(name: str) -> None:
    with SharedFrameWriter(name, 16, 12, False):
        assert Path(segment_path(name)).stat().st_mode & 0o077 == 0


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((), "plumb_bob"),
        ((-0.12, 0.03, 0.0005, -0.0003), "plumb_bob"),
        ((-0.12, 0.03, 5e-4, -3e-4, 0.01), "plumb_bob"),
        ((0.6, 0.08, 4e-4, -3e-4, 0.002, 0.9, 0.2, 0.01), "rational_polynomial"),
        ((-0.02, 0.004, -0.002, 0.0003), "equidistant"),
    ],
)
@pytest.mark.parametrize(
    "mount",
    [
        None,
        CameraMount(0.12, -0.3, 0.05, 0.1, -0.35, 1.2),
        CameraMount(pitch_rad=-0.4, stabilized=True),
        CameraMount(forward_m=0.2, on_gimbal=True),
    ],
    ids=["none", "fixed", "stabilized", "gimbal"],
)
def test_calibration_is_read_unchanged(
    name: str, distortion: tuple[float, ...], model: DistortionModel, mount: CameraMount | None
) -> None:
    calibration = CameraCalibration(CameraModel(16, 12, 11.5, 11.25, 7.25, 5.75, distortion, model), mount)
    with (
        SharedFrameWriter(name, 16, 12, depth=False, calibration=calibration),
        SharedFrameReader(name) as reader,
    ):
        assert reader.calibration == calibration


def test_writer_without_calibration_gives_none(name: str) -> None:
    with SharedFrameWriter(name, 16, 12, depth=False), SharedFrameReader(name) as reader:
        assert reader.calibration is None


def test_calibration_of_another_size_is_rejected(name: str) -> None:
    calibration = CameraCalibration(CameraModel.from_horizontal_fov(640, 480, 1.2))
    with pytest.raises(ValueError, match="640x480"):
        SharedFrameWriter(name, 16, 12, depth=False, calibration=calibration)


@pytest.mark.parametrize("version", [1, 2])
def test_a_segment_of_an_older_version_is_rejected(name: str, version: int) -> None:
    with SharedFrameWriter(name, 16, 12, depth=False):
        with segment_path(name).open("r+b") as file:
            file.seek(8)
            file.write(version.to_bytes(8, sys.byteorder))
        with pytest.raises(ValueError, match=f"version {version}, expected 3.*{os.getpid()}.*restart"):
            SharedFrameReader(name)


def test_an_unknown_distortion_model_is_rejected(name: str) -> None:
    calibration = CameraCalibration(CameraModel.from_horizontal_fov(16, 12, 1.2))
    with SharedFrameWriter(name, 16, 12, depth=False, calibration=calibration):
        with segment_path(name).open("r+b") as file:
            file.seek(31 * 8)
            file.write((3).to_bytes(8, sys.byteorder))
        with pytest.raises(ValueError, match=r"damaged.*distortion model 3"):
            SharedFrameReader(name)


@pytest.mark.parametrize("word", [13, 17, 25, 30])  # of the lens, its distortion, the mount's place and turn
def test_a_damaged_calibration_is_rejected(name: str, word: int) -> None:
    calibration = CameraCalibration(CameraModel.from_horizontal_fov(16, 12, 1.2), CameraMount())
    with SharedFrameWriter(name, 16, 12, depth=False, calibration=calibration):
        with segment_path(name).open("r+b") as file:
            file.seek(word * 8)
            file.write(np.array([np.nan]).tobytes())
        with pytest.raises(ValueError, match="damaged"):
            SharedFrameReader(name)
