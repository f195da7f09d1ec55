"""MAVLink framing and packing (https://mavlink.io/en/guide/serialization.html).

Frames are separated and checked before anything decodes them, so that noise on the line costs only the frames
it hit, and unused messages are never decoded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pymavlink.dialects.v20 import common as mavlink

MAGIC_V1, MAGIC_V2 = 0xFE, 0xFD
_MAGICS = (MAGIC_V1, MAGIC_V2)
SIGNATURE_LENGTH = 13  # link id, 48-bit timestamp, 48 bits of SHA-256
_HEADER_V1, _HEADER_V2, _CHECKSUM, _SIGNATURE = 6, 10, 2, SIGNATURE_LENGTH
_FLAG_SIGNED = 0x01

# MAVLink common, not in pymavlink 2.4.50's "common". 436 is sent by PX4 >= 1.15.
COMPONENT_METADATA_ID = 397
EVENT_ID, CURRENT_EVENT_SEQUENCE_ID, REQUEST_EVENT_ID = 410, 411, 412
CURRENT_MODE_ID = 436
TARGET_RELATIVE_ID = 511  # of development.xml
EKF_STATUS_REPORT_ID = 193  # ArduPilot's own
CRC_EXTRA: dict[int, int] = {
    **{message_id: message.crc_extra for message_id, message in mavlink.mavlink_map.items()},
    COMPONENT_METADATA_ID: 182,
    EVENT_ID: 160,
    CURRENT_EVENT_SEQUENCE_ID: 106,
    REQUEST_EVENT_ID: 33,
    CURRENT_MODE_ID: 193,
    TARGET_RELATIVE_ID: 28,
    EKF_STATUS_REPORT_ID: 71,
}


@dataclass(frozen=True, slots=True)
class Frame:
    """One complete frame.

    Attributes:
        checked: the checksum was verified; False only for message ids without a definition here.
        raw: every byte, from the magic to the checksum or signature.
        payload: as sent, so in MAVLink 2 without trailing zeros.
    """

    message_id: int
    system_id: int
    component_id: int
    sequence: int
    checked: bool
    raw: bytes
    payload: bytes

    def padded(self, length: int) -> bytes:
        """Return the payload padded with MAVLink 2's trailing zeros, or truncated, to `length` bytes."""
        return self.payload[:length].ljust(length, b"\0")


class Framer:
    """Splits the bytes of one sender into frames. Resynchronises at the next magic byte after an error.

    Attributes:
        skipped_bytes: that are in no frame.
        split_frames: that began in one datagram and ended in another.
        has_framed: a frame with a right checksum has been received.
    """

    def __init__(self) -> None:
        self._tail = b""
        self.skipped_bytes = self.split_frames = 0
        self.has_framed = False

    @property
    def waiting_bytes(self) -> int:
        """Number of bytes that may begin a frame: less than the longest one."""
        return len(self._tail)

    def feed(self, data: bytes, *, datagram: bool) -> list[Frame]:
        """Return the frames that `data` completes; the rest waits for what follows.

        Of datagrams that were never seen to split a frame, whole frames up to the end are not held back by a
        false or damaged header before them.
        """
        held = len(self._tail)
        return self._read(self._tail + data, held if datagram else None, whole=not self.split_frames)

    def flush(self) -> list[Frame]:
        """Return the whole frames of what waits, and skip the rest: nothing will complete it."""
        frames = self._read(self._tail, 0, whole=True, final=True)
        self._tail = b""
        return frames

    def _read(self, buffer: bytes, held: int | None, *, whole: bool, final: bool = False) -> list[Frame]:
        """Read frames, and keep the rest.

        Args:
            held: bytes of earlier datagrams at the start of `buffer`; None: of a stream.
            whole: no frame was split yet. final: nothing follows.
        """
        whole &= held is not None
        frames: list[Frame] = []
        position = 0
        while position < len(buffer):
            length = _frame_length(buffer, position)
            if length is None:  # more bytes may make it a frame
                start = _whole_frames_after(buffer, position) if whole else None
                if start is None and not final:
                    break
                start = position + 1 if start is None else start
                self.skipped_bytes += start - position
                position = start
                continue
            frame = _read_frame(buffer[position : position + length]) if length else None
            if frame is not None and not frame.checked:
                # Without a checksum, noise that looks like a header must not consume the frames that follow.
                following = buffer[position + length : position + length + 1]
                if not following and held is not None and not final and not (whole and position >= held):
                    break  # where frames are split, the end of a datagram is not that of a frame
                if following and following[0] not in _MAGICS:
                    frame = None
            if frame is None:
                self.skipped_bytes += 1
                position += 1
                continue
            frames.append(frame)
            self.has_framed |= frame.checked
            if held is not None and frame.checked and position < held < position + length:
                self.split_frames += 1
            position += length
        self._tail = buffer[position:]
        return frames


def pack_frame(message_id: int, payload: bytes, *, system_id: int, component_id: int, sequence: int) -> bytes:
    """Pack an unsigned MAVLink 2 frame, with trailing zeros of the payload removed."""
    payload = payload.rstrip(b"\0") or b"\0"
    header = bytes((MAGIC_V2, len(payload), 0, 0, sequence, system_id, component_id))
    return _with_checksum(header + message_id.to_bytes(3, "little") + payload, message_id)


def with_sequence(frame: Frame, sequence: int) -> bytes:
    """Return the frame's bytes with another sequence number; signed or unchecked frames are unchanged."""
    signed = frame.raw[0] == MAGIC_V2 and frame.raw[2] & _FLAG_SIGNED
    if signed or not frame.checked:
        return frame.raw
    at = 4 if frame.raw[0] == MAGIC_V2 else 2
    body = frame.raw[:at] + bytes((sequence,)) + frame.raw[at + 1 : -_CHECKSUM]
    return _with_checksum(body, frame.message_id)


def is_signed(raw: bytes) -> bool:
    """Whether a complete frame carries a signature."""
    return raw[0] == MAGIC_V2 and bool(raw[2] & _FLAG_SIGNED)


def marked_signed(raw: bytes) -> bytes:
    """Set the signed flag of an unsigned MAVLink 2 frame; the signature covers the flag.

    Raises KeyError for a message id without a definition here.
    """
    body = raw[:2] + bytes((raw[2] | _FLAG_SIGNED,)) + raw[3:-_CHECKSUM]
    return _with_checksum(body, int.from_bytes(raw[7:10], "little"))


def frames_of(data: bytes) -> Iterator[Frame]:
    """Yield the whole frames of one datagram of a program that does not split them."""
    framer = Framer()
    yield from framer.feed(data, datagram=True)
    yield from framer.flush()


def _whole_frames_after(buffer: bytes, position: int) -> int | None:
    """Where, after `position`, checked frames begin that last exactly until the end; None: nowhere."""
    for start in range(position + 1, len(buffer)):
        end = start
        while end < len(buffer) and (length := _frame_length(buffer, end)):
            frame = _read_frame(buffer[end : end + length])
            if frame is None or not frame.checked:
                break
            end += length
        if start < end == len(buffer):
            return start
    return None


def _frame_length(buffer: bytes, position: int) -> int | None:
    """Return the length of the frame at `position`; 0: no frame; None: not enough bytes yet."""
    magic = buffer[position]
    if magic not in _MAGICS:
        return 0
    if len(buffer) - position < 3:
        return None
    length = buffer[position + 1] + _CHECKSUM
    if magic == MAGIC_V1:
        length += _HEADER_V1
    else:
        flags = buffer[position + 2]
        if flags & ~_FLAG_SIGNED:  # a receiver must drop frames with unknown flags
            return 0
        length += _HEADER_V2 + (_SIGNATURE if flags & _FLAG_SIGNED else 0)
    return length if len(buffer) - position >= length else None


def _read_frame(raw: bytes) -> Frame | None:
    """Parse a frame; None when its checksum is wrong."""
    if raw[0] == MAGIC_V2:
        header, sequence, system_id, component_id = _HEADER_V2, raw[4], raw[5], raw[6]
        message_id = int.from_bytes(raw[7:10], "little")
    else:
        header, sequence, system_id, component_id = _HEADER_V1, raw[2], raw[3], raw[4]
        message_id = raw[5]
    end = header + raw[1]
    extra = CRC_EXTRA.get(message_id)
    if extra is not None and _checksum(raw[1:end], extra) != raw[end : end + _CHECKSUM]:
        return None
    return Frame(message_id, system_id, component_id, sequence, extra is not None, raw, raw[header:end])


def _with_checksum(body: bytes, message_id: int) -> bytes:
    return body + _checksum(body[1:], CRC_EXTRA[message_id])


def _checksum(body: bytes, crc_extra: int) -> bytes:
    crc: int = mavlink.x25crc(body + bytes((crc_extra,))).crc
    return crc.to_bytes(_CHECKSUM, "little")
