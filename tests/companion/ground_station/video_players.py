"""Real players, each in a process of its own, which print the pixels that they decode."""

from __future__ import annotations

import asyncio
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress

import imageio_ffmpeg  # type: ignore[import-untyped]
import numpy as np
import numpy.typing as npt

WIDTH, HEIGHT = 160, 128
_SIZE = WIDTH * HEIGHT * 3


class Player:
    """A running player. Its images are `WIDTH` by `HEIGHT`, BGR."""

    def __init__(self, process: Process) -> None:
        self.process = process

    async def image(self) -> npt.NDArray[np.uint8]:
        """Return the next decoded image."""
        assert self.process.stdout is not None
        data = await self.process.stdout.readexactly(_SIZE)
        return np.frombuffer(data, np.uint8).reshape(HEIGHT, WIDTH, 3)


@asynccontextmanager
async def _playing(*command: str) -> AsyncIterator[Player]:
    process = await asyncio.create_subprocess_exec(*command, stdin=DEVNULL, stdout=PIPE, stderr=DEVNULL)
    try:
        yield Player(process)
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        await process.communicate()  # reads to the end: else a full pipe keeps it


def ffmpeg(uri: str, transport: str) -> AbstractAsyncContextManager[Player]:
    """Play with ffmpeg. `transport`: tcp or udp."""
    quick = ("-fflags", "nobuffer", "-analyzeduration", "300000")
    raw = ("-fps_mode", "passthrough", "-f", "rawvideo", "-pix_fmt", "bgr24", "-")
    return _playing(imageio_ffmpeg.get_ffmpeg_exe(), "-rtsp_transport", transport, *quick, "-i", uri, *raw)


def gstreamer(uri: str, transport: str, decoder: str) -> AbstractAsyncContextManager[Player]:
    """Play with GStreamer. `decoder`: its elements from RTP on."""
    elements = f"rtspsrc location={uri} protocols={transport} latency=0 ! {decoder} ! videoconvert"
    return _playing(
        "gst-launch-1.0", "-q", *elements.split(), "!", "video/x-raw,format=BGR", "!", "fdsink", "sync=false"
    )
