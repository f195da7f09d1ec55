"""Video4Linux devices by their ioctls: what they are, what they offer, who holds them, exposure and gain.

Structures and numbers are those of linux/videodev2.h. Not tested with a real device: the tests inject the
ioctl function and answer with the kernel's structures.
"""

from __future__ import annotations

import fcntl
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vision.open_files import PROC, processes_with_file, program_name

_QUERYCAP, _ENUM_FMT, _ENUM_FRAMESIZES, _ENUM_FRAMEINTERVALS = 0x80685600, 0xC0405602, 0xC02C564A, 0xC034564B
_QUERYCTRL, _S_CTRL = 0xC0445624, 0xC008561C
_CAPABILITY = struct.Struct("=16s32s32s6I")
_FMTDESC = struct.Struct("=3I32s2I12x")
_FRMSIZEENUM = struct.Struct("=9I8x")
_FRMIVALENUM = struct.Struct("=11I8x")
_QUERYCTRL_STRUCT = struct.Struct("=2I32s4iI8x")
_CONTROL = struct.Struct("=Ii")

_CAP_DEVICE_CAPS = 0x80000000
_CAP_VIDEO_CAPTURE, _CAP_VIDEO_CAPTURE_MPLANE, _CAP_M2M, _CAP_META_CAPTURE = 0x1, 0x1000, 0xC000, 0x800000
_BUF_TYPE_VIDEO_CAPTURE, _BUF_TYPE_VIDEO_CAPTURE_MPLANE = 1, 9
_DISCRETE = 1
_CTRL_DISABLED, _CTRL_READ_ONLY = 0x1, 0x4
_CID_EXPOSURE_AUTO, _CID_EXPOSURE_ABSOLUTE, _EXPOSURE_MANUAL = 0x009A0901, 0x009A0902, 1
_CID_AUTOGAIN, _CID_GAIN, _CID_ANALOGUE_GAIN = 0x00980912, 0x00980913, 0x009E0903
_EXPOSURE_UNIT_US = 100.0  # of V4L2_CID_EXPOSURE_ABSOLUTE

_MOST = 256  # entries of an enumeration: a driver that never ends it must not block us

Ioctl = Callable[[int, int, bytearray], Any]
"""`fcntl.ioctl`, which changes the buffer; raises OSError."""


class ControlError(Exception):
    """A control cannot be set. The text says why."""


@dataclass(frozen=True, slots=True)
class FrameSize:
    """One image size of a pixel format. Of a range of sizes, its largest.

    Attributes:
        rates_hz: frame rates, highest first; empty if the driver does not say.
        smallest: width and height of the smallest size, if these are the largest of a range.
    """

    width: int
    height: int
    rates_hz: tuple[float, ...] = ()
    smallest: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """One pixel format: its FOURCC, the driver's description, its sizes."""

    fourcc: str
    description: str
    sizes: tuple[FrameSize, ...]


@dataclass(frozen=True, slots=True)
class VideoDevice:
    """One /dev/video node.

    Attributes:
        path: /dev/videoN. stable_path: its name under /dev/v4l/by-id (or by-path), which stays the same;
            None without one.
        driver, card, bus: as the driver reports them.
        kind: `camera`; `metadata`, the second node of many USB cameras, which delivers no images; `codec`,
            a converter or encoder; `other`, for example an output.
        formats: of a camera.
        holders: programs that have it open.
        error: why it could not be queried; empty if it was.
    """

    path: Path
    stable_path: Path | None = None
    driver: str = ""
    card: str = ""
    bus: str = ""
    kind: str = "other"
    formats: tuple[PixelFormat, ...] = ()
    holders: tuple[str, ...] = ()
    error: str = ""


def video_devices(dev: Path = Path("/dev"), ioctl: Ioctl = fcntl.ioctl) -> tuple[VideoDevice, ...]:
    """All video nodes under `dev`, by their number."""
    paths = sorted(
        (path for path in dev.glob("video*") if path.name[5:].isdecimal()),
        key=lambda path: int(path.name[5:]),
    )
    stable = {}
    for folder in ("by-path", "by-id"):  # by-id last: it also survives another USB port
        for link in sorted((dev / "v4l" / folder).glob("*")):
            stable[link.resolve()] = link
    return tuple(_query(path, stable.get(path.resolve()), ioctl) for path in paths)


def _query(path: Path, stable_path: Path | None, ioctl: Ioctl) -> VideoDevice:
    held_by = holders(path)
    try:
        # Opening takes nothing from another program: only streaming is exclusive.
        descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        reason = "no permission; the group video has it" if error.errno == 13 else str(error.strerror)
        return VideoDevice(path, stable_path, holders=held_by, error=reason)
    try:
        buffer = bytearray(_CAPABILITY.size)
        ioctl(descriptor, _QUERYCAP, buffer)
        driver, card, bus, _, capabilities, device_caps, *_ = _CAPABILITY.unpack(buffer)
        # `capabilities` are those of all nodes of the physical device together.
        caps = device_caps if capabilities & _CAP_DEVICE_CAPS else capabilities
        kind = _kind(caps)
        formats: tuple[PixelFormat, ...] = ()
        if kind == "camera":
            buffer_type = (
                _BUF_TYPE_VIDEO_CAPTURE if caps & _CAP_VIDEO_CAPTURE else _BUF_TYPE_VIDEO_CAPTURE_MPLANE
            )
            formats = tuple(_formats(descriptor, buffer_type, ioctl))
        return VideoDevice(path, stable_path, _text(driver), _text(card), _text(bus), kind, formats, held_by)
    except OSError as error:
        return VideoDevice(path, stable_path, holders=held_by, error=str(error.strerror))
    finally:
        os.close(descriptor)


def _kind(caps: int) -> str:
    if caps & _CAP_M2M:
        return "codec"
    if caps & (_CAP_VIDEO_CAPTURE | _CAP_VIDEO_CAPTURE_MPLANE):
        return "camera"
    return "metadata" if caps & _CAP_META_CAPTURE else "other"


def _enumerate(
    descriptor: int, request: int, packing: struct.Struct, ioctl: Ioctl, *rest: int
) -> Iterator[Any]:
    """Each structure of an enumeration, unpacked; the driver ends it with an error (EINVAL)."""
    for index in range(_MOST):
        buffer = bytearray(packing.size)
        struct.pack_into(f"={1 + len(rest)}I", buffer, 0, index, *rest)
        try:
            ioctl(descriptor, request, buffer)
        except OSError:
            return
        yield packing.unpack(buffer)


def _formats(descriptor: int, buffer_type: int, ioctl: Ioctl) -> Iterator[PixelFormat]:
    for _, _, _, description, code, _ in _enumerate(descriptor, _ENUM_FMT, _FMTDESC, ioctl, buffer_type):
        yield PixelFormat(fourcc_text(code), _text(description), tuple(_sizes(descriptor, code, ioctl)))


def _sizes(descriptor: int, code: int, ioctl: Ioctl) -> Iterator[FrameSize]:
    for _, _, kind, *union in _enumerate(descriptor, _ENUM_FRAMESIZES, _FRMSIZEENUM, ioctl, code):
        if kind == _DISCRETE:
            width, height = union[:2]
            yield FrameSize(width, height, _rates_hz(descriptor, code, width, height, ioctl))
            continue
        least_width, width, _, least_height, height, _ = union  # one entry for the whole range
        rates_hz = _rates_hz(descriptor, code, width, height, ioctl)
        yield FrameSize(width, height, rates_hz, (least_width, least_height))
        return


def _rates_hz(descriptor: int, code: int, width: int, height: int, ioctl: Ioctl) -> tuple[float, ...]:
    rates: list[float] = []
    for _, _, _, _, kind, *union in _enumerate(
        descriptor, _ENUM_FRAMEINTERVALS, _FRMIVALENUM, ioctl, code, width, height
    ):
        # A range gives its shortest and longest interval, and one entry.
        fractions = (union[:2],) if kind == _DISCRETE else (union[:2], union[2:4])
        rates += [round(below / above, 3) for above, below in fractions if above]
        if kind != _DISCRETE:
            break
    return tuple(sorted(set(rates), reverse=True))


def set_exposure(
    device: Path, exposure_us: float | None, gain: float | None, ioctl: Ioctl = fcntl.ioctl
) -> None:
    """Set a camera's exposure time, microseconds, and gain, in the driver's unit; None leaves it as it is.

    The automatic control of what is set is switched off, where the camera has one.

    Raises:
        ControlError: the camera has no such control, its range does not contain the value, or the driver
            refuses.
    """
    if exposure_us is None and gain is None:
        return
    descriptor = os.open(device, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if exposure_us is not None:
            _switch_off(descriptor, _CID_EXPOSURE_AUTO, _EXPOSURE_MANUAL, ioctl)
            _set("exposure_us", descriptor, (_CID_EXPOSURE_ABSOLUTE,), exposure_us, _EXPOSURE_UNIT_US, ioctl)
        if gain is not None:
            _switch_off(descriptor, _CID_AUTOGAIN, 0, ioctl)
            _set("gain", descriptor, (_CID_GAIN, _CID_ANALOGUE_GAIN), gain, 1.0, ioctl)
    finally:
        os.close(descriptor)


def _switch_off(descriptor: int, automatic: int, value: int, ioctl: Ioctl) -> None:
    if _control_range(descriptor, automatic, ioctl) is not None:
        ioctl(descriptor, _S_CTRL, bytearray(_CONTROL.pack(automatic, value)))


def _set(
    name: str, descriptor: int, controls: tuple[int, ...], value: float, unit: float, ioctl: Ioctl
) -> None:
    """Set the first of `controls` that the camera has to `value`, of which one step is `unit`."""
    for control in controls:
        if (limits := _control_range(descriptor, control, ioctl)) is None:
            continue
        least, most = (limit * unit for limit in limits)
        if not least <= value <= most:
            raise ControlError(f"source.{name} is {value:g}; this camera has {least:g} to {most:g}")
        try:
            ioctl(descriptor, _S_CTRL, bytearray(_CONTROL.pack(control, round(value / unit))))
        except OSError as error:
            raise ControlError(f"the camera refuses source.{name} {value:g}: {error.strerror}") from error
        return
    raise ControlError(f"this camera has no control for source.{name}; remove it")


def _control_range(descriptor: int, control: int, ioctl: Ioctl) -> tuple[int, int] | None:
    """The smallest and largest value of a control; None if the camera does not have it."""
    buffer = bytearray(_QUERYCTRL_STRUCT.size)
    struct.pack_into("=I", buffer, 0, control)
    try:
        ioctl(descriptor, _QUERYCTRL, buffer)
    except OSError:
        return None
    _, _, _, least, most, _, _, flags = _QUERYCTRL_STRUCT.unpack(buffer)
    return None if flags & (_CTRL_DISABLED | _CTRL_READ_ONLY) else (least, most)


def holders(device: Path, proc: Path = PROC) -> tuple[str, ...]:
    """Programs that have a device open, `NAME (PID)`, without this process.

    Other users' programs are visible to root only.
    """
    found = processes_with_file(device, proc)
    return tuple(f"{program_name(process, proc)} ({process})" for process in found)


def fourcc_text(code: int) -> str:
    """The four letters of a FOURCC; in hexadecimal if they are not printable."""
    letters = code.to_bytes(4, "little", signed=code < 0)
    return letters.decode("ascii") if all(32 <= letter < 127 for letter in letters) else f"0x{code:08x}"


def _text(field: bytes) -> str:
    return field.split(b"\0", 1)[0].decode("utf-8", "replace")
