"""The outputs of a camera: shared memory, a pipe, Motion JPEG over HTTP, H.264 in RTP. One address each.

| address | content |
|---|---|
| `shm://NAME` | colour, depth and stamps (`vision.shared_frame`) |
| `pipe:PATH` | raw bgr24 images through a FIFO, created if missing; `pipe:-` is standard output |
| `http://HOST:PORT` | Motion JPEG at `/` (`multipart/x-mixed-replace`), one image at `/snapshot.jpg` |
| `rtp://HOST:PORT` | H.264 in RTP (RFC 6184), payload type 96, as PX4's Gazebo camera sends to UDP 5600 |

A slow or stopped reader loses frames; it never delays the camera or another reader.
"""

from __future__ import annotations

import logging
from importlib.util import find_spec
from typing import Protocol
from urllib.parse import urlsplit

from mavlink_sim.camera.mjpeg_output import MjpegOutput
from mavlink_sim.camera.pipe_output import PipeOutput
from mavlink_sim.camera.rtp_output import RtpOutput
from vision.camera_model import CameraCalibration
from vision.extras import install_command
from vision.frame import Frame
from vision.shared_frame import SharedFrameWriter, segment_path

logger = logging.getLogger(__name__)


SCHEMES = ("shm://NAME", "pipe:PATH", "pipe:-", "http://HOST:PORT", "rtp://HOST:PORT")
STANDARD_OUTPUT = "pipe:-"


class FrameOutput(Protocol):
    """An output of frames. `write` does not block; `close` may be called more than once."""

    def write(self, frame: Frame) -> None: ...

    def close(self) -> None: ...


def check_output(address: str) -> None:
    """Raise ValueError for an address that `open_output` does not support, or not as installed."""
    parts = urlsplit(address)
    if parts.scheme == "shm":
        segment_path(parts.netloc + parts.path)
    elif parts.scheme == "pipe":
        if not parts.path:
            raise ValueError(f"output {address!r}: expected pipe:PATH of a FIFO or pipe:- (standard output)")
    elif parts.scheme in ("http", "rtp"):
        _host_and_port(address)
        # Before a camera's process starts: the vehicle would fly on without its camera.
        if parts.scheme == "rtp" and find_spec("av") is None:
            raise ValueError(f"output {address!r}: H.264 needs PyAV: {install_command('av')}")
    else:
        raise ValueError(f"output {address!r}: expected one of {', '.join(SCHEMES)}")


def _host_and_port(address: str) -> tuple[str, int]:
    parts = urlsplit(address)
    try:
        port = parts.port
    except ValueError:
        port = None
    low = 0 if parts.scheme == "http" else 1
    if not parts.hostname or port is None or port < low:
        raise ValueError(f"output {address!r}: expected {parts.scheme}://HOST:PORT with a port up to 65535")
    return parts.hostname, port


def open_output(
    address: str,
    width: int,
    height: int,
    rate_hz: float,
    *,
    depth: bool = True,
    calibration: CameraCalibration | None = None,
) -> FrameOutput:
    """The output at an address (see the module's table).

    Args:
        width, height: of the frames to come.
        rate_hz: their rate, for encoders.
        depth: whether the frames have depth; only shared memory transports it.
        calibration: the camera's lens and mount; only shared memory transports them.

    Raises:
        ValueError: an invalid address, or RTP without the package that encodes it.
        OSError: a port or name that is taken.
        ModuleNotFoundError: that package has no H.264 encoder.
    """
    check_output(address)
    parts = urlsplit(address)
    if parts.scheme == "shm":
        return SharedFrameWriter(
            parts.netloc + parts.path, width, height, depth=depth, calibration=calibration
        )
    if parts.scheme == "pipe":
        return PipeOutput(parts.path)
    host, port = _host_and_port(address)
    if parts.scheme == "http":
        return MjpegOutput(host, port)
    return RtpOutput(host, port, width, height, rate_hz)
