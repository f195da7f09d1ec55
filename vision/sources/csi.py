"""Cameras on a board's CSI connector, `csi://0`, through the board's own program.

On a Raspberry Pi that is rpicam-vid, on a Jetson gst-launch-1.0 with nvarguscamerasrc: the sensor needs the
board's image processor, which OpenCV does not operate. The program writes images into a pipe. It is our
child: it ends with this process, however that ends, and is started again when it ends itself.

Not tested with a real camera: the tests use stand-in programs with the same arguments and output.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from vision.sources.capture import Capture, CaptureError, RawFrame
from vision.sources.pipe import PipeCapture, check_pipe_settings
from vision.sources.source import SourceError, SourceSettings
from vision.sources.v4l2 import VideoDevice

DEFAULT_SIZE, DEFAULT_RATE_HZ = (1280, 720), 30.0
"""Of a CSI camera without width and height, or rate_hz."""
_ALIGNMENT_PX = 64  # rows of yuv420 are padded to a multiple of this (kernel driver bcm2835-isp)
_END_S = 2.0
_KEPT_TEXT = 4000  # bytes of the program's messages
# Lets the kernel send SIGINT to the program when the thread that started it ends, then becomes the program.
# SIGINT ends both programs in order; it is ignored in a perception worker, which a child would inherit.
_LAUNCHER = """
import ctypes, os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)
ctypes.CDLL(None).prctl(1, signal.SIGINT)  # PR_SET_PDEATHSIG
if os.getppid() == int(sys.argv[1]):  # else it has died before
    os.execvp(sys.argv[2], sys.argv[2:])
"""

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
            modes; the image may have any smaller size.
    """

    number: int
    sensor: str
    modes: tuple[tuple[int, int, float | None], ...] = ()


def csi_cameras(devices: Sequence[VideoDevice]) -> tuple[CsiCamera, ...]:
    """The CSI cameras of a Raspberry Pi, from rpicam-hello, or of a Jetson, from its V4L2 nodes.

    Empty on other boards, and without rpicam-hello.
    """
    if program := shutil.which("rpicam-hello"):
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


def parse_csi_number(uri: str) -> int:
    """The camera's number in `csi://N`. Raises SourceError."""
    number = uri.partition("://")[2]
    if not (number.isascii() and number.isdecimal()):
        raise SourceError(f"{uri}: expected csi://NUMBER (see `companion describe cameras`)")
    return int(number)


def csi_settings(uri: str, settings: SourceSettings) -> SourceSettings:
    """The settings of the pipe: with size, rate and pixel format. Raises SourceError for invalid ones."""
    pixel_format = settings.pixel_format or "yuv420"
    if pixel_format not in ("yuv420", "mjpeg"):
        raise SourceError(f"{uri}: pixel_format must be yuv420 or mjpeg, got {pixel_format!r}")
    if (settings.width is None) != (settings.height is None):
        raise SourceError(f"{uri}: give both width and height, or neither")
    width, height = settings.width or DEFAULT_SIZE[0], settings.height or DEFAULT_SIZE[1]
    if pixel_format == "yuv420" and width % _ALIGNMENT_PX:
        raise SourceError(
            f"{uri}: yuv420 needs a width that is a multiple of {_ALIGNMENT_PX}, got {width}; use another "
            f"width, or pixel_format mjpeg"
        )
    rate_hz = settings.rate_hz or DEFAULT_RATE_HZ
    wanted = replace(settings, width=width, height=height, rate_hz=rate_hz, pixel_format=pixel_format)
    check_pipe_settings(uri, wanted)
    return wanted


class CsiCapture(Capture):
    """Frames of a CSI camera, from a child process. A stamp is the arrival of the frame's last byte.

    Args:
        settings: of `csi_settings`.

    Raises:
        SourceError: the board's program is not installed.
        CaptureError: it cannot be started.
    """

    def __init__(self, number: int, settings: SourceSettings) -> None:
        readable, writable = os.pipe()
        try:
            self._words = _command(number, settings, writable)
            to_stdout = self._words[0] == "rpicam-vid"
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _LAUNCHER, str(os.getpid()), *self._words],
                stdin=subprocess.DEVNULL,
                # The Jetson's camera library writes messages to standard output.
                stdout=writable if to_stdout else subprocess.PIPE,
                stderr=subprocess.PIPE if to_stdout else subprocess.STDOUT,
                pass_fds=(writable,),
                process_group=0,  # Ctrl-C in the terminal is for us
            )
        except BaseException as error:
            os.close(readable)
            if isinstance(error, OSError):
                raise CaptureError(f"{sys.executable} cannot be started: {error.strerror}") from error
            raise
        finally:
            os.close(writable)
        messages = self._process.stderr or self._process.stdout
        assert messages is not None
        self._messages = messages
        os.set_blocking(messages.fileno(), False)
        self._text = b""
        self._pipe = PipeCapture(readable, settings, end_is_loss=True)

    def read(self, timeout_s: float) -> RawFrame | None:
        self._read_messages()
        try:
            raw = self._pipe.read(timeout_s)
        except CaptureError as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_END_S)
            self._read_messages()
            raise CaptureError(self._reason(str(error))) from error
        self.unreadable = self._pipe.unreadable
        # A live camera has no time of a recording.
        return None if raw is None else replace(raw, media_s=None)

    def _read_messages(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self._messages.fileno(), 65536):
                self._text = (self._text + data)[-_KEPT_TEXT:]

    def _reason(self, otherwise: str) -> str:
        """Why the program ended: its own message, an error if there is one."""
        lines = [line.strip() for line in self._text.decode(errors="replace").splitlines() if line.strip()]
        errors = [line for line in lines if "error" in line.lower()]
        message = (errors or lines or [otherwise])[-1]
        hint = ""
        if "no element" in message:
            hint = "; nvarguscamerasrc and nvvidconv are in the package nvidia-l4t-gstreamer"
        code = self._process.poll()
        how = "stopped writing" if code is None else f"ended with code {code}"
        return f"{self._words[0]} {how}: {message}{hint}"

    def close(self) -> None:
        self._pipe.close()
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._messages.close()


def check_csi_program(uri: str) -> None:
    """Raises SourceError if the board has no program that reads a CSI camera."""
    if not any(map(shutil.which, ("rpicam-vid", "gst-launch-1.0"))):
        raise SourceError(
            f"{uri}: no program reads a CSI camera here: install rpicam-vid (package rpicam-apps) on a "
            f"Raspberry Pi, or gst-launch-1.0 (packages gstreamer1.0-tools, nvidia-l4t-gstreamer) on a Jetson"
        )


def _command(number: int, settings: SourceSettings, descriptor: int) -> list[str]:
    """The program and its arguments; it writes to standard output (rpicam-vid) or to `descriptor`."""
    width, height, rate_hz = settings.width, settings.height, settings.rate_hz or DEFAULT_RATE_HZ
    mjpeg, exposure_us, gain = settings.pixel_format == "mjpeg", settings.exposure_us, settings.gain
    if shutil.which("rpicam-vid"):
        words = f"rpicam-vid --camera {number} --timeout 0 --nopreview --flush --output - --width {width} "
        words += f"--height {height} --framerate {rate_hz:g} --codec {'mjpeg' if mjpeg else 'yuv420'}"
        if exposure_us is not None:
            words += f" --shutter {exposure_us:.0f}"
        if gain is not None:
            words += f" --gain {gain:g}"
        return words.split()
    rate = Fraction(rate_hz).limit_denominator(1001)
    camera = ["gst-launch-1.0", "-q", "nvarguscamerasrc", f"sensor-id={number}"]
    if exposure_us is not None:  # a range of nanoseconds
        camera.append(f"exposuretimerange={exposure_us * 1000:.0f} {exposure_us * 1000:.0f}")
    if gain is not None:
        camera.append(f"gainrange={gain:g} {gain:g}")
    words = f"! video/x-raw(memory:NVMM),format=NV12,width={width},height={height},"
    words += f"framerate={rate.numerator}/{rate.denominator} ! "
    words += "nvjpegenc" if mjpeg else "nvvidconv ! video/x-raw,format=I420"
    return [*camera, *words.split(), "!", "fdsink", f"fd={descriptor}"]
