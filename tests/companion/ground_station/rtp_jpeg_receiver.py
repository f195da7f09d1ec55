"""A receiver of RTP/JPEG, written from RFC 2435 alone: packets back to JPEG files."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np


class ReceivedImage(NamedTuple):
    """An image. `time`: RTP's, of 90 kHz."""

    jpeg: bytes
    time: int
    ssrc: int


@cache
def standard_huffman() -> bytes:
    """The DHT segments of T.81, K.3: what OpenCV writes."""
    jpeg = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    found, at = b"", 2
    while jpeg[at + 1] != 0xDA:
        size = 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
        if jpeg[at + 1] == 0xC4:
            found += jpeg[at : at + size]
        at += size
    return found


class Receiver:
    """Takes packets in order. A lost one loses its image.

    Attributes:
        images: the whole ones. lost: missing sequence numbers.
    """

    def __init__(self) -> None:
        self.images: list[ReceivedImage] = []
        self.lost = 0
        self._data: bytes | None = b""
        self._tables = b""
        self._next: int | None = None

    def take(self, packet: bytes) -> None:
        """Take a packet with the header of RTP."""
        first, second, sequence, time, ssrc = struct.unpack_from(">BBHII", packet)
        assert first == 0x80, "version 2 without padding, extension and contributors"
        assert second & 0x7F == 26
        if self._next not in (None, sequence):
            self.lost += (sequence - (self._next or 0)) & 0xFFFF
            self._data = None
        self._next = (sequence + 1) & 0xFFFF
        offset, kind, q, width, height = struct.unpack_from(">I4B", packet, 12)
        assert offset < 1 << 24, "type-specific: 0, a whole image"
        at, interval = 20, 0
        if kind >= 64:
            interval, count = struct.unpack_from(">HH", packet, at)
            assert count == 0xFFFF, "first, last, and 0x3FFF"
            at += 4
        if offset == 0:
            self._data = b""
            if q >= 128:
                zero, precision, length = struct.unpack_from(">BBH", packet, at)
                assert (zero, precision, length) == (0, 0, 128)
                self._tables = packet[at + 4 : at + 4 + length]
                at += 4 + length
        if self._data is not None:
            assert offset == len(self._data)
            self._data += packet[at:]
        if second & 0x80:
            if self._data is not None:
                jpeg = self._file(kind, width * 8, height * 8, interval)
                self.images.append(ReceivedImage(jpeg, time, ssrc))
            self._data = None

    def _file(self, kind: int, width: int, height: int, interval: int) -> bytes:
        sampling = {0: 0x21, 1: 0x22}[kind % 64]
        frame = struct.pack(">HHBHHB", 0xFFC0, 17, 8, height, width, 3)
        frame += bytes((1, sampling, 0, 2, 0x11, 1, 3, 0x11, 1))
        tables = b"".join(
            struct.pack(">HHB", 0xFFDB, 67, number) + self._tables[64 * number : 64 * number + 64]
            for number in (0, 1)
        )
        restart = struct.pack(">HHH", 0xFFDD, 4, interval) if interval else b""
        scan = struct.pack(">HHB", 0xFFDA, 12, 3) + bytes((1, 0x00, 2, 0x11, 3, 0x11, 0, 63, 0))
        assert self._data is not None
        return b"\xff\xd8" + tables + frame + standard_huffman() + restart + scan + self._data + b"\xff\xd9"


def received(packets: Iterable[bytes]) -> list[ReceivedImage]:
    """The images of packets of which none is lost."""
    receiver = Receiver()
    for packet in packets:
        receiver.take(packet)
    assert receiver.lost == 0
    return receiver.images
