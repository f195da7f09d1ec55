"""Motion JPEG in Matroska with any stamps: the containers that FFmpeg writes have its own."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 32, 24


def write_stamped_video(
    path: Path, stamps_ms: Sequence[int], *, interval_ms: int = 40, duration_ms: int | None = None
) -> Path:
    """Write one frame for each stamp, milliseconds; its index is its grey value.

    Args:
        interval_ms: the stated interval of the frames.
        duration_ms: stated for the file; None: up to the end of the latest frame.
    """
    if duration_ms is None:
        duration_ms = max(stamps_ms) + interval_ms
    info = _element(
        0x1549A966, _number(0x2AD7B1, 1_000_000) + _element(0x4489, struct.pack(">d", duration_ms))
    )
    size = _element(0xE0, _number(0xB0, WIDTH) + _number(0xBA, HEIGHT))
    track = _number(0xD7, 1) + _number(0x73C5, 1) + _number(0x83, 1) + _element(0x86, b"V_MJPEG")
    tracks = _element(0x1654AE6B, _element(0xAE, track + _number(0x23E383, interval_ms * 1_000_000) + size))
    clusters = b"".join(
        _element(0x1F43B675, _number(0xE7, stamp_ms) + _element(0xA3, b"\x81\x00\x00\x80" + _jpeg(index)))
        for index, stamp_ms in enumerate(stamps_ms)
    )
    header = _element(0x1A45DFA3, _element(0x4282, b"matroska") + _number(0x4287, 4) + _number(0x4285, 2))
    path.write_bytes(header + _element(0x18538067, info + tracks + clusters))
    return path


def _jpeg(index: int) -> bytes:
    image = np.full((HEIGHT, WIDTH, 3), index % 256, np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def _element(identifier: int, data: bytes) -> bytes:
    """An EBML element with a size of 8 bytes."""
    length = (identifier.bit_length() + 7) // 8
    return identifier.to_bytes(length, "big") + ((1 << 56) | len(data)).to_bytes(8, "big") + data


def _number(identifier: int, value: int) -> bytes:
    return _element(identifier, value.to_bytes(8, "big"))
