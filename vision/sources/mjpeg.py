"""Motion JPEG: consecutive JPEG images, with or without other bytes between them.

Images are found by walking their segments (ITU-T T.81, annex B): segments with a length are skipped, so
markers of a thumbnail inside APPn are ignored, and in the entropy-coded data only a true marker (not FF00,
not a restart) counts.
"""

from __future__ import annotations

import logging
import re

import numpy as np
from numpy.typing import NDArray

from vision.sources.images import decode_image

logger = logging.getLogger(__name__)

_START = b"\xff\xd8\xff"  # SOI and the first byte of the next marker
_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]", re.DOTALL)
_SOI, _EOI, _SOS, _TEM = 0xD8, 0xD9, 0xDA, 0x01
_LARGEST_IMAGE = 64 << 20  # bytes; more without an end is not a JPEG


class MjpegSplitter:
    """Splits a stream, received in pieces of any size, into complete JPEG images.

    Attributes:
        damaged: images that started and were not completed.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._buffer = bytearray()
        self._inside = False  # an image starts at the buffer's first byte
        self._position = 0
        self._in_scan = False

    def push(self, data: bytes) -> list[bytes]:
        """Add bytes; returns the images they complete."""
        self._buffer += data
        images: list[bytes] = []
        while self._find_start():
            length = self._walk()
            if length is None:
                if len(self._buffer) <= _LARGEST_IMAGE:
                    break
                self._discard(len(self._buffer))
            elif length > 0:
                images.append(bytes(self._buffer[:length]))
                del self._buffer[:length]
                self._inside = False
        return images

    @property
    def pending(self) -> int:
        """Bytes of the incomplete image."""
        return len(self._buffer) if self._inside else 0

    def _find_start(self) -> bool:
        if self._inside:
            return True
        start = self._buffer.find(_START)
        if start < 0:
            del self._buffer[: max(len(self._buffer) - (len(_START) - 1), 0)]
            return False
        del self._buffer[:start]
        self._inside, self._in_scan, self._position = True, False, 2
        return True

    def _discard(self, at: int) -> None:
        """Discard the current image and search for the next from byte `at`."""
        self.damaged += 1
        del self._buffer[:at]
        self._inside = False

    def _walk(self) -> int | None:
        """Walk the segments: the image's length, None if bytes are missing, 0 if it was discarded."""
        buffer = self._buffer
        while True:
            if self._in_scan:
                found = _MARKER.search(buffer, self._position)
                if found is None:
                    self._position = max(self._position, len(buffer) - 1)
                    return None
                self._position = found.start()
                self._in_scan = False
            at = self._position
            if at + 2 > len(buffer):
                return None
            if buffer[at] != 0xFF:
                self._discard(at)
                return 0
            code = buffer[at + 1]
            if code == 0xFF:  # fill byte
                self._position = at + 1
            elif code == _EOI:
                return at + 2
            elif code == _SOI or code == 0x00:
                self._discard(at)
                return 0
            elif code == _TEM or 0xD0 <= code <= 0xD7:  # markers without a length
                self._position = at + 2
            else:
                if at + 4 > len(buffer):
                    return None
                length = int.from_bytes(buffer[at + 2 : at + 4], "big")
                if length < 2:
                    self._discard(at + 2)
                    return 0
                if at + 2 + length > len(buffer):
                    return None
                self._position = at + 2 + length
                self._in_scan = code == _SOS


class MjpegParser:
    """Decodes Motion JPEG. An image that cannot be decoded is counted and skipped."""

    rate_hz: float | None = None

    def __init__(self) -> None:
        self._splitter = MjpegSplitter()
        self._undecodable = 0
        self._next_warning = 1

    @property
    def unreadable(self) -> int:
        return self._undecodable + self._splitter.damaged

    def push(self, data: bytes) -> list[NDArray[np.uint8]]:
        decoded = []
        for jpeg in self._splitter.push(data):
            image = decode_image(jpeg)
            if image is None:
                self._undecodable += 1
            else:
                decoded.append(image)
        if self.unreadable >= self._next_warning:
            logger.warning("MJPEG: %d damaged images skipped so far", self.unreadable)
            self._next_warning = self.unreadable * 10  # a bad cable must not fill the log
        return decoded

    def leftover(self) -> str:
        pending = self._splitter.pending
        return f"the last image is incomplete ({pending} bytes)" if pending else ""
