from __future__ import annotations

import logging
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vision.recording
from vision.detections import Detections
from vision.frame import Frame
from vision.recording import Recording
from vision.sources import SourceSettings, open_source

pytestmark = pytest.mark.realtime

WIDTH, HEIGHT = 96, 64
SPOT = Detections(
    np.array([[40, 20, 56, 36]], np.float32), np.ones(1, np.float32), np.zeros(1, np.int64), ("spot",)
)


def frame_of(sequence: int, *, rate_hz: float = 20.0, width: int = WIDTH, height: int = HEIGHT) -> Frame:
    return Frame(np.full((height, width, 3), 90, np.uint8), 10**9 + round(sequence / rate_hz * 1e9), sequence)


def give(recording: Recording, frame: Frame, detections: Detections = SPOT) -> None:
    """Write a frame like a camera that is slower than the encoder."""
    deadline_s = time.monotonic() + 30
    while recording._queue.full():
        assert time.monotonic() < deadline_s
        time.sleep(0.001)
    recording.write(frame, detections)


def played(path: Path) -> list[np.ndarray]:
    with open_source(str(path), SourceSettings()) as source:
        return [frame.image for frame in source]


def test_video_contains_every_frame_with_detections(tmp_path: Path) -> None:
    path = tmp_path / "flight.webm"
    recording = Recording(path, 20.0)
    for sequence in range(8):
        give(recording, frame_of(sequence), SPOT if sequence < 4 else SPOT[:0])
    recording.close()
    images = played(path)
    assert len(images) == 8
    assert images[0].shape == (HEIGHT, WIDTH, 3)
    assert np.ptp(images[2]) > 60  # a box is drawn on the grey
    assert np.ptp(images[7]) < 30
    assert recording.skipped == 0


def test_images_of_a_levelled_video_are_those_of_its_level(tmp_path: Path) -> None:
    path = tmp_path / "flight.webm"
    recording = Recording(path, 20.0)
    recording.level = lambda frame, image: np.full_like(image, 200) if frame.sequence else None
    for sequence in range(2):
        give(recording, frame_of(sequence), SPOT[:0])
    recording.close()
    first, second = played(path)
    assert np.ptp(first) > 60, "it says that it is not level"
    assert abs(int(second.mean()) - 200) < 5


def test_lines_and_highlight_change_the_image(tmp_path: Path) -> None:
    videos = []
    for name, lines, highlight in (
        ("a", (), None),
        ("b", ("seek car",), None),
        ("c", (), "spot"),
        ("d", (), "x"),
    ):
        path = tmp_path / f"{name}.webm"
        recording = Recording(path, 20.0)
        recording.lines, recording.highlight = lines, highlight
        give(recording, frame_of(0))
        recording.close()
        videos.append(played(path)[0].astype(int))
    plain, panel, marked, other = videos
    assert np.abs(panel - plain).max() > 40
    assert np.abs(marked - plain).max() > 20
    assert np.array_equal(other, plain)


def test_a_recording_without_frames_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "flight.webm"
    Recording(path, 20.0).close()
    assert not path.exists()


def test_frames_beyond_the_video_rate_are_not_drawn(tmp_path: Path) -> None:
    path = tmp_path / "flight.webm"
    recording = Recording(path, 10.0)
    for sequence in range(41):
        give(recording, frame_of(sequence, rate_hz=40.0))
    recording.close()
    assert len(played(path)) == 11
    assert recording.skipped == 0


def test_frame_of_another_size_is_resized(tmp_path: Path) -> None:
    path = tmp_path / "flight.webm"
    recording = Recording(path, 20.0)
    give(recording, frame_of(0))
    give(recording, frame_of(1, width=48, height=32), SPOT[:0])
    recording.close()
    assert [image.shape for image in played(path)] == [(HEIGHT, WIDTH, 3)] * 2


def test_slow_encoder_drops_frames_without_blocking(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recording = Recording(tmp_path / "flight.webm", 200.0)
    large = np.random.default_rng(1).integers(0, 255, (1080, 1920, 3), np.uint8)
    for sequence in range(100):
        recording.write(Frame(large, sequence * 5_000_000, sequence), SPOT)
    # Frames of the video, not frames offered: two are offered for each slot.
    for sequence in range(100, 300):
        recording.write(Frame(large, sequence * 2_500_000 + 250_000_000, sequence), SPOT)
    recording.close()
    assert 0 < recording.skipped <= 200
    assert any("rate_hz" in record.getMessage() for record in caplog.records)


def test_close_does_not_wait_for_a_slow_encoder(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vision.recording._FINISHING_S", -1.0)
    drawing, may_go_on = threading.Event(), threading.Event()

    def slowly(frame: Frame, *_: object, **__: object) -> np.ndarray:
        drawing.set()
        assert may_go_on.wait(30)
        return frame.image

    monkeypatch.setattr("vision.recording.annotate_level", slowly)
    path = tmp_path / "flight.webm"
    recording = Recording(path, 20.0)
    for sequence in range(4):
        give(recording, frame_of(sequence))
        assert drawing.wait(30)
    closing = threading.Thread(target=recording.close)
    closing.start()
    while recording._queue.qsize() < 4:  # three frames and the end marker
        time.sleep(0.001)
    may_go_on.set()
    closing.join(30)
    assert len(played(path)) == 1
    assert recording.skipped == 3
    assert any("3 frames" in record.getMessage() for record in caplog.records)


def test_internal_error_ends_the_recording_with_a_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def faulty(frame: Frame, detections: Detections, *_: object, **__: object) -> np.ndarray:
        return frame.image if len(detections) else [][0]

    monkeypatch.setattr("vision.recording.annotate_level", faulty)
    path = tmp_path / "flight.webm"
    recording = Recording(path, 20.0)
    give(recording, frame_of(0))
    give(recording, frame_of(1), SPOT[:0])
    give(recording, frame_of(2), SPOT[:0])
    recording.close()
    (record_logged,) = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert "list index" in record_logged.getMessage()
    assert record_logged.exc_info is not None
    assert played(path)  # the frames before the error


def test_failed_recording_is_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "flight.webm"
    recording = Recording(path, 20.0)
    path.unlink()
    path.mkdir()  # the file can no longer be written
    with caplog.at_level(logging.ERROR):
        for sequence in range(10):
            give(recording, frame_of(sequence))
        recording.close()
        recording.close()
    assert len([record for record in caplog.records if "recording failed" in record.getMessage()]) == 1


def test_an_encoder_that_pauses_for_a_second_leaves_no_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, may_go_on = tmp_path / "flight.webm", threading.Event()
    add = vision.recording._add

    def paused(*arguments: Any) -> None:
        assert may_go_on.wait(30)
        add(*arguments)

    monkeypatch.setattr("vision.recording._add", paused)
    recording = Recording(path, 20.0)
    for sequence in range(20):
        recording.write(frame_of(sequence), SPOT)
    may_go_on.set()
    recording.close()
    assert recording.skipped == 0
    assert len(played(path)) == 20
