"""Raw frames in a byte stream: nothing but pixels, of a size that both ends know."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.sources.source import RAW_PIXEL_FORMATS


class StreamError(Exception):
    """The bytes are not what they should be."""


class StreamParser(Protocol):
    """Turns bytes, in pieces of any size, into pictures."""

    @property
    def unreadable(self) -> int:
        """Pictures found that could not be decoded."""
        ...

    @property
    def rate_hz(self) -> float | None:
        """The rate the stream itself claims, if it does."""
        ...

    def push(self, data: bytes) -> list[NDArray[np.uint8]]:
        """Take more bytes; the pictures they complete, (height, width, 3) BGR.

        Raises:
            StreamError: the bytes break the format; the stream cannot go on.
        """
        ...

    def leftover(self) -> str:
        """At the end of the stream: what is incomplete, in words; empty if nothing is."""
        ...


class RawParser:
    """Frames of `width` × `height` pixels in `bgr24`, `rgb24` or `gray8`, one after another."""

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
        pictures = [self._picture(self._buffer[i * size : (i + 1) * size]) for i in range(count)]
        if count:
            del self._buffer[: count * size]
        return pictures

    def _picture(self, data: bytearray) -> NDArray[np.uint8]:
        pixels = np.frombuffer(data, np.uint8).reshape(self._height, self._width, self._channels)
        if self._format == "bgr24":
            return pixels  # the slice was a copy, the reader's own to write on
        code = cv2.COLOR_RGB2BGR if self._format == "rgb24" else cv2.COLOR_GRAY2BGR
        return np.asarray(cv2.cvtColor(pixels, code), dtype=np.uint8)

    def leftover(self) -> str:
        if not self._buffer:
            return ""
        return (
            f"the last frame is incomplete: {len(self._buffer)} of {self._frame_bytes} bytes "
            f"({self._width}x{self._height} {self._format}); is the size right?"
        )
