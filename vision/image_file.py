"""Reads image files as 8-bit BGR: the one place that decodes them, for sources, data sets and messages.

An alpha channel is left out, as OpenCV and Ultralytics do. 16 bits become 8 by their upper byte; values that
use less than half of the 16-bit range, such as a thermal camera's counts of 14 bits, are stretched, since
their upper bytes are nearly black.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.file_kinds import kind_of_bytes

logger = logging.getLogger(__name__)

UNREADABLE_SUFFIXES = frozenset((".heic", ".heif"))
"""Images that are not read, but are named where they are found."""
IMAGE_SUFFIXES = UNREADABLE_SUFFIXES.union(
    (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm", ".pnm", ".jp2", ".avif")
)

# Of these the decoder knows more than the kind of file.
_AVIF = "is an AVIF image"
_KINDS = (*(f"is a {kind} image" for kind in ("JPEG", "PNG", "GIF", "TIFF", "WebP", "JPEG 2000")), _AVIF)
# Values that span less of the 16-bit range are stretched. Dead and hot pixels do not count: this share of the
# pixels at each end, 300 of a 640x512 image.
_STRETCHED_BELOW, _IGNORED_PERCENT = 1 << 15, 0.1
_MOST_SAMPLES = 1 << 20
# libjpeg looks ahead by so many bytes. Without an end behind them it stops, quietly, where rows are missing.
_JPEG_LOOK_AHEAD = bytes(9)
_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"\0\0\0\0IEND\xaeB`\x82"
_TIFF = {b"II*\0": "little", b"MM\0*": "big"}
_SUBFILE_TYPE, _NO_PAGE = 254, 1 | 4  # TIFF 6.0: reduced images and masks
_WIDTHS, _HEIGHTS = (256, 322), (257, 323)  # TIFF 6.0: of the image and of a tile


class ImageError(ValueError):
    """An image that cannot be read; the text is the reason, to be put after the file's name."""


@dataclass(frozen=True, slots=True, eq=False)
class DecodedImage:
    """A decoded image.

    Attributes:
        pixels: (height, width, 3) uint8, BGR, rotated by its EXIF orientation.
        note: what the pixels do not show as the file has it; empty: nothing.
    """

    pixels: NDArray[np.uint8]
    note: str = ""


def is_image(path: Path) -> bool:
    """Whether the file name has an image suffix."""
    return path.suffix.lower() in IMAGE_SUFFIXES


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sort key of natural order: image2 before image10."""
    parts = re.split(r"(\d+)", path.name.casefold())
    return tuple((0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts if part)


def read_image(path: Path) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 BGR of a file, rotated by its EXIF orientation.

    A note about it is logged for the first such image of a folder.

    Raises:
        ImageError: it cannot be read.
    """
    try:
        data = path.read_bytes()  # decoded from memory: OpenCV crashes on a name that is not UTF-8
    except OSError as error:
        raise ImageError(f"cannot be read: {error.strerror or error}") from None
    image = decode(data)
    _log_once(str(path), image.note, str(path.absolute().parent))
    return image.pixels


def frame_pixels(image: NDArray[Any], name: str) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 BGR of a frame of a video or camera, whose note is logged once.

    Args:
        image: (height, width, 3) uint8, BGR; or (height, width) uint16. name: of the video or camera.
    """
    pixels, note = _eight_bits(image)
    _log_once(name, note, name)
    return pixels


_noted: set[tuple[str, str]] = set()
"""Folders, videos and cameras, with the notes that were logged for them, without their numbers."""


def _log_once(name: str, note: str, place: str) -> None:
    if note and (noted := (place, re.sub(r"\d+", "", note))) not in _noted:
        _noted.add(noted)
        logger.warning("%s: %s; said once", name, note)


def decode_image(data: bytes) -> NDArray[np.uint8] | None:
    """The pixels of `decode`; None if it cannot be read, as one of a stream of images."""
    try:
        return decode(data).pixels
    except ImageError:
        return None


def stated_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the header of a JPEG, PNG or TIFF, pixels: what decoding would allocate.

    Of a TIFF whose tiles are larger it is that of a tile. None: another file, or one without such a header.
    """
    if data.startswith(_PNG):
        return _png_size(data) if data[12:16] == b"IHDR" else None
    if data.startswith(b"\xff\xd8"):
        at = _jpeg_frame(data)
        if at is None or len(data) < at + 7:
            return None
        return int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 3 : at + 5], "big")
    if order := _TIFF.get(data[:4]):
        return _tiff_size(data, order)
    return None


def decode(data: bytes) -> DecodedImage:
    """Decode an image file. A JPEG or PNG that lacks nothing but its end is whole.

    Raises:
        ImageError: it is no image, not one of colours, or pixels are missing.
    """
    notes = []
    if data.startswith(_PNG):
        data, images = _whole_png(data)
        if images > 1:
            notes.append(f"is an animation of {images} images: its first one is read")
    image = _decoded(data)
    if image is None:
        whole, note = _whole_jpeg(data)
        notes += [note] * bool(note)
        image = _decoded(whole)
    if image is None or image.itemsize > 2:
        raise ImageError(_unreadable(data, image))
    pixels, note = _eight_bits(image)
    notes += [note] * bool(note)
    if data.startswith(b"RIFF") and data[12:16] == b"VP8X" and data[20] & 2:
        notes.append("is an animation: its first image is read")
    elif (order := _TIFF.get(data[:4])) and (pages := _pages(data, order)) > 1:
        notes.append(f"has {pages} pages: its first one is read")
    return DecodedImage(pixels, "; ".join(notes))


def _decoded(data: bytes) -> NDArray[Any] | None:
    if not data:
        return None
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        if "CV_IO_MAX_IMAGE" not in str(error):
            return None
    size = "{}x{} pixels, ".format(*_png_size(data)) if data.startswith(_PNG) else ""
    raise ImageError(f"{size}more than OpenCV's limit of 2^30 pixels, 2^20 a side; cut it into tiles")


def _png_size(data: bytes) -> tuple[int, int]:
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def _whole_png(data: bytes) -> tuple[bytes, int]:
    """The file with its end, and the number of its images (APNG)."""
    if 0 in _png_size(data):
        raise ImageError("states a size of {}x{} pixels; make it again".format(*_png_size(data)))
    at, images = len(_PNG), 1
    while (kind := data[at + 4 : at + 8]) != b"IEND":
        if kind == b"acTL":
            images = int.from_bytes(data[at + 8 : at + 12], "big")
        after = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if len(data) < at + 12 or len(data) < after:
            break
        at = after
    if (rest := data[at:]).startswith(_PNG_END):
        return data, images
    if _PNG_END.startswith(rest):
        return data[:at] + _PNG_END, images
    raise ImageError("is a PNG image that ends too early: pixels are missing; copy or download it again")


def _whole_jpeg(data: bytes) -> tuple[bytes, str]:
    """A JPEG without its end, completed, with a note; empty for another file."""
    if not data.startswith(b"\xff\xd8") or data.endswith(b"\xff\xd9"):
        return b"", ""
    if _is_progressive(data):
        return data + b"\xff\xd9", "is a JPEG without its end: it may be coarser, or lack rows"
    if _decoded(data + _JPEG_LOOK_AHEAD) is None:
        raise ImageError("is a JPEG image that ends too early: rows are missing; copy or download it again")
    return data + _JPEG_LOOK_AHEAD, ""


def _is_progressive(data: bytes) -> bool:
    at = _jpeg_frame(data)
    return at is not None and data[at - 1] == 0xC2


def _jpeg_frame(data: bytes) -> int | None:
    """Where the frame header is, behind its marker (ITU-T T.81, B.2.2); None: nowhere before a scan.

    Bytes between segments are skipped, as libjpeg does: else it would decode another size than is found here.
    """
    at = 2
    while 0 <= (at := data.find(b"\xff", at)) < len(data) - 1:
        at, code = at + 1, data[at + 1]
        if code == 0xFF:  # fill
            continue
        at += 1
        if code in (0x00, 0x01) or 0xD0 <= code <= 0xD7:  # without a segment
            continue
        if 0xC0 <= code <= 0xCF and code not in (0xC4, 0xCC):  # tables have those
            return at
        if code in (0xD8, 0xD9, 0xDA):
            return None
        at += int.from_bytes(data[at : at + 2], "big")
    return None


def _unreadable(data: bytes, image: NDArray[Any] | None) -> str:
    """Why these bytes are no image of colours, although they may hold an image of more than 16 bits."""
    if image is None and data[:4] in _TIFF:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is not None and image.itemsize > 2:
        what = "floats" if image.dtype.kind == "f" else "integers"
        return f"{image.itemsize * 8}-bit {what} are not an image of colours; convert it to 8 bits"
    kind = kind_of_bytes(data[:65_536])
    if kind is not None and not kind.startswith(_KINDS):
        return kind
    if kind == _AVIF:
        return f"{_AVIF}: damaged, or this OpenCV cannot read them; convert it to JPEG or PNG"
    return "not an image that can be read; it may be truncated or damaged"


def _eight_bits(image: NDArray[Any]) -> tuple[NDArray[np.uint8], str]:
    """Grey or colour of 8 or 16 bits, signed or not, as 8-bit BGR; with a note if it was stretched."""
    note = ""
    if image.dtype != np.uint8:
        image, note = _upper_byte_or_stretched(image)
    if image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    return np.ascontiguousarray(image, dtype=np.uint8), note


def _upper_byte_or_stretched(image: NDArray[Any]) -> tuple[NDArray[np.uint8], str]:
    offset = 0
    if image.dtype.kind == "i":  # two's complement → the same order, unsigned
        image, offset = image.view(np.uint16) ^ np.uint16(0x8000), 0x8000
    step = int(np.ceil(np.sqrt(image.size / _MOST_SAMPLES)))
    reached = np.cumsum(np.bincount(image[::step, ::step].ravel(), minlength=1 << 16))
    share = np.array([_IGNORED_PERCENT, 100.0 - _IGNORED_PERCENT]) / 100.0
    low, high = np.searchsorted(reached, share * (reached[-1] - 1), side="right").tolist()
    if not 0 < high - low < _STRETCHED_BELOW:
        return (image >> 8).astype(np.uint8), ""
    table = np.clip((np.arange(1 << 16) - low) * (255.0 / (high - low)), 0.0, 255.0)
    note = (
        f"16-bit image with values {int(image.min()) - offset} to {int(image.max()) - offset}: "
        f"{low - offset} to {high - offset} are stretched to 0 to 255"
    )
    return table.round().astype(np.uint8)[image], note


def _pages(data: bytes, order: Any) -> int:
    """Number of a TIFF file's pages (TIFF 6.0, section 2), without its smaller copies and masks."""

    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size], order)

    pages, at, seen = 0, number(4, 4), set[int]()
    while 0 < at < len(data) and at not in seen:
        seen.add(at)
        entries = number(at, 2)
        fields = (at + 2 + 12 * index for index in range(entries))
        kind = next((number(field + 8, 4) for field in fields if number(field, 2) == _SUBFILE_TYPE), 0)
        pages += not kind & _NO_PAGE
        at = number(at + 2 + 12 * entries, 4)
    return pages


def _tiff_size(data: bytes, order: Any) -> tuple[int, int] | None:
    first = int.from_bytes(data[4:8], order)
    stated: dict[int, int] = {}
    for at in range(first + 2, first + 2 + 12 * int.from_bytes(data[first : first + 2], order), 12):
        tag, kind = (int.from_bytes(data[start : start + 2], order) for start in (at, at + 2))
        if tag in _WIDTHS + _HEIGHTS:
            value = data[at + 8 : at + (10 if kind == 3 else 12)]  # 16 or 32 bits
            stated[tag] = max(stated.get(tag, 0), int.from_bytes(value, order))
    if not {_WIDTHS[0], _HEIGHTS[0]}.issubset(stated):
        return None
    width, height = (max(stated.get(tag, 0) for tag in tags) for tags in (_WIDTHS, _HEIGHTS))
    return width, height
