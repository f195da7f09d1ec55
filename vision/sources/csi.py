"""Cameras on a board's CSI connector, as the board's own programs list them.

Not tested with a real camera: the tests use stand-in programs with the same arguments and output.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass

from vision.sources.v4l2 import VideoDevice

_LIST_PROGRAMS = ("rpicam-hello", "libcamera-hello")  # the second: its name before 2023
_LIST_TIMEOUT_S = 10.0
_JETSON_DRIVER = "tegra-video"
_CAMERA = re.compile(r"(\d+) : (\S+) \[")
# `/1280x960` is the crop of a mode, not its size. Releases before 2022 list no rates.
_MODE = re.compile(r"(?<![\d/])(\d+)x(\d+)(?: \[([\d.]+) fps)?")


@dataclass(frozen=True, slots=True)
class CsiCamera:
    """One CSI camera: `csi://NUMBER`.

    Attributes:
        sensor: its name. modes: width, height and highest rate in Hz (None: not reported) of its readout
            modes; the picture may have any smaller size.
    """

    number: int
    sensor: str
    modes: tuple[tuple[int, int, float | None], ...] = ()


def csi_cameras(devices: Sequence[VideoDevice]) -> tuple[CsiCamera, ...]:
    """The CSI cameras of a Raspberry Pi, from rpicam-hello, or of a Jetson, from its V4L2 nodes.

    Empty on other boards, and without rpicam-hello.
    """
    if program := next(filter(None, map(shutil.which, _LIST_PROGRAMS)), None):
        try:
            listed = subprocess.run(
                [program, "--list-cameras"],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                timeout=_LIST_TIMEOUT_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired):
            return ()
        return parse_camera_list(listed.stdout.decode(errors="replace"))
    jetson = [device for device in devices if device.driver == _JETSON_DRIVER]
    return tuple(
        CsiCamera(
            number,
            device.card,
            tuple(
                dict.fromkeys(
                    (size.width, size.height, max(size.rates_hz, default=None))
                    for pixel_format in device.formats
                    for size in pixel_format.sizes
                )
            ),
        )
        for number, device in enumerate(jetson)
    )


def parse_camera_list(text: str) -> tuple[CsiCamera, ...]:
    """Parse the output of `rpicam-hello --list-cameras`."""
    cameras: list[CsiCamera] = []
    modes: dict[tuple[int, int, float | None], None] = {}
    for line in text.splitlines():
        if found := _CAMERA.match(line):
            modes = {}
            cameras.append(CsiCamera(int(found[1]), found[2]))
        elif cameras and line[:1].isspace():
            for width, height, rate in _MODE.findall(line):
                modes[int(width), int(height), float(rate) if rate else None] = None
            cameras[-1] = CsiCamera(cameras[-1].number, cameras[-1].sensor, tuple(modes))
    return tuple(cameras)
