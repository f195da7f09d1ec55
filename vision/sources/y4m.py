"""YUV4MPEG2, the uncompressed video stream of mjpegtools (`yuv4mpeg(5)`), as written by ffmpeg and GStreamer.

A line `YUV4MPEG2 W640 H480 F30:1 C420jpeg …`, then for every frame a line `FRAME …` and its planes: luma,
then the two chroma planes. Colours are BT.601; the range is the broadcast one (16..235) unless
`XCOLORRANGE=FULL`.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.sources.raw import StreamError

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
