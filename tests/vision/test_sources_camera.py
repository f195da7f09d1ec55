"""A V4L2 camera, with a fake `cv2.VideoCapture`, the lowest layer: no camera is needed."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from vision.sources import SourceError, SourceSettings, open_source
from vision.sources.camera import camera_device
from vision.sources.v4l2 import fourcc_text

pytestmark = pytest.mark.realtime


class FakeCamera:
    """A driver that delivers 640x480 YUYV at 30 Hz for any request, but accepts MJPG."""

    opened: list[FakeCamera] = []  # noqa: RUF012 - a record across instances, emptied by the fixture
    frames_before_unplugged = 1 << 30
    stamp_ms = -1.0

    def __init__(self, device: str, backend: int) -> None:
        assert backend == cv2.CAP_V4L2
        self.device = device
        self.asked: list[tuple[int, float]] = []
        self.values = {
            cv2.CAP_PROP_FRAME_WIDTH: 640.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 480.0,
            cv2.CAP_PROP_FPS: 30.0,
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"YUYV")),
        }
        self.reads = 0
        self.released = False
        FakeCamera.opened.append(self)

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        return True

    def set(self, name: int, value: float) -> bool:
        self.asked.append((name, value))
        if name == cv2.CAP_PROP_FOURCC:
            self.values[name] = value
        return True

    def get(self, name: int) -> float:
        return self.stamp_ms if name == cv2.CAP_PROP_POS_MSEC else self.values[name]

    def grab(self) -> bool:
        time.sleep(0.005)
        self.reads += 1
        return self is not FakeCamera.opened[0] or self.reads <= self.frames_before_unplugged

    def retrieve(self) -> tuple[bool, Any]:
        if (cv2.CAP_PROP_CONVERT_RGB, 0) in self.asked:
            return True, np.tile(np.arange(7000, 7640, dtype=np.uint16), (480, 1))
        return True, np.full((480, 640, 3), 50, np.uint8)

    def release(self) -> None:
        self.released = True


@pytest.fixture
def device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    FakeCamera.opened.clear()
    monkeypatch.setattr(FakeCamera, "frames_before_unplugged", 1 << 30)
    monkeypatch.setattr(FakeCamera, "stamp_ms", -1.0)
    monkeypatch.setattr("vision.sources.camera.cv2.VideoCapture", FakeCamera)
    path = tmp_path / "video0"
    path.touch()
    monkeypatch.setattr("vision.sources.opening.camera_device", lambda uri: path)
    return path


def test_settings_reach_the_driver_pixel_format_first(device: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    wanted = SourceSettings(width=640, height=480, rate_hz=30.0, pixel_format="MJPG")
    with open_source("0", wanted) as source:
        assert source.live
        frame = source.read(20.0)
        assert frame is not None
        assert (frame.width, frame.height) == (640, 480)
    (camera,) = FakeCamera.opened
    assert camera.device == str(device)
    assert [name for name, _ in camera.asked] == [
        cv2.CAP_PROP_FOURCC,
        cv2.CAP_PROP_FRAME_WIDTH,
        cv2.CAP_PROP_FRAME_HEIGHT,
        cv2.CAP_PROP_FPS,
    ]
    assert "640x480 MJPG at 30 Hz" in caplog.text
    assert camera.released


def test_counts_of_16_bits_are_stretched(device: Path, caplog: pytest.LogCaptureFixture) -> None:
    with open_source("0", SourceSettings(pixel_format="Y16 ")) as source:
        for _ in range(2):
            frame = source.read(20.0)
            assert frame is not None
            assert frame.image.shape == (480, 640, 3)
            assert (frame.image.min(), frame.image.max()) == (0, 255)
    assert caplog.text.count("values 7000 to 7639") == 1


def test_settings_not_accepted_by_the_driver_are_logged(
    device: Path, caplog: pytest.LogCaptureFixture
) -> None:
    open_source("0", SourceSettings(width=1280, height=720, rate_hz=60.0)).close()
    assert "640x480 YUYV at 30 Hz; " in caplog.text
    assert ": width 1280, height 720, " in caplog.text
    assert "rate_hz 60" in caplog.text


def test_an_unplugged_camera_is_opened_again(
    device: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(FakeCamera, "frames_before_unplugged", 3)
    with open_source("0", SourceSettings(retry_min_s=0.01)) as source:
        deadline_s = time.monotonic() + 20
        while source.statistics.reopened < 1 and time.monotonic() < deadline_s:
            source.read(0.1)
        assert source.statistics.reopened == 1
    assert len(FakeCamera.opened) == 2
    assert all(camera.released for camera in FakeCamera.opened)
    assert re.search("lost: .* delivered", caplog.text)
    assert "recovered after" in caplog.text


def test_monotonic_driver_stamp_is_used(device: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stamp_ns = time.monotonic_ns() - 20_000_000
    monkeypatch.setattr(FakeCamera, "stamp_ms", stamp_ns / 1e6)
    with open_source("0") as source:
        frame = source.read(20.0)
    assert frame is not None
    assert abs(frame.captured_ns - stamp_ns) < 1000


def test_stamp_of_another_clock_is_not_used(device: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeCamera, "stamp_ms", time.time() * 1000)
    before_ns = time.monotonic_ns()
    with open_source("0") as source:
        frame = source.read(20.0)
    assert frame is not None
    assert before_ns <= frame.captured_ns <= time.monotonic_ns()


def test_a_camera_without_permission_names_the_group(device: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vision.sources.camera.os.access", lambda path, mode: False)
    with pytest.raises(SourceError, match="group video"):
        open_source("0")


@pytest.mark.parametrize("opens", [True, False])
def test_busy_camera_names_the_program_that_holds_it(
    device: Path, monkeypatch: pytest.MonkeyPatch, opens: bool
) -> None:
    """Of a busy camera the driver refuses the format, or gives no frames."""
    monkeypatch.setattr(FakeCamera, "isOpened", lambda self: opens)
    monkeypatch.setattr(FakeCamera, "grab", lambda self: False)
    code = "import sys; file = open(sys.argv[1]); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code, device], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"open\n"
        with pytest.raises(SourceError, match=rf"busy: \S+ \({other.pid}\) "):
            open_source("0", SourceSettings(open_timeout_s=0.3))


def test_camera_without_the_control_is_refused(device: Path) -> None:
    """The file in the camera's place has no controls at all."""
    with pytest.raises(SourceError, match=r"video0: .*control .*\.gain;"):
        open_source("0", SourceSettings(gain=3.0))
    assert all(camera.released for camera in FakeCamera.opened)


def test_pipe_pixel_format_is_rejected_for_a_camera(device: Path) -> None:
    with pytest.raises(SourceError, match="FOURCC"):
        open_source("0", SourceSettings(pixel_format="bgr24", width=4, height=4))


@pytest.mark.parametrize(
    ("uri", "device"),
    [
        ("0", "/dev/video0"),
        ("12", "/dev/video12"),
        ("/dev/video3", "/dev/video3"),
        ("/dev/v4l/by-id/usb-cam-index0", "/dev/v4l/by-id/usb-cam-index0"),
        ("/dev/null", "/dev/null"),
        ("/dev/stdin", None),
        ("/dev/shm", None),
        ("video0", None),
        ("-", None),
        ("rtsp://camera/0", None),
        ("²", None),
    ],
)
def test_camera_addresses_are_recognised(uri: str, device: str | None) -> None:
    assert camera_device(uri) == (None if device is None else Path(device))


def test_fourcc_is_text_if_printable() -> None:
    assert fourcc_text(cv2.VideoWriter.fourcc(*"MJPG")) == "MJPG"
    assert fourcc_text(0) == "0x00000000"
    assert fourcc_text(-1) == "0x-0000001"
