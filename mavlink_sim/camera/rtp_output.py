"""H.264 in RTP (RFC 6184), payload type 96, as PX4's Gazebo camera sends to UDP 5600."""

from __future__ import annotations

import logging
from fractions import Fraction
from typing import Any

from mavlink_sim.camera.newest_frame import NewestFrame
from vision.frame import Frame

logger = logging.getLogger(__name__)

CLOCK_HZ = 90_000
PACKET_BYTES = 1400
BITS_PER_PIXEL = 0.2
"""Sets the bit rate: 640×480 at 30 Hz is about 1.8 Mbit/s."""


class RtpOutput:
    """Sends to one host and port, which may be a multicast group.

    Raises (when made):
        ValueError: a size that H.264 with subsampled colour does not support.
        ModuleNotFoundError: PyAV is not installed (`check_output` says what to install), or it has no H.264
            encoder.
    """

    def __init__(self, host: str, port: int, width: int, height: int, rate_hz: float) -> None:
        if width % 2 or height % 2:
            raise ValueError(f"H.264 needs even sides, got {width}x{height}")
        import av

        if "libx264" not in av.codecs_available:
            raise ModuleNotFoundError(
                "this PyAV was built without libx264, which encodes the stream", name="av"
            )
        self._av: Any = av
        address = f"[{host}]" if ":" in host else host
        self._container: Any = av.open(f"rtp://{address}:{port}?pkt_size={PACKET_BYTES}", "w", format="rtp")
        rate = max(1, round(rate_hz))
        stream: Any = self._container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.time_base = Fraction(1, CLOCK_HZ)
        stream.codec_context.gop_size = rate
        stream.bit_rate = round(BITS_PER_PIXEL * width * height * rate)
        stream.options = {"preset": "ultrafast", "tune": "zerolatency", "profile": "baseline"}
        self._stream = stream
        self._first_ns: int | None = None
        self._last_pts = -1
        self._failed = False
        self._thread: NewestFrame | None = NewestFrame(f"rtp {port}", self._send)

    def write(self, frame: Frame) -> None:
        if self._thread is not None:
            self._thread.put(frame)

    def close(self) -> None:
        if self._thread is not None:
            self._thread.close()
            self._thread = None
            self._container.close()

    def _send(self, frame: Frame) -> None:
        if self._first_ns is None:
            self._first_ns = frame.captured_ns
        pts = (frame.captured_ns - self._first_ns) * CLOCK_HZ // 1_000_000_000
        if pts <= self._last_pts:
            return  # RTP needs increasing stamps
        self._last_pts = pts
        image = self._av.VideoFrame.from_ndarray(frame.image, format="bgr24").reformat(format="yuv420p")
        image.pts, image.time_base = pts, Fraction(1, CLOCK_HZ)
        try:
            for packet in self._stream.encode(image):
                self._container.mux(packet)
        except OSError as error:  # no listener on a port of this host, or the network is down
            if not self._failed:
                logger.warning("sending RTP failed: %s; retrying with every frame", error)
            self._failed = True
        else:
            self._failed = False
