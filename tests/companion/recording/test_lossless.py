"""Processed frames reach the recorder without losses, and what is left out is counted."""

from __future__ import annotations

import json
import os
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.perception.cameras import recorded_frames_names
from companion.perception.worker import ProcessedFrames
from companion.recording.lossless import FrameEncoder
from companion.settings.reading import load_settings
from vision.frame import Frame

TIMEOUT_S = 20.0


class RecorderOfTest:
    """Keeps the images."""

    def __init__(self) -> None:
        self.late = False
        self.dropped_images = 0
        self.added: list[tuple[str, bytes, bytes | None]] = []

    def add(self, path: str, payload: bytes, attachment: bytes | None) -> None:
        self.added.append((path, payload, attachment))


def wait_for(condition: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.005)


def frame(number: int) -> Frame:
    image = np.random.default_rng(number).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    return Frame(image, 1000 * number, 10 * number)


@pytest.fixture
def name() -> str:
    return f"companion-test-{os.getpid()}-{time.monotonic_ns()}"


def give(shared: ProcessedFrames, given: Frame, *, processed: bool = True) -> None:
    if processed:
        shared.newest_ns = given.captured_ns
    shared.write(given)


def test_processed_frames_are_encoded_bit_for_bit(name: str) -> None:
    recorder, shared = RecorderOfTest(), ProcessedFrames(name, depth=False)
    encoder = FrameEncoder({"cameras/down/image": name}, recorder)
    for number in range(1, 5):
        give(shared, frame(number), processed=number != 3)
        wait_for(lambda expected=number - (number >= 3): len(recorder.added) == expected)  # type: ignore[misc]
    encoder.close()
    shared.close()
    assert [path for path, _, _ in recorder.added] == ["cameras/down/image"] * 3
    for (_, png, attachment), number in zip(recorder.added, (1, 2, 4), strict=True):
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(image, frame(number).image)
        height, width = frame(number).image.shape[:2]
        assert json.loads(attachment or b"") == {
            "captured_ns": 1000 * number,
            "width": width,
            "height": height,
        }
    assert recorder.dropped_images == 0


@pytest.mark.parametrize("depth", [True, False])
def test_depth_of_a_frame_is_recorded_before_its_image_if_chosen(name: str, depth: bool) -> None:
    recorder, shared = RecorderOfTest(), ProcessedFrames(name, depth=depth)
    encoder = FrameEncoder({"cameras/down/image": name}, recorder)
    give(shared, replace(frame(1), depth_m=np.full((48, 64), 1.5, np.float32)))
    wait_for(lambda: len(recorder.added) == 1 + depth)
    encoder.close()
    shared.close()
    paths = [path for path, _, _ in recorder.added]
    assert paths == ["cameras/down/depth_image"] * depth + ["cameras/down/image"]
    if depth:
        _, packed, attachment = recorder.added[0]
        assert zlib.decompress(packed) == np.full(48 * 64, 1500, "<u2").tobytes()
        assert json.loads(attachment or b"") == {"captured_ns": 1000, "width": 64, "height": 48}


def test_frames_that_are_replaced_or_would_wait_are_counted(name: str) -> None:
    recorder, shared = RecorderOfTest(), ProcessedFrames(name, depth=False)
    give(shared, frame(1))
    encoder = FrameEncoder({"image": name}, recorder)
    wait_for(lambda: len(recorder.added) == 1)
    recorder.late = True
    give(shared, frame(2))
    wait_for(lambda: recorder.dropped_images == 1)
    encoder.close()
    recorder.late = False
    shared.close()
    assert len(recorder.added) == 1


def test_frames_of_a_restarted_worker_follow(name: str) -> None:
    recorder = RecorderOfTest()
    encoder = FrameEncoder({"image": name}, recorder)
    for number in (1, 2):
        shared = ProcessedFrames(name, depth=False)
        give(shared, frame(number))
        wait_for(lambda expected=number: len(recorder.added) == expected)  # type: ignore[misc]
        shared.close()
    encoder.close()
    assert recorder.dropped_images == 0


def test_memory_that_cannot_be_made_ends_only_the_images(caplog: pytest.LogCaptureFixture) -> None:
    shared = ProcessedFrames("no/plain/name", depth=False)
    for number in (1, 2):
        give(shared, frame(number))
    assert len(caplog.records) == 1
    assert "not recorded: " in caplog.text


def test_only_png_images_of_a_recording_are_shared(tmp_path: Path) -> None:
    png = {"recording.directory": str(tmp_path), "recording.content": "png"}

    def names(**changes: str) -> dict[str | None, str]:
        values = png | {f"recording.{key}": value for key, value in changes.items()}
        return recorded_frames_names(load_settings(os.devnull, values, {}))

    assert list(names()) == [None]
    assert names(content="jpeg") == names(content="depth") == names(directory="") == {}


def test_each_camera_has_its_own_shared_memory(tmp_path: Path) -> None:
    settings = {
        "recording.directory": str(tmp_path),
        "recording.content": "png",
        "cameras.camera.source.uri": "none",
        "cameras.recorded.source.uri": "none",
    }
    read = load_settings(os.devnull, settings, {})
    names = recorded_frames_names(read)
    # Its worker shares what the one setting says.
    assert [read.of_camera(name).recording.content for name in (None, "camera")] == [("png",)] * 2
    assert list(names) == [None, "camera", "recorded"]
    assert len(set(names.values())) == 3
