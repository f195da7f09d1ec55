"""Frames from shared memory, with depth, and a writer that dies and returns."""

from __future__ import annotations

import secrets
import time

import numpy as np
import pytest

from vision.camera_model import CameraCalibration, CameraModel, CameraMount
from vision.frame import Frame
from vision.shared_frame import SharedFrameWriter
from vision.sources import SourceError, SourceSettings, open_source
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
        deadline_s = time.monotonic() + 20
        while "lost" not in caplog.text and time.monotonic() < deadline_s:
            assert source.read(0.05) is None
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
        with pytest.raises(SourceError, match="no frame within"):
            open_source(f"shm://{name}", SourceSettings(open_timeout_s=0.3, retry_min_s=0.1))


def test_missing_writer_is_a_one_line_error() -> None:
    with pytest.raises(
        SourceError, match=r"no frames in the shared memory 'test-none'.*is its writer running"
    ):
        open_source("shm://test-none", SourceSettings(open_timeout_s=0.3, retry_min_s=0.1))


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
