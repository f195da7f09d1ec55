"""Frames in shared memory: those of another process, with depth, and a source's own."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.vision.network_streams import read_until_logged
from vision.camera_model import CameraCalibration, CameraModel, CameraMount
from vision.frame import Frame
from vision.shared_frame import SharedFrameReader, SharedFrameWriter
from vision.sources import Source, SourceError, SourceSettings, open_source
from vision.sources.shared import FrameSharing
from vision.sources.source import CameraChangedError

pytestmark = pytest.mark.realtime

QUICK = SourceSettings(open_timeout_s=20.0, read_timeout_s=0.3, retry_min_s=0.02, retry_max_s=0.05)


def frame(sequence: int, value: int) -> Frame:
    depth_m = np.full((4, 6), value / 10, np.float32)
    return Frame(np.full((4, 6, 3), value, np.uint8), time.monotonic_ns(), sequence, depth_m)


def test_shared_frames_have_depth_stamps_and_counted_gaps() -> None:
    name = f"test-{secrets.token_hex(6)}"
    with SharedFrameWriter(name, 6, 4, depth=True) as writer:
        written = frame(7, 50)
        writer.write(written)
        with open_source(f"shm://{name}", QUICK) as source:
            assert source.live
            first = source.read(20.0)
            assert first is not None
            assert first.captured_ns == written.captured_ns
            assert first.depth_m is not None
            assert float(first.depth_m[0, 0]) == pytest.approx(5.0)
            writer.write(frame(12, 60))
            second = source.read(20.0)
            assert second is not None
            assert int(second.image[0, 0, 0]) == 60
            assert second.sequence - first.sequence == 5
            assert source.statistics.dropped == 4


def test_writer_restart_is_logged_as_loss_and_recovery(caplog: pytest.LogCaptureFixture) -> None:
    name = f"test-{secrets.token_hex(6)}"
    first = SharedFrameWriter(name, 6, 4, depth=False)
    first.write(Frame(np.full((4, 6, 3), 10, np.uint8), time.monotonic_ns(), 100))
    with open_source(f"shm://{name}", QUICK) as source:
        assert source.read(20.0) is not None
        first.close()
        assert read_until_logged(source, caplog, "lost") == []
        deadline_s = time.monotonic() + 20
        with SharedFrameWriter(name, 8, 4, depth=False) as second:  # smaller sequence, another size
            got = None
            sequence = 0
            while got is None and time.monotonic() < deadline_s:
                second.write(Frame(np.full((4, 8, 3), 20, np.uint8), time.monotonic_ns(), sequence))
                sequence += 1
                got = source.read(0.05)
            assert got is not None
            assert (got.width, int(got.image[0, 0, 0])) == (8, 20)
            assert source.statistics.reopened == 1


def test_frame_of_a_dead_writer_is_ignored() -> None:
    name = f"test-{secrets.token_hex(6)}"
    with SharedFrameWriter(name, 6, 4, depth=False) as writer:
        old = Frame(np.zeros((4, 6, 3), np.uint8), time.monotonic_ns() - 60_000_000_000, 3)
        writer.write(old)
        with pytest.raises(SourceError, match=rf"^shm://{name}: no frame .*0\.3 s"):
            open_source(f"shm://{name}", SourceSettings(open_timeout_s=0.3, retry_min_s=0.1))


def test_source_provides_calibration_and_ends_on_change() -> None:
    name = f"test-{secrets.token_hex(6)}"
    lens = CameraCalibration(CameraModel.from_horizontal_fov(6, 4, 1.2), CameraMount(pitch_rad=-0.35))
    other = CameraCalibration(CameraModel.from_horizontal_fov(6, 4, 1.4), CameraMount(pitch_rad=-0.35))
    first = SharedFrameWriter(name, 6, 4, depth=True, calibration=lens)
    first.write(frame(0, 10))
    with open_source(f"shm://{name}", QUICK) as source:
        assert source.calibration == lens
        assert source.read(20.0) is not None
        first.close()
        with SharedFrameWriter(name, 6, 4, depth=True, calibration=other) as second:
            deadline_s = time.monotonic() + 20
            ended: SourceError | None = None
            sequence = 0
            while ended is None:
                assert time.monotonic() < deadline_s
                second.write(frame(sequence, 20))
                sequence += 1
                try:
                    got = source.read(0.05)
                    assert got is None or int(got.image[0, 0, 0]) == 10
                except SourceError as error:
                    ended = error
            assert isinstance(ended, CameraChangedError)
        assert source.calibration == lens


@pytest.fixture
def name() -> Iterator[str]:
    name = f"companion-test-{secrets.token_hex(4)}"
    yield name
    assert not Path("/dev/shm", name).exists(), "the shared memory was left behind"


def write_images(folder: Path, *sizes: tuple[int, int]) -> Path:
    rng = np.random.default_rng(1)
    for index, (width, height) in enumerate(sizes):
        image = rng.integers(0, 255, (height, width, 3), dtype=np.uint8)
        assert cv2.imwrite(str(folder / f"{index}.png"), image)
    return folder


@contextmanager
def shared(folder: Path, name: str, **settings: Any) -> Iterator[Source]:
    with (
        FrameSharing(name) as sharing,
        open_source(str(folder), SourceSettings(on_frame=sharing.write, **settings)) as source,
    ):
        yield source


def test_frames_are_shared_with_their_stamps(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24), (32, 24))
    with shared(folder, name) as source:
        for _ in range(2):
            frame = source.read()
            assert frame is not None
            with SharedFrameReader(name) as reader:
                other = reader.latest()
            assert other is not None
            assert (other.sequence, other.captured_ns) == (frame.sequence, frame.captured_ns)
            assert np.array_equal(other.image, frame.image)


def test_frame_after_close_is_not_shared(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24), (32, 24))
    with FrameSharing(name) as sharing, open_source(str(folder)) as source:
        frame = source.read()
        assert frame is not None
        sharing.write(frame)
    sharing.write(frame)
    with pytest.raises(FileNotFoundError):
        SharedFrameReader(name)


def test_sharing_continues_after_a_size_change(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24), (48, 16))
    with shared(folder, name) as source:
        source.read()
        with SharedFrameReader(name) as reader:
            assert (reader.width, reader.height) == (32, 24)
            source.read()
            other = reader.latest()
            assert other is not None
            assert (other.width, other.height) == (48, 16)


def test_name_in_use_is_a_one_line_error(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24))
    with (
        SharedFrameWriter(name, 8, 8, False),
        shared(folder, name) as source,
        pytest.raises(SourceError, match=f"shm://{name}: .*another process"),
    ):
        source.read()


def test_sharing_includes_frames_a_slow_reader_misses(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24), (32, 24))
    with shared(folder, name, realtime=True, loop=True, rate_hz=200.0), SharedFrameReader(name) as reader:
        # The source itself is not read.
        seen: set[int] = set()
        deadline_s = time.monotonic() + 30.0
        while len(seen) < 5:
            assert time.monotonic() < deadline_s, f"only the frames {seen} were shared"
            frame = reader.latest()
            if frame is not None:
                seen.add(frame.sequence)
            time.sleep(0.001)


def test_source_fails_to_open_if_sharing_fails(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24))
    with (
        SharedFrameWriter(name, 8, 8, False),
        pytest.raises(SourceError, match=f"shm://{name}: .*another process"),
        shared(folder, name, realtime=True),
    ):
        pass
