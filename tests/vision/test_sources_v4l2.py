"""V4L2 devices, with a fake ioctl that fills the kernel's structures: no camera is needed.

The structures are declared here with ctypes, field by field as in linux/videodev2.h, so that the code's own
layout is checked against another one.
"""

from __future__ import annotations

import ctypes
import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from vision.sources.v4l2 import (
    ControlError,
    FrameSize,
    PixelFormat,
    VideoDevice,
    holders,
    set_exposure,
    video_devices,
)

U32, CHAR = ctypes.c_uint32, ctypes.c_char
NODES = ("video0", "video1", "video2", "video10")
YUYV, MJPG = 0x56595559, 0x47504A4D
CARD = "HD Webcam: HD"


class Capability(ctypes.Structure):
    _fields_ = [("driver", CHAR * 16), ("card", CHAR * 32), ("bus_info", CHAR * 32), ("version", U32),
                ("capabilities", U32), ("device_caps", U32), ("reserved", U32 * 3)]  # fmt: skip


class FmtDesc(ctypes.Structure):
    _fields_ = [("index", U32), ("type", U32), ("flags", U32), ("description", CHAR * 32),
                ("pixelformat", U32), ("mbus_code", U32), ("reserved", U32 * 3)]  # fmt: skip


class FrmSizeEnum(ctypes.Structure):
    _fields_ = [
        ("index", U32),
        ("pixel_format", U32),
        ("type", U32),
        ("sizes", U32 * 6),
        ("reserved", U32 * 2),
    ]


class FrmIvalEnum(ctypes.Structure):
    _fields_ = [("index", U32), ("pixel_format", U32), ("width", U32), ("height", U32), ("type", U32),
                ("intervals", U32 * 6), ("reserved", U32 * 2)]  # fmt: skip


def request(number: int, structure: type[ctypes.Structure], *, read_only: bool = False) -> int:
    """The ioctl's number, as the macros _IOR and _IOWR of asm-generic/ioctl.h make it."""
    return (2 if read_only else 3) << 30 | ctypes.sizeof(structure) << 16 | ord("V") << 8 | number


class FakeDriver:
    """A USB camera whose second node delivers metadata, and a codec with sizes in a range.

    Args:
        nodes: file name → device_caps.
    """

    formats = ((YUYV, b"YUYV 4:2:2"), (MJPG, b"Motion-JPEG"))
    sizes = ((640, 480), (1280, 720))
    intervals = ((1, 30), (1001, 30000), (1, 15))

    def __init__(self, nodes: dict[str, int], *, stepwise: bool = False) -> None:
        self._nodes = nodes
        self._stepwise = stepwise

    def __call__(self, descriptor: int, number: int, buffer: bytearray) -> int:
        caps = self._nodes[Path(os.readlink(f"/proc/self/fd/{descriptor}")).name]
        answers: dict[int, Any] = {
            request(0, Capability, read_only=True): self._capability,
            request(2, FmtDesc): self._format,
            request(74, FrmSizeEnum): self._size,
            request(75, FrmIvalEnum): self._interval,
        }
        answers[number](buffer, caps)
        return 0

    @staticmethod
    def _capability(buffer: bytearray, caps: int) -> None:
        if not caps:
            raise OSError(errno.ENODEV, "No such device")
        answer = Capability.from_buffer(buffer)
        answer.driver, answer.card, answer.bus_info = b"uvcvideo", CARD.encode(), b"usb-0000:00:14.0-1"
        answer.capabilities, answer.device_caps = 0x84A00001, caps

    def _format(self, buffer: bytearray, _caps: int) -> None:
        answer = FmtDesc.from_buffer(buffer)
        assert answer.type == 1
        answer.pixelformat, answer.description = nth(self.formats, answer.index)

    def _size(self, buffer: bytearray, _caps: int) -> None:
        answer = FrmSizeEnum.from_buffer(buffer)
        assert answer.pixel_format in (YUYV, MJPG)
        if self._stepwise:
            answer.type, answer.sizes[:] = 3, nth(((32, 1920, 2, 16, 1080, 2),), answer.index)
        else:
            answer.type, answer.sizes[:2] = 1, nth(self.sizes, answer.index)

    def _interval(self, buffer: bytearray, _caps: int) -> None:
        answer = FrmIvalEnum.from_buffer(buffer)
        assert answer.width in (640, 1280, 1920)
        if self._stepwise:
            answer.type, answer.intervals[:] = 2, nth(((1, 60, 1, 5, 1, 60),), answer.index)
        else:
            answer.type, answer.intervals[:2] = 1, nth(self.intervals, answer.index)


def nth(entries: tuple[Any, ...], index: int) -> Any:
    if index >= len(entries):
        raise OSError(errno.EINVAL, "Invalid argument")
    return entries[index]


@pytest.fixture
def dev(tmp_path: Path) -> Path:
    for name in ("video0", "video1", "video10", "video2", "videos"):
        (tmp_path / name).touch()
    by_id = tmp_path / "v4l" / "by-id"
    by_id.mkdir(parents=True)
    (by_id / "usb-HD_Webcam-index0").symlink_to("../../video0")
    return tmp_path


CAMERA, METADATA, CODEC = 0x04200001, 0x04A00000, 0x04008000


def test_devices_are_listed_with_kind_and_stable_name(dev: Path) -> None:
    driver = FakeDriver({"video0": CAMERA, "video1": METADATA, "video2": CODEC, "video10": 0})
    devices = video_devices(dev, driver)
    assert [device.path.name for device in devices] == ["video0", "video1", "video2", "video10"]
    assert [device.kind for device in devices] == ["camera", "metadata", "codec", "other"]
    assert devices[0].stable_path == dev / "v4l" / "by-id" / "usb-HD_Webcam-index0"
    assert devices[1].stable_path is None
    assert (devices[0].driver, devices[0].card) == ("uvcvideo", CARD)
    assert devices[0].bus == "usb-0000:00:14.0-1"
    assert devices[3] == VideoDevice(dev / "video10", error=os.strerror(errno.ENODEV))


def test_discrete_sizes_have_their_rates(dev: Path) -> None:
    camera = video_devices(dev, FakeDriver(dict.fromkeys(NODES, CAMERA)))[0]
    rates = (30.0, 29.97, 15.0)
    sizes = (FrameSize(640, 480, rates), FrameSize(1280, 720, rates))
    assert camera.formats == (
        PixelFormat("YUYV", "YUYV 4:2:2", sizes),
        PixelFormat("MJPG", "Motion-JPEG", sizes),
    )


def test_range_of_sizes_is_one_entry(dev: Path) -> None:
    camera = video_devices(dev, FakeDriver(dict.fromkeys(NODES, CAMERA), stepwise=True))[0]
    assert camera.formats[0].sizes == (FrameSize(1920, 1080, (60.0, 5.0), (32, 16)),)


def test_enumeration_without_end_is_cut_off(dev: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeDriver, "formats", ((MJPG, b"Motion-JPEG"),) * 100_000)
    monkeypatch.setattr(FakeDriver, "sizes", ())
    camera = video_devices(dev, FakeDriver(dict.fromkeys(NODES, CAMERA)))[0]
    assert len(camera.formats) == 256


def test_device_without_permission_has_a_reason(dev: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(*_: object) -> int:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("vision.sources.v4l2.os.open", denied)
    assert "group video" in video_devices(dev, FakeDriver({}))[0].error


def test_holder_of_a_device_is_named(dev: Path) -> None:
    code = "import sys; file = open(sys.argv[1]); print('open', flush=True); sys.stdin.read()"
    other = subprocess.Popen(
        [sys.executable, "-c", code, dev / "video0"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        assert other.stdout is not None
        assert other.stdout.readline() == b"open\n"
        with open(dev / "video1") as own:
            assert not own.closed
            assert holders(dev / "video1") == ()
        (holder,) = holders(dev / "v4l" / "by-id" / "usb-HD_Webcam-index0")
        assert holder.endswith(f" ({other.pid})")
        assert "python" in holder
    finally:
        other.communicate(timeout=20)
    assert holders(dev / "video0") == ()
    assert holders(dev / "video7") == ()


class QueryCtrl(ctypes.Structure):
    _fields_ = [("id", U32), ("type", U32), ("name", CHAR * 32), ("minimum", ctypes.c_int32),
                ("maximum", ctypes.c_int32), ("step", ctypes.c_int32), ("default", ctypes.c_int32),
                ("flags", U32), ("reserved", U32 * 2)]  # fmt: skip


class Control(ctypes.Structure):
    _fields_ = [("id", U32), ("value", ctypes.c_int32)]


class FakeControls:
    """A driver's controls: id → minimum, maximum, flags. `made` are the values set, in order."""

    def __init__(self, controls: dict[int, tuple[int, int, int]]) -> None:
        self._controls = controls
        self.made: list[tuple[int, int]] = []

    def __call__(self, _descriptor: int, number: int, buffer: bytearray) -> int:
        if number == request(28, Control):
            control = Control.from_buffer(buffer)
            if self._controls[control.id][2]:
                raise OSError(errno.EACCES, "Permission denied")
            self.made.append((control.id, control.value))
            return 0
        assert number == request(36, QueryCtrl)
        answer = QueryCtrl.from_buffer(buffer)
        if answer.id not in self._controls:
            raise OSError(errno.EINVAL, "Invalid argument")
        answer.minimum, answer.maximum, answer.flags = self._controls[answer.id]
        return 0


EXPOSURE_AUTO, EXPOSURE, AUTOGAIN, GAIN = 0x9A0901, 0x9A0902, 0x980912, 0x980913
WEBCAM = {EXPOSURE_AUTO: (0, 3, 0), EXPOSURE: (3, 2047, 0), GAIN: (0, 100, 0)}


def test_exposure_is_set_after_the_automatic_is_off(dev: Path) -> None:
    controls = FakeControls(WEBCAM)
    set_exposure(dev / "video0", 8333.0, None, controls)
    assert controls.made == [(EXPOSURE_AUTO, 1), (EXPOSURE, 83)]
    controls = FakeControls({**WEBCAM, AUTOGAIN: (0, 1, 0)})
    set_exposure(dev / "video0", None, 40.0, controls)
    assert controls.made == [(AUTOGAIN, 0), (GAIN, 40)]
    controls = FakeControls({})
    set_exposure(dev / "video0", None, None, controls)
    assert controls.made == []


@pytest.mark.parametrize(
    ("controls", "exposure_us", "gain", "message"),
    [
        (WEBCAM, 100.0, None, r"source\.exposure_us .*100; .* 300 to 204700"),
        (WEBCAM, None, 101.0, r"source\.gain .*101; .* 0 to 100"),
        ({}, 8000.0, None, r"control for source\.exposure_us"),
        ({GAIN: (0, 100, 4)}, None, 5.0, r"control for source\.gain"),
        ({GAIN: (0, 100, 0x10)}, None, 5.0, r"source\.gain 5: Permission denied"),
    ],
)
def test_control_that_a_camera_cannot_set_is_refused(
    dev: Path,
    controls: dict[int, tuple[int, int, int]],
    exposure_us: float | None,
    gain: float | None,
    message: str,
) -> None:
    with pytest.raises(ControlError, match=message):
        set_exposure(dev / "video0", exposure_us, gain, FakeControls(controls))
