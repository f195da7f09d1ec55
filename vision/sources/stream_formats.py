"""Images in a byte stream: raw pixels, YUV4MPEG2 and Motion JPEG, decoded from pieces of any size."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.image_file import decode_image
from vision.sources.source import RAW_PIXEL_FORMATS

logger = logging.getLogger(__name__)

MAGIC = b"YUV4MPEG2"
_LINE_LIMIT = 4096  # bytes; the specification has no limit, a line this long is not a header
# Horizontal and vertical chroma subsampling, and whether an alpha plane follows. None: no chroma.
_COLOUR_SPACES: dict[str, tuple[tuple[int, int] | None, bool]] = {
    "420": ((2, 2), False),
    "420jpeg": ((2, 2), False),
    "420mpeg2": ((2, 2), False),
    "420paldv": ((2, 2), False),
    "411": ((4, 1), False),
    "422": ((2, 1), False),
    "440": ((1, 2), False),
    "444": ((1, 1), False),
    "444alpha": ((1, 1), True),
    "mono": (None, False),
}
_LUMA_TO_FULL = np.clip(np.rint((np.arange(256) - 16) * 255.0 / 219.0), 0, 255).astype(np.uint8)
_CHROMA_TO_FULL = np.clip(np.rint((np.arange(256) - 128) * 255.0 / 224.0 + 128), 0, 255).astype(np.uint8)
_START = b"\xff\xd8\xff"  # SOI and the first byte of the next marker
_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]", re.DOTALL)
_SOI, _EOI, _SOS, _TEM = 0xD8, 0xD9, 0xDA, 0x01
_LARGEST_IMAGE = 64 << 20  # bytes; more without an end is not a JPEG


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
    """Consecutive frames of `width` × `height` pixels in `bgr24`, `rgb24`, `gray8` or `yuv420`.

    `yuv420` is I420: the planes Y, U and V without padding, BT.601 in the limited range. Of depth in
    `gray16`, little-endian, (height, width) uint16 are returned.
    """

    unreadable = 0
    rate_hz: float | None = None

    def __init__(self, width: int, height: int, pixel_format: str) -> None:
        self._width = width
        self._height = height
        self._format = pixel_format
        self._frame_bytes = int(width * height * RAW_PIXEL_FORMATS[pixel_format])
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
        pixels = np.frombuffer(data, np.uint8)
        if self._format == "gray16":  # depth, which `DepthCapture` converts
            depth: NDArray[Any] = np.frombuffer(data, "<u2").reshape(self._height, self._width)
            return depth
        if self._format == "bgr24":
            return pixels.reshape(self._height, self._width, 3)  # the slice is a copy, so it is writable
        code, shape = {
            "rgb24": (cv2.COLOR_RGB2BGR, (self._height, self._width, 3)),
            "gray8": (cv2.COLOR_GRAY2BGR, (self._height, self._width)),
            "yuv420": (cv2.COLOR_YUV2BGR_I420, (self._height * 3 // 2, self._width)),
        }[self._format]
        return np.asarray(cv2.cvtColor(pixels.reshape(shape), code), dtype=np.uint8)

    def leftover(self) -> str:
        if not self._buffer:
            return ""
        return (
            f"the last frame is incomplete: {len(self._buffer)} of {self._frame_bytes} bytes "
            f"({self._width}x{self._height} {self._format}); check width and height"
        )


@dataclass(frozen=True, slots=True)
class Y4mHeader:
    """The stream's first line. `subsampling` is chroma's divisor in x and y, None without chroma."""

    width: int
    height: int
    rate_hz: float | None
    subsampling: tuple[int, int] | None
    alpha: bool
    full_range: bool
    interlaced: bool

    @property
    def chroma_size(self) -> tuple[int, int]:
        """Width and height of one chroma plane, rounded up; (0, 0) without chroma."""
        if self.subsampling is None:
            return 0, 0
        across, down = self.subsampling
        return -(-self.width // across), -(-self.height // down)

    @property
    def frame_bytes(self) -> int:
        chroma_width, chroma_height = self.chroma_size
        luma = self.width * self.height
        return luma * (2 if self.alpha else 1) + 2 * chroma_width * chroma_height


def parse_y4m_header(line: bytes) -> Y4mHeader:
    """Parse the stream's first line, without its line feed.

    Raises:
        StreamError: not a header, no valid size, or an unsupported colour space.
    """
    words = line.decode("ascii", "replace").split(" ")
    if words[0] != MAGIC.decode():
        raise StreamError(f"not a YUV4MPEG2 header: {line[:40]!r}")
    values: dict[str, str] = {}
    full_range = False
    for word in filter(None, words[1:]):
        if word[0] == "X":
            full_range |= word.upper() == "XCOLORRANGE=FULL"
        else:
            values[word[0]] = word[1:]
    name = values.get("C", "420")
    if name not in _COLOUR_SPACES:
        raise StreamError(
            f"colour space C{name} is not supported, only 8-bit {', '.join(_COLOUR_SPACES)}; "
            f"convert it, for example with ffmpeg -pix_fmt yuv420p"
        )
    subsampling, alpha = _COLOUR_SPACES[name]
    return Y4mHeader(
        _size(values, "W", "width"),
        _size(values, "H", "height"),
        _rate(values.get("F", "0:0")),
        subsampling,
        alpha,
        full_range,
        values.get("I", "?")[:1] in ("t", "b", "m"),
    )


def _size(values: dict[str, str], letter: str, name: str) -> int:
    text = values.get(letter, "")
    if not (text.isascii() and text.isdecimal() and 1 <= int(text) <= 32768):
        raise StreamError(f"the header has no {name} from 1 to 32768: {letter}{text}")
    return int(text)


def _rate(text: str) -> float | None:
    above, _, below = text.partition(":")
    if not (above.isdecimal() and below.isdecimal()) or int(above) == 0 or int(below) == 0:
        return None
    return int(above) / int(below)


def bgr_from_planes(data: bytes, header: Y4mHeader) -> NDArray[np.uint8]:
    """(height, width, 3) BGR of one frame's planes, which are consecutive in `data`."""
    width, height = header.width, header.height
    planes = np.frombuffer(data, np.uint8)
    luma = planes[: width * height].reshape(height, width)
    even = width % 2 == 0 and height % 2 == 0
    if header.subsampling == (2, 2) and even and not header.full_range:
        return np.asarray(
            cv2.cvtColor(planes.reshape(height * 3 // 2, width), cv2.COLOR_YUV2BGR_I420), dtype=np.uint8
        )
    if not header.full_range:
        luma = np.asarray(cv2.LUT(luma, _LUMA_TO_FULL), dtype=np.uint8)
    if header.subsampling is None:
        return np.asarray(cv2.cvtColor(luma, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    chroma_width, chroma_height = header.chroma_size
    size = chroma_width * chroma_height
    chroma = []
    for index in range(2):
        start = width * height + index * size
        plane = planes[start : start + size].reshape(chroma_height, chroma_width)
        if not header.full_range:
            plane = np.asarray(cv2.LUT(plane, _CHROMA_TO_FULL), dtype=np.uint8)
        across, down = header.subsampling
        whole = np.repeat(np.repeat(plane, down, axis=0), across, axis=1)[:height, :width]
        chroma.append(whole)
    blue_difference, red_difference = chroma
    merged = cv2.merge([luma, red_difference, blue_difference])
    return np.asarray(cv2.cvtColor(merged, cv2.COLOR_YCrCb2BGR), dtype=np.uint8)


class Y4mParser:
    """Decodes a YUV4MPEG2 stream received in pieces of any size."""

    unreadable = 0
    rate_hz: float | None = None

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._header: Y4mHeader | None = None
        self._in_frame = False

    def push(self, data: bytes) -> list[NDArray[np.uint8]]:
        self._buffer += data
        images = []
        position = 0
        while True:
            if self._in_frame and self._header is not None:
                end = position + self._header.frame_bytes
                if end > len(self._buffer):
                    break
                images.append(bgr_from_planes(bytes(self._buffer[position:end]), self._header))
                self._in_frame = False
                position = end
                continue
            end = self._buffer.find(b"\n", position, position + _LINE_LIMIT)
            if end < 0:
                if len(self._buffer) - position >= _LINE_LIMIT:
                    raise StreamError(
                        f"no line of YUV4MPEG2 within {_LINE_LIMIT} bytes; it may be another format"
                    )
                break
            self._parse_line(bytes(self._buffer[position:end]))
            position = end + 1
        del self._buffer[:position]
        return images

    def _parse_line(self, line: bytes) -> None:
        if self._header is not None and (line == b"FRAME" or line.startswith(b"FRAME ")):
            self._in_frame = True
        elif line.startswith(MAGIC):  # also between frames: a new writer on the same pipe
            self._header = parse_y4m_header(line)
            self.rate_hz = self._header.rate_hz
            if self._header.interlaced:
                logger.warning("the YUV4MPEG2 stream is interlaced; its fields are not deinterlaced")
        else:
            expected = "FRAME" if self._header else MAGIC.decode()
            raise StreamError(f"expected a line {expected!r} of YUV4MPEG2, got {line[:40]!r}")

    def leftover(self) -> str:
        if self._in_frame and self._header is not None:
            return f"the last frame is incomplete: {len(self._buffer)} of {self._header.frame_bytes} bytes"
        if self._buffer:
            return f"{len(self._buffer)} bytes of an incomplete line"
        return ""


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
