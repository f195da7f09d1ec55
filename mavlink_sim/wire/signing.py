"""MAVLink 2 message signing (https://mavlink.io/en/guide/message_signing.html) by the rules of PX4 v1.17.

Everything here works on packed frames, so that it can be used between any packer and any socket.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

logger = logging.getLogger(__name__)

KEY_LENGTH = 32
SIGNATURE_LENGTH = 13  # link id, 48-bit timestamp, 48 bits of SHA-256
MAVLINK_2 = 0xFD
SIGNED = 0x01  # MAVLINK_IFLAG_SIGNED
MAX_STREAMS = 16  # MAVLINK_MAX_SIGNING_STREAMS
ONE_MINUTE = 6_000_000  # in units of 10 us
EPOCH_S = 1_420_070_400  # 2015-01-01, from which signing timestamps count
# What PX4 accepts unsigned whatever MAV_SIGN_CFG is: RADIO_STATUS, ADSB_VEHICLE, COLLISION.
ALWAYS_ACCEPTED = frozenset({109, 246, 247})
OPTIONAL, EXCEPT_USB, ALWAYS = 0, 1, 2  # MAV_SIGN_CFG

# (system, component, link id) -> newest timestamp. PX4 keeps one table for all of its links.
Streams = dict[tuple[int, int, int], int]


def key_of(text: str) -> bytes:
    """The key of a command-line value: 64 hexadecimal digits, or the path of a file with the 32 bytes.

    Raises ValueError if it is neither; the message does not repeat the key.
    """
    try:
        key = bytes.fromhex(text)
    except ValueError:
        path = Path(text)
        if not path.is_file():
            raise ValueError(
                "a signing key is 64 hexadecimal digits or a file that holds its 32 bytes; this is neither"
            ) from None
        key = path.read_bytes()
    if len(key) != KEY_LENGTH:
        raise ValueError(f"a signing key has {KEY_LENGTH} bytes, this one has {len(key)}")
    return key


def timestamp_now() -> int:
    """Now, in the unit of signatures: 10 us since 2015."""
    return int((time.time() - EPOCH_S) * 1e5)


class Signing:
    """The signing of one link. Without a key every frame passes in both directions, untouched.

    Args:
        link_id: this link's number, part of every signature it makes.
        streams: the newest timestamps received, shared by all links of a vehicle.
        policy: MAV_SIGN_CFG now (unsigned frames: 0 accepted, 1 on USB only, 2 never).
        is_usb: the link represents the vehicle's USB port, the only one on which PX4 accepts a key.

    Attributes:
        refused: how many frames were refused, by reason.
    """

    def __init__(
        self,
        link_id: int = 0,
        streams: Streams | None = None,
        policy: Callable[[], int] = lambda: ALWAYS,
        is_usb: bool = False,
    ) -> None:
        self._link_id = link_id
        self._streams: Streams = {} if streams is None else streams
        self._policy = policy
        self.is_usb = is_usb
        self._key: bytes | None = None
        self._timestamp = 0
        self.refused: Counter[str] = Counter()

    @property
    def has_key(self) -> bool:
        return self._key is not None

    def set_up(self, key: bytes, timestamp: int) -> None:
        """Set a key; zeros with timestamp 0 end signing. Raises ValueError for a key of another length."""
        if len(key) != KEY_LENGTH:
            raise ValueError(f"a signing key has {KEY_LENGTH} bytes, got {len(key)}")
        self._key = key if timestamp or any(key) else None
        self._timestamp = timestamp

    def signed(self, frame: bytes) -> bytes:
        """A frame with its signature; a MAVLink 1 frame, or one already signed, unchanged."""
        if self._key is None or frame[0] != MAVLINK_2 or frame[2] & SIGNED:
            return frame
        self._timestamp = (self._timestamp + 1) & 0xFFFFFFFFFFFF
        marked = bytearray(frame)
        marked[2] |= SIGNED
        change = _checksum_change(len(frame) - 3)
        marked[-2] ^= change & 0xFF
        marked[-1] ^= change >> 8
        marked.append(self._link_id)
        marked += self._timestamp.to_bytes(6, "little")
        return bytes(marked) + hashlib.sha256(self._key + marked).digest()[:6]

    def accepts(self, frame: bytes) -> bool:
        """Whether a received frame (with a valid checksum) is accepted; if not, it is counted."""
        if self._key is None:
            return True
        reason = self._objection(frame, self._key)
        if reason is None or self._welcomes_unsigned(_message_of(frame)):
            return True
        self.refused[reason] += 1
        if self.refused[reason] == 1:
            logger.warning("frame refused by signing: %s; further ones are only counted", reason)
        return False

    def _welcomes_unsigned(self, message: int) -> bool:
        policy = self._policy()
        return message in ALWAYS_ACCEPTED or policy == OPTIONAL or (policy == EXCEPT_USB and self.is_usb)

    def _objection(self, frame: bytes, key: bytes) -> str | None:
        if frame[0] != MAVLINK_2 or not frame[2] & SIGNED:
            return "unsigned"
        if hashlib.sha256(key + frame[:-6]).digest()[:6] != frame[-6:]:
            return "wrong signature"
        stream = (frame[5], frame[6], frame[-SIGNATURE_LENGTH])
        timestamp = int.from_bytes(frame[-12:-6], "little")
        newest = self._streams.get(stream)
        if newest is None:
            if len(self._streams) >= MAX_STREAMS:
                return "too many streams"
            if timestamp + ONE_MINUTE < self._timestamp:
                return "old timestamp"
        elif timestamp <= newest:
            return "replayed"
        self._streams[stream] = timestamp
        self._timestamp = max(self._timestamp, timestamp)
        return None


def _message_of(frame: bytes) -> int:
    if frame[0] == MAVLINK_2:
        return int.from_bytes(frame[7:10], "little")
    return frame[5]


@functools.cache
def _checksum_change(zeros: int) -> int:
    """How the X.25 checksum changes when the flag is set: the code is linear, so independent of the payload.

    `zeros`: number of bytes from the flag on that the checksum covers, the message's CRC extra included.
    """
    crc = 0
    for byte in (SIGNED, *bytes(zeros - 1)):
        mixed = byte ^ (crc & 0xFF)
        mixed = (mixed ^ (mixed << 4)) & 0xFF
        crc = (crc >> 8) ^ (mixed << 8) ^ (mixed << 3) ^ (mixed >> 4)
    return crc & 0xFFFF
