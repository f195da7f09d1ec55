"""JPEG images as RTP packets (RFC 2435, RFC 3550), without encoding them again.

The format carries baseline images in 4:2:0 or 4:2:2 with the Huffman tables of ITU-T T.81, K.3, up to
2040 pixels wide and high: what OpenCV makes of a colour image.
"""

from __future__ import annotations

import secrets
import struct
from collections.abc import Iterator, Sequence
from typing import Final
from zlib import crc32

PAYLOAD_TYPE: Final = 26  # RFC 3551
LARGEST_SIDE: Final = 2040
PACKET_BYTES: Final = 1400
"""At most, with RTP's header: below the MTU of Ethernet, through a tunnel too."""

_RTP, _MAIN, _RESTART = struct.Struct(">BBHII"), struct.Struct(">I4B"), struct.Struct(">HH")
_TABLES_IN_BAND, _TABLES = 255, struct.pack(">BBH", 0, 0, 128)  # Q, and the header of two tables of 8 bits
_WHOLE_IMAGE = 0xFFFF  # restart intervals are not aligned with packets
_REPORT = struct.Struct(">BBH6I BBHIBB8s2x")  # sender report; description with CNAME
_UNIX_EPOCH_S = 2_208_988_800  # in NTP's time

_SOF0, _DHT, _SOS, _DQT, _DRI = 0xFFC0, 0xFFC4, 0xFFDA, 0xFFDB, 0xFFDD
_OTHER_CODINGS = {*range(0xFFC1, 0xFFD0)} - {_DHT, 0xFFC8, 0xFFCC}
_TYPES = {b"\x21\x11\x11": 0, b"\x22\x11\x11": 1}
"""Sampling of Y, Cb and Cr: type of RFC 2435. 4:2:2 and 4:2:0."""
_HUFFMAN = {0x00: 0x9898900E, 0x01: 0x57A406EB, 0x10: 0x06F8F02E, 0x11: 0xA1415F28}
"""CRC-32 of the tables of K.3, as in DHT: DC and AC (0x10) of luminance (0) and chrominance (1)."""


class RtpJpegError(ValueError):
    """An image that the format cannot carry. The message is one line."""


def rtp_payloads(jpeg: bytes) -> list[bytes]:
    """Split an image into the payloads of its packets, each at most `PACKET_BYTES` with RTP's header.

    A width or height that is no multiple of 8 is announced as the next one: the format counts blocks.

    Raises:
        RtpJpegError: the format cannot carry it, or it is damaged.
    """
    try:
        kind, width, height, restart_interval, tables, scan = _parsed(jpeg)
    except (struct.error, IndexError, KeyError):
        raise RtpJpegError("damaged header") from None
    restart = b""
    if restart_interval:
        kind, restart = kind + 64, _RESTART.pack(restart_interval, _WHOLE_IMAGE)
    quantization = _TABLES + tables
    payloads, offset = [], 0
    while offset < len(scan):
        header = _MAIN.pack(offset, kind, _TABLES_IN_BAND, -(-width // 8), -(-height // 8)) + restart
        header += quantization if offset == 0 else b""
        data = scan[offset : offset + PACKET_BYTES - _RTP.size - len(header)]
        payloads.append(header + data)
        offset += len(data)
    return payloads


def _parsed(jpeg: bytes) -> tuple[int, int, int, int, bytes, bytes]:
    """Return type, width, height, restart interval, quantization tables of Y and of Cb with Cr, and scan."""
    if not jpeg.startswith(b"\xff\xd8"):
        raise RtpJpegError("not a JPEG image")
    tables: dict[int, bytes] = {}
    frame, restart_interval, at, marker = b"", 0, 2, 0
    while marker != _SOS:
        marker, length = struct.unpack_from(">HH", jpeg, at)
        segment, at = jpeg[at + 4 : at + 2 + length], at + 2 + length
        if marker < _SOF0 or len(segment) != length - 2:
            raise RtpJpegError("damaged header")
        if marker == _DQT:
            tables |= {segment[one]: segment[one + 1 : one + 65] for one in range(0, len(segment), 65)}
        elif marker == _DHT:
            rest = segment
            while rest:
                table, rest = rest[: 17 + sum(rest[1:17])], rest[17 + sum(rest[1:17]) :]
                if crc32(table[1:]) != _HUFFMAN.get(table[0]):
                    raise RtpJpegError("own Huffman tables (`optimize`); expected those of T.81, K.3")
        elif marker == _SOF0:
            frame = segment
        elif marker == _DRI:
            (restart_interval,) = struct.unpack(">H", segment)
        elif marker in _OTHER_CODINGS:
            raise RtpJpegError(f"coding SOF{marker & 15}, such as progressive; expected baseline (SOF0)")
    bits, height, width, count = struct.unpack_from(">BHHB", frame)
    if not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE and bits == 8):
        most = f"{LARGEST_SIDE}x{LARGEST_SIDE} of 8 bits"
        raise RtpJpegError(f"{width}x{height} of {bits} bits; RTP/JPEG (RFC 2435) carries up to {most}")
    if count != 3:
        raise RtpJpegError(f"{count} components; expected Y, Cb and Cr: RFC 2435 has no grey images")
    names, samplings, numbers = (frame[first:15:3] for first in (6, 7, 8))
    if samplings not in _TYPES:
        found = " ".join(f"{sampling >> 4}x{sampling & 15}" for sampling in samplings)
        raise RtpJpegError(f"sampling {found}; expected 4:2:0 (2x2 1x1 1x1) or 4:2:2 (2x1 1x1 1x1)")
    if (segment[0], segment[1:7:2], segment[2:7:2]) != (3, names, b"\x00\x11\x11"):
        raise RtpJpegError("expected one scan of Y, Cb and Cr with the Huffman tables 0, 1 and 1")
    luma, chroma = tables[numbers[0]], tables[numbers[1]]
    if tables[numbers[2]] != chroma or len(luma + chroma) != 128:
        raise RtpJpegError("expected one quantization table of Y, and one of Cb and Cr, of 8 bits")
    end = jpeg.find(b"\xff\xd9", at)
    if not at < end <= at + 0xFFFFFF:
        raise RtpJpegError("cut off, or more than the 16 MB of RFC 2435")
    return _TYPES[samplings], width, height, restart_interval, luma + chroma, jpeg[at:end]


class RtpSender:
    """Numbers the packets to one receiver: a source of its own, with random beginnings (RFC 3550, 5.1).

    Attributes:
        ssrc: its identifier.
    """

    def __init__(self) -> None:
        self.ssrc = secrets.randbits(32)
        self._sequence, self._offset = secrets.randbits(16), secrets.randbits(32)
        self._packets = self._bytes = 0

    def packets(self, payloads: Sequence[bytes], stamp_ns: int) -> Iterator[tuple[bytes, bytes]]:
        """Yield header and payload of each packet of an image; those that are taken count as sent.

        Args:
            stamp_ns: when it was captured, CLOCK_MONOTONIC.
        """
        time, last = self._time(stamp_ns), len(payloads) - 1
        for index, payload in enumerate(payloads):
            marker = 0x80 if index == last else 0
            yield _RTP.pack(0x80, PAYLOAD_TYPE | marker, self._sequence, time, self.ssrc), payload
            self._sequence = (self._sequence + 1) & 0xFFFF
            self._packets += 1
            self._bytes += len(payload)

    def report(self, now_ns: int, unix_ns: int) -> bytes:
        """Return a sender report and the source's name (RTCP): players map RTP's time to the time of day.

        Args:
            now_ns, unix_ns: the same moment, as CLOCK_MONOTONIC and as UTC.
        """
        seconds, rest_ns = divmod(unix_ns, 1_000_000_000)
        ntp = (seconds + _UNIX_EPOCH_S & 0xFFFFFFFF, (rest_ns << 32) // 1_000_000_000)
        sent = (self._packets & 0xFFFFFFFF, self._bytes & 0xFFFFFFFF)
        report = (0x80, 200, 6, self.ssrc, *ntp, self._time(now_ns), *sent)
        return _REPORT.pack(*report, 0x81, 202, 4, self.ssrc, 1, 8, f"{self.ssrc:08x}".encode())

    def _time(self, monotonic_ns: int) -> int:
        """RTP's time, of 90 kHz."""
        return (monotonic_ns * 9 // 100_000 + self._offset) & 0xFFFFFFFF
