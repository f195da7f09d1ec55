"""The outputs of a camera: shared memory, a pipe, Motion JPEG over HTTP, H.264 in RTP. One address each.

| address | content |
|---|---|
| `shm://NAME` | colour, depth and stamps (`vision.shared_frame`) |
| `pipe:PATH` | raw bgr24 images through a FIFO, created if missing; `pipe:-` is standard output |
| `http://HOST:PORT` | Motion JPEG at `/`, one image at `/snapshot.jpg` |
| `rtp://HOST:PORT` | H.264 in RTP (RFC 6184), payload type 96, as PX4's Gazebo camera sends to UDP 5600 |

A slow or stopped reader loses frames; it never delays the camera or another reader. An output's module is
imported when it is opened: a vehicle without a camera starts in half the time without these libraries.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from vision.camera_model import CameraCalibration
    from vision.frame import Frame

SCHEMES = ("shm://NAME", "pipe:PATH", "pipe:-", "http://HOST:PORT", "rtp://HOST:PORT")
STANDARD_OUTPUT = "pipe:-"


class FrameOutput(Protocol):
    """An output of frames. `write` does not block; `close` may be called more than once."""

    def write(self, frame: Frame) -> None: ...

    def close(self) -> None: ...


def check_output(address: str) -> None:
    """Raise ValueError for an address that `open_output` does not support."""
    parts = urlsplit(address)
    if parts.scheme == "shm":
        from vision.shared_frame import segment_path

        segment_path(parts.netloc + parts.path)
    elif parts.scheme == "pipe":
        if not parts.path:
            raise ValueError(f"output {address!r}: expected pipe:PATH of a FIFO or pipe:- (standard output)")
    elif parts.scheme in ("http", "rtp"):
        _host_and_port(address)
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
        ValueError: an invalid address.
        OSError: a port or name that is taken.
        ModuleNotFoundError: RTP without the package that encodes it.
    """
    check_output(address)
    parts = urlsplit(address)
    if parts.scheme == "shm":
        from vision.shared_frame import SharedFrameWriter

        return SharedFrameWriter(
            parts.netloc + parts.path, width, height, depth=depth, calibration=calibration
        )
    if parts.scheme == "pipe":
        from mavlink_sim.camera.pipe_output import PipeOutput

        return PipeOutput(parts.path)
    host, port = _host_and_port(address)
    if parts.scheme == "http":
        from mavlink_sim.camera.mjpeg_output import MjpegOutput

        return MjpegOutput(host, port)
    from mavlink_sim.camera.rtp_output import RtpOutput

    return RtpOutput(host, port, width, height, rate_hz)
