"""CSI cameras, with stand-ins for the boards' programs."""

from __future__ import annotations

from pathlib import Path

import pytest

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


def test_list_of_rpicam_hello_is_parsed() -> None:
    assert parse_camera_list(LISTED) == (
        CsiCamera(0, "imx708", ((1536, 864, 120.13), (2304, 1296, 56.03), (4608, 2592, 14.35))),
        CsiCamera(1, "ov5647", ((640, 480, 58.92),)),
    )
    older = "0 : imx219 [3280x2464] (/base/soc/imx219@10)\n    Modes: 'SRGGB8' : 640x480 1640x1232\n"
    assert parse_camera_list(older) == (CsiCamera(0, "imx219", ((640, 480, None), (1640, 1232, None))),)
    assert parse_camera_list("No cameras available!\n") == ()


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
