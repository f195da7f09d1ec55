"""CSI cameras, with stand-ins for the boards' programs."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from vision.sources import SourceError, SourceSettings, open_source
from vision.sources.csi import CsiCamera, csi_cameras, parse_camera_list
from vision.sources.v4l2 import FrameSize, PixelFormat, VideoDevice

# As rpicam-hello of libcamera 0.5 prints it.
LISTED = """Available cameras
-----------------
0 : imx708 [4608x2592 10-bit RGGB] (/base/axi/pcie@1000120000/rp1/i2c@88000/imx708@1a)
    Modes: 'SRGGB10_CSI2P' : 1536x864 [120.13 fps - (768, 432)/3072x1728 crop]
                             2304x1296 [56.03 fps - (0, 0)/4608x2592 crop]
                             4608x2592 [14.35 fps - (0, 0)/4608x2592 crop]

1 : ov5647 [2592x1944 10-bit GBRG] (/base/axi/pcie@1000120000/rp1/i2c@80000/ov5647@36)
    Modes: 'SGBRG10_CSI2P' : 640x480 [58.92 fps - (16, 0)/2560x1920 crop]
"""

# Last lines of rpicam-vid that it writes to standard error.
TIMED_OUT = "ERROR: *** camera timed out ***"
NO_CAMERAS = "ERROR: *** no cameras available ***"


def test_list_of_rpicam_hello_is_parsed() -> None:
    assert parse_camera_list(LISTED) == (
        CsiCamera(0, "imx708", ((1536, 864, 120.13), (2304, 1296, 56.03), (4608, 2592, 14.35))),
        CsiCamera(1, "ov5647", ((640, 480, 58.92),)),
    )
    older = "0 : imx219 [3280x2464] (/base/soc/imx219@10)\n    Modes: 'SRGGB8' : 640x480 1640x1232\n"
    assert parse_camera_list(older) == (CsiCamera(0, "imx219", ((640, 480, None), (1640, 1232, None))),)
    none = "No cameras available!\n"
    assert parse_camera_list(none) == ()


def test_cameras_of_a_raspberry_pi_come_from_its_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "rpicam-hello"
    program.write_text(f'#!/bin/sh\n[ "$1" = --list-cameras ] && cat <<"END"\n{LISTED}END\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    assert [camera.sensor for camera in csi_cameras(())] == ["imx708", "ov5647"]


def test_cameras_of_a_jetson_come_from_its_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    bayer = PixelFormat("RG10", "10-bit Bayer RGRG/GBGB", (FrameSize(1920, 1080, (60.0, 30.0)),))
    devices = [
        VideoDevice(Path("/dev/video0"), driver="uvcvideo", card="HD Webcam", kind="camera"),
        VideoDevice(
            Path("/dev/video1"), driver="tegra-video", card="imx219 9-0010", kind="camera", formats=(bayer,)
        ),
    ]
    assert csi_cameras(devices) == (CsiCamera(0, "imx219 9-0010", ((1920, 1080, 60.0),)),)


# A stand-in for both programs: notes its arguments, then writes the images of `size` until it is ended.
# An image is grey: 16 + 10 per image, in the limited range of yuv420.
PROGRAM = """#!{python}
import os, signal, sys, time
arguments = sys.argv[1:]
with open({notes!r}, "a") as notes:
    print(os.getpid(), *sys.argv, file=notes)
def end(*_):
    open({notes!r} + ".ended", "a").write("SIGINT ")
    sys.exit(0)
signal.signal(signal.SIGINT, end)
{body}
"""
WRITE = """
print("GST_ARGUS: Creating output stream", file=sys.stderr if "--output" in arguments else sys.stdout)
sys.stdout.flush()
fd = 1 if "--output" in arguments else int(arguments[-1].removeprefix("fd="))
for index in range({images}):
    os.write(fd, bytes([16 + 10 * index]) * ({width} * {height}) + b"\\x80" * ({width} * {height} // 2))
    time.sleep(0.01)
{after}
"""


class Board:
    """The programs of a board, in a folder that is the whole PATH."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.notes = folder, folder / "notes"
        monkeypatch.setenv("PATH", str(folder))

    def install(self, name: str, body: str) -> None:
        path = self.folder / name
        path.write_text(PROGRAM.format(python=sys.executable, notes=str(self.notes), body=body))
        path.chmod(0o755)

    def writes(self, name: str, *, images: int = 20, after: str = "time.sleep(60)") -> None:
        self.install(name, WRITE.format(width=128, height=64, images=images, after=after))

    def started(self) -> list[list[str]]:
        """Of each start: process id, program, arguments."""
        return [line.split() for line in self.notes.read_text().splitlines()]


@pytest.fixture
def board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Board:
    return Board(tmp_path, monkeypatch)


SIZE = SourceSettings(width=128, height=64, rate_hz=30.0, retry_min_s=0.01, open_timeout_s=20.0)


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until_ended(pid: int) -> bool:
    deadline_s = time.monotonic() + 20.0
    while is_running(pid) and time.monotonic() < deadline_s:
        time.sleep(0.02)
    return not is_running(pid)


@pytest.mark.realtime
@pytest.mark.parametrize("name", ["rpicam-vid", "gst-launch-1.0"])
def test_images_of_the_board_program_are_delivered(board: Board, name: str) -> None:
    board.writes(name)
    with open_source("csi://1", SIZE) as source:
        assert source.live
        frame = source.read(20.0)
        assert frame is not None
        assert frame.image.shape == (64, 128, 3)
        assert frame.media_s is None
        values = np.unique(frame.image)
        # The image's luma in the full range: 0 for 16, and 255/219 more per step.
        assert len(values) == 1
        assert abs(int(values[0]) - 255 / 219 * 10 * frame.sequence) <= 1
        ((pid, _, *arguments),) = board.started()
        assert is_running(int(pid))
    assert wait_until_ended(int(pid))
    assert (board.folder / "notes.ended").read_text() == "SIGINT "
    text = " ".join(arguments)
    if name == "rpicam-vid":
        for wanted in ("--camera 1", "--width 128", "--height 64", "--framerate 30", "--codec yuv420"):
            assert wanted in text
        assert {"--nopreview", "--flush"} <= set(arguments)
        assert "--timeout 0" in text
    else:
        assert "nvarguscamerasrc sensor-id=1 ! video/x-raw(memory:NVMM)" in text
        assert "width=128,height=64,framerate=30/1" in text
        assert "format=I420 ! fdsink fd=" in text


@pytest.mark.realtime
def test_mjpeg_of_the_board_program_is_delivered(board: Board) -> None:
    ok, jpeg = cv2.imencode(".jpg", np.full((50, 100, 3), 77, np.uint8))
    assert ok
    (board.folder / "image.jpg").write_bytes(jpeg.tobytes())
    board.install(
        "rpicam-vid",
        f"data = open({str(board.folder / 'image.jpg')!r}, 'rb').read()\n"
        "assert '--codec mjpeg' in ' '.join(arguments)\n"
        "while True:\n    os.write(1, data)\n    time.sleep(0.01)",
    )
    settings = replace(SIZE, pixel_format="mjpeg", width=100, height=50)
    with open_source("csi://0", settings) as source:
        frame = source.read(20.0)
    assert frame is not None
    assert frame.image.shape == (50, 100, 3)
    assert abs(float(frame.image.mean()) - 77) < 2


@pytest.mark.realtime
def test_program_that_ends_is_started_again(board: Board, caplog: pytest.LogCaptureFixture) -> None:
    board.writes("rpicam-vid", images=3, after=f"sys.exit('{TIMED_OUT}')")
    with open_source("csi://0", SIZE) as source:
        deadline_s = time.monotonic() + 20.0
        while source.statistics.reopened < 2 and time.monotonic() < deadline_s:
            source.read(0.1)
        assert source.statistics.reopened >= 2
    assert len(board.started()) >= 3
    assert "lost: rpicam-vid " in caplog.text
    assert f"code 1: {TIMED_OUT}" in caplog.text
    assert all(wait_until_ended(int(pid)) for pid, *_ in board.started())


@pytest.mark.realtime
def test_program_without_a_camera_is_a_one_line_error(board: Board) -> None:
    board.install("rpicam-vid", f"sys.exit('[0:01] INFO Camera\\n{NO_CAMERAS}')")
    with pytest.raises(SourceError, match=rf"^csi://0: .*code 1: {re.escape(NO_CAMERAS)}") as error:
        open_source("csi://0", replace(SIZE, open_timeout_s=1.0))
    assert "\n" not in str(error.value)


@pytest.mark.realtime
def test_program_ends_when_its_parent_is_killed(board: Board) -> None:
    board.writes("rpicam-vid", images=1)
    code = (
        "import os, signal\nfrom vision.sources import SourceSettings, open_source\n"
        "source = open_source('csi://0', SourceSettings(width=128, height=64))\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}, check=False
    )
    assert done.returncode == -signal.SIGKILL
    ((pid, *_),) = board.started()
    assert wait_until_ended(int(pid))


@pytest.mark.realtime
def test_exposure_and_gain_are_arguments_of_the_program(board: Board) -> None:
    wanted = replace(SIZE, exposure_us=8333.4, gain=2.5)
    board.writes("gst-launch-1.0")
    open_source("csi://0", wanted).close()
    assert "exposuretimerange=8333400 8333400 gainrange=2.5 2.5" in " ".join(board.started()[0])
    board.writes("rpicam-vid")
    open_source("csi://0", wanted).close()
    assert "--shutter 8333 --gain 2.5" in " ".join(board.started()[1])


def test_board_without_program_names_the_packages(board: Board) -> None:
    with pytest.raises(SourceError, match=r"rpicam-apps.*gstreamer1\.0-tools, nvidia-l4t-gstreamer"):
        open_source("csi://0")


# The Jetson's elements, and those of GStreamer that stand in for them, in one launch of the real program.
GSTREAMER = """#!{python}
import os, sys
words = []
for word in sys.argv[1:]:
    if word == "nvarguscamerasrc":
        words += ["videotestsrc", "is-live=true", "pattern=red"]
    elif not word.startswith("sensor-id="):
        word = {{"nvvidconv": "videoconvert", "nvjpegenc": "jpegenc"}}.get(word, word)
        words.append(word.replace("(memory:NVMM)", ""))
os.execv("/usr/bin/gst-launch-1.0", ["gst-launch-1.0", *words])
"""


@pytest.mark.needs("GStreamer")
@pytest.mark.parametrize("pixel_format", ["yuv420", "mjpeg"])
def test_pipeline_of_a_jetson_delivers_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pixel_format: str
) -> None:
    program = tmp_path / "gst-launch-1.0"
    program.write_text(GSTREAMER.format(python=sys.executable))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    wanted = SourceSettings(width=640, height=480, rate_hz=10.0, pixel_format=pixel_format)
    with open_source("csi://0", wanted) as source:
        for _ in range(3):
            frame = source.read(20.0)
            assert frame is not None
            assert frame.image.shape == (480, 640, 3)
            # jpegenc, of GStreamer, keeps the video's limited range.
            assert np.abs(frame.image.mean((0, 1)) - (0, 0, 255)).max() < 20
