"""Raw frames in a byte stream: only pixels, of a size known to both ends."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.sources.source import RAW_PIXEL_FORMATS


class StreamError(Exception):
    """The bytes do not follow the format."""


class StreamParser(Protocol):
    """Decodes bytes, received in pieces of any size, into images."""

    @property
    def unreadable(self) -> int:
        """Images that could not be decoded."""
        ...

    @property
    def rate_hz(self) -> float | None:
        """The frame rate in the stream's header, if it has one."""
        ...

    def push(self, data: bytes) -> list[NDArray[np.uint8]]:
        """Add bytes; returns the images they complete, (height, width, 3) BGR.

        Raises:
            StreamError: the bytes break the format; the stream cannot continue.
        """
        ...

    def leftover(self) -> str:
        """At the end of the stream: what is incomplete, in words; empty if nothing."""
        ...


class RawParser:
    """Consecutive frames of `width` × `height` pixels in `bgr24`, `rgb24` or `gray8`."""

    unreadable = 0
    rate_hz: float | None = None

    def __init__(self, width: int, height: int, pixel_format: str) -> None:
        self._width = width
        self._height = height
        self._format = pixel_format
        self._channels = RAW_PIXEL_FORMATS[pixel_format]
        self._frame_bytes = width * height * self._channels
        self._buffer = bytearray()

    def push(self, data: bytes) -> list[NDArray[np.uint8]]:
        self._buffer += data
        size = self._frame_bytes
        count = len(self._buffer) // size
        images = [self._decode(self._buffer[i * size : (i + 1) * size]) for i in range(count)]
        if count:
            del self._buffer[: count * size]
        return images

    def _decode(self, data: bytearray) -> NDArray[np.uint8]:
        pixels = np.frombuffer(data, np.uint8).reshape(self._height, self._width, self._channels)
        if self._format == "bgr24":
            return pixels  # the slice is a copy, so it is writable
        code = cv2.COLOR_RGB2BGR if self._format == "rgb24" else cv2.COLOR_GRAY2BGR
        return np.asarray(cv2.cvtColor(pixels, code), dtype=np.uint8)

    def leftover(self) -> str:
        if not self._buffer:
            return ""
        return (
            f"the last frame is incomplete: {len(self._buffer)} of {self._frame_bytes} bytes "
            f"({self._width}x{self._height} {self._format}); check width and height"
        )
