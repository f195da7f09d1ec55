"""Photos and videos where the disk or the folder is not as expected."""

from __future__ import annotations

import os
import shutil
from collections import namedtuple
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station.captures import KEPT_FREE_BYTES, Captures
from tests.companion.ground_station.station_harness import CameraHarness, S, command_long, jpeg

Usage = namedtuple("Usage", "total used free")


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**9, 10**9, KEPT_FREE_BYTES - 1))


@pytest.mark.usefixtures("full_disk")
def test_full_disk_fails_the_photo_and_nothing_else(tmp_path: Path) -> None:
    harness = CameraHarness(tmp_path)
    harness.ask(command_long(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1))
    harness.captures.on_image(jpeg(), harness.now_ns, harness.now_ns)
    captured = harness.sent_until("CAMERA_IMAGE_CAPTURED")[-2]
    assert captured.capture_result == 0
    assert list((tmp_path / "photos").iterdir()) == []
    assert "MB are free" in harness.warnings[0]
    harness.now_ns += S
    assert "HEARTBEAT" in [each.get_type() for each in harness.due()]
    assert harness.ask(command_long(525, 0, 1))[1].available_capacity == 0


@pytest.mark.usefixtures("full_disk")
def test_full_disk_ends_the_video_with_one_warning(tmp_path: Path) -> None:
    harness = CameraHarness(tmp_path)
    harness.ask(command_long(mavlink.MAV_CMD_VIDEO_START_CAPTURE))
    for _ in range(8):
        harness.captures.on_image(jpeg(), harness.now_ns, harness.now_ns)
        harness.captures._executor.submit(lambda: None).result()
        harness.due()
        harness.now_ns += S // 10
    assert harness.ask(command_long(527, 1))[1].video_status == 0
    assert len(harness.warnings) == 1
    assert not harness.captures.is_wanted


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_folder_without_permission_fails_the_photo(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir(mode=0o500)
    harness = CameraHarness(tmp_path)
    harness.ask(command_long(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1))
    harness.captures.on_image(jpeg(), harness.now_ns, harness.now_ns)
    assert harness.sent_until("CAMERA_IMAGE_CAPTURED")[-2].capture_result == 0


def test_file_in_place_of_the_folder_fails_the_photo(tmp_path: Path) -> None:
    (tmp_path / "photos").write_text("")
    harness = CameraHarness(tmp_path)
    harness.ask(command_long(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1))
    harness.captures.on_image(jpeg(), harness.now_ns, harness.now_ns)
    assert harness.sent_until("CAMERA_IMAGE_CAPTURED")[-2].capture_result == 0
    assert len(harness.warnings) == 1


def test_slow_disk_delays_a_photo_and_counts_images_of_a_video(tmp_path: Path) -> None:
    warnings: list[str] = []
    captures = Captures(tmp_path, "camera", rate_hz=10.0, warn=warnings.append)
    captures._executor.submit(lambda: None)
    captures.start_video(100 * S)
    for number in range(30):  # nothing is collected meanwhile
        captures.on_image(jpeg(), 100 * S + number * S // 10, 100 * S + number * S // 10)
    assert captures.dropped == 26
    captures.start_photos(0.0, 1, 104 * S)
    captures.on_image(jpeg(), 104 * S, 104 * S)
    assert captures.is_wanted
    captures._executor.submit(lambda: None).result()
    list(captures.due(104 * S))
    captures.on_image(jpeg(), 104 * S, 104 * S)
    captures.stop_video()
    assert captures.image_count == 1
    assert len(warnings) == 1
    captures.close()


def test_video_without_an_image_is_reported(tmp_path: Path) -> None:
    harness = CameraHarness(tmp_path)
    harness.ask(command_long(mavlink.MAV_CMD_VIDEO_START_CAPTURE))
    harness.ask(command_long(mavlink.MAV_CMD_VIDEO_STOP_CAPTURE))
    harness.captures._executor.submit(lambda: None).result()
    harness.due()
    assert len(harness.warnings) == 1


def test_damaged_images_of_a_video_are_reported_at_its_end(tmp_path: Path) -> None:
    harness = CameraHarness(tmp_path)
    harness.ask(command_long(mavlink.MAV_CMD_VIDEO_START_CAPTURE))
    for data in (jpeg(), jpeg()[:40], b"", jpeg()):
        harness.captures.on_image(data, harness.now_ns, harness.now_ns)
        harness.captures._executor.submit(lambda: None).result()
        harness.due()
        harness.now_ns += S // 10
    assert harness.warnings == []
    harness.ask(command_long(mavlink.MAV_CMD_VIDEO_STOP_CAPTURE))
    harness.captures._executor.submit(lambda: None).result()
    harness.due()
    (file,) = (tmp_path / "videos").glob("*.webm")
    (warning,) = harness.warnings
    assert f"{file}: without 2 images" in warning
