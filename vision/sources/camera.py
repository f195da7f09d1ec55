"""A camera of Video4Linux, `/dev/video0` or `0`.

A name under `/dev/v4l/by-id/` stays the same when a camera is unplugged and plugged in again; a number may
not.

Not tested with a real camera: it follows OpenCV's V4L2 back end as documented, and is tested with a fake
`cv2.VideoCapture`, the lowest layer available.
"""

from __future__ import annotations

import logging
import math
import os
import stat
from pathlib import Path

import cv2

from vision.sources.capture import Capture, CaptureError, RawFrame
from vision.sources.opencv import quiet_opencv, read_capture
from vision.sources.source import PIPE_PIXEL_FORMATS, SourceError, SourceSettings, SourceUnavailableError
from vision.sources.v4l2 import ControlError, fourcc_text, holders, set_exposure

logger = logging.getLogger(__name__)

_GREY_16 = "Y16 "  # V4L2's format of a thermal camera's counts
_OLDEST_STAMP_NS = 1_000_000_000  # an older driver stamp is from another clock


def camera_device(uri: str) -> Path | None:
    """The device of an address: an index, or a character device under /dev; None if neither."""
    if uri.isascii() and uri.isdecimal():
        return Path(f"/dev/video{int(uri)}")
    path = Path(uri)
    if not uri.startswith("/dev/") or uri.startswith("/dev/std"):
        return None
    if path.name.startswith("video") or uri.startswith("/dev/v4l/"):
        return path
    try:
        return path if stat.S_ISCHR(path.stat().st_mode) else None
    except OSError:
        return None


def check_camera(device: Path, settings: SourceSettings) -> None:
    """Check that a camera can be opened.

    Raises:
        SourceUnavailableError: no such device, or no permission.
        SourceError: a pixel format that no camera has.
    """
    if settings.pixel_format in PIPE_PIXEL_FORMATS:
        raise SourceError(
            f"{device}: pixel_format {settings.pixel_format!r} is for pipes; a camera's is a FOURCC, "
            f"such as MJPG or YUYV"
        )
    if not device.exists():
        others = ", ".join(str(path) for path in sorted(Path("/dev").glob("video*")))
        raise SourceUnavailableError(
            f"{device}: no such camera; {f'found {others}' if others else 'no camera is connected'}"
        )
    if not os.access(device, os.R_OK | os.W_OK):
        raise SourceUnavailableError(
            f"{device}: no permission; add the user to the group video (sudo usermod -aG video USER) "
            f"and log in again"
        )


class CameraCapture(Capture):
    """Frames of a V4L2 camera, with the driver's stamp if it uses the monotonic clock.

    Raises:
        SourceError: it cannot be opened, for a known reason.
        CaptureError: it did not open; another program may be using it.
    """

    def __init__(self, device: Path, settings: SourceSettings) -> None:
        check_camera(device, settings)
        quiet_opencv()
        self._device = device
        # OpenCV's timeout for a frame, in whole seconds; it reads the variable at its first use.
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(math.ceil(settings.read_timeout_s)))
        self._capture = cv2.VideoCapture(str(device), cv2.CAP_V4L2)
        if not self._capture.isOpened():
            self._capture.release()
            raise CaptureError(_unopened(device))
        self._configure(settings)
        try:
            # After the format: some drivers set their controls to the defaults with it.
            set_exposure(device, settings.exposure_us, settings.gain)
        except (ControlError, OSError) as error:
            self._capture.release()
            raise SourceError(f"{device}: {error}") from error

    def _configure(self, settings: SourceSettings) -> None:
        capture = self._capture
        # The pixel format first: the sizes and rates that the driver offers depend on it.
        if settings.pixel_format is not None:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.pixel_format))
        if settings.width is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, settings.width)
        if settings.height is not None:
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, settings.height)
        if settings.rate_hz is not None:
            capture.set(cv2.CAP_PROP_FPS, settings.rate_hz)
        width = round(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        rate_hz = capture.get(cv2.CAP_PROP_FPS)
        pixel_format = fourcc_text(int(capture.get(cv2.CAP_PROP_FOURCC)))
        if pixel_format == _GREY_16:  # else OpenCV delivers the upper byte
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        refused = [
            f"{name} {requested}"
            for name, requested, actual in (
                ("width", settings.width, width),
                ("height", settings.height, height),
                ("pixel_format", settings.pixel_format, pixel_format),
            )
            if requested is not None and requested != actual
        ]
        if settings.rate_hz is not None and abs(settings.rate_hz - rate_hz) > 0.5:
            refused.append(f"rate_hz {settings.rate_hz:g}")
        actual_text = f"{width}x{height} {pixel_format} at {rate_hz:g} Hz"
        if refused:
            logger.warning("%s: set to %s; not accepted: %s", self._device, actual_text, ", ".join(refused))
        else:
            logger.info("%s: set to %s", self._device, actual_text)

    def read(self, timeout_s: float) -> RawFrame | None:
        image, now_ns, decode_ms = read_capture(self._capture, str(self._device))
        if image is None:
            raise CaptureError(f"the camera delivered no frame{_why_silent(self._device)}")
        driver_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        captured_ns = driver_ns if 0 <= now_ns - driver_ns < _OLDEST_STAMP_NS else now_ns
        return RawFrame(image, captured_ns, decode_ms=decode_ms)

    def close(self) -> None:
        self._capture.release()


def _unopened(device: Path) -> str:
    if held_by := holders(device):
        return f"it is busy: {', '.join(held_by)} has it open"
    return (
        "it does not open as a camera; another user's program may be using it, or it is a camera's metadata "
        "node (see `companion describe cameras`)"
    )


def _why_silent(device: Path) -> str:
    """V4L2 lets several programs open a camera and only one stream; OpenCV does not report which failed."""
    if not device.exists():
        return "; it was unplugged"
    held_by = holders(device)
    return f"; it is busy: {', '.join(held_by)} has it open" if held_by else ""
