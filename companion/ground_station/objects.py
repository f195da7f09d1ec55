"""The objects of a camera for programs behind a station: TUNNEL (385) and TARGET_RELATIVE (511).

`examples/decode_objects.py` reads the former. One frame is a set of messages, each with a header and objects:

header, 8 bytes: `CO`, version 1, number of the set (0 to 255, then from 0 again), objects in the set, index
of the first one in this message, age of the frame in milliseconds (uint16, 65535: or more).

object, 27 bytes and its class: track id (uint32), `ObjectFlag`, confidence (0 to 255 for 0 to 1), left, top,
right and bottom (uint16 each, 0 to 65535 for 0 to 1 of the image), latitude and longitude (int32, 1e-7
degrees, WGS 84), altitude above mean sea level (int32, millimetres), length of the class (uint8), class
(UTF-8). INT32_MAX is a position that is not known. All numbers are little endian. The camera is the component
that sends.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from enum import IntFlag
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from companion.bus.bodies.frames import DetectionBody, DetectionsBody, ObjectBody
from companion.ground_station.component import Message, Stream
from companion.ground_station.tracking import Tracking
from companion.host.clock import unix_offset_ns
from companion.vehicle.framing import CRC_EXTRA, TARGET_RELATIVE_ID

# Above 32767: not registered with MAVLink.
PAYLOAD_TYPE = 0xC0B0
MOST_OBJECTS, MOST_BYTES, MOST_NAME_BYTES = 10, 128, 24
_VERSION = 1
_HEADER, _OBJECT = struct.Struct("<2sBBBBH"), struct.Struct("<IBB4HiiiB")
_UNKNOWN = 2**31 - 1
# 3 messages of 140 bytes twice a second are 7 % of a radio of 115,200 bit/s.
INTERVAL_NS, SHORTEST_INTERVAL_NS = 500_000_000, 200_000_000
TARGET_INTERVAL_NS = 100_000_000
# Of the topic `detections`.
_MAX_AGE_NS = 500_000_000
_LOCAL_OFFSET_NED = 2  # TARGET_OBS_FRAME


class ObjectFlag(IntFlag):
    """What is so of an object."""

    SELECTED = 1
    MOVING = 2
    AMBIGUOUS = 4


def surest(frame: DetectionsBody) -> list[DetectionBody]:
    """Return the confirmed detections with the highest scores, at most `MOST_OBJECTS`, the surest first."""
    confirmed = [
        each
        for each in frame["detections"]
        if each["track_state"] == "confirmed" and each["track_id"] is not None
    ]
    return sorted(confirmed, key=lambda each: -(each["track_score"] or each["confidence"]))[:MOST_OBJECTS]


def encode(frame: DetectionsBody, number: int, now_ns: int, selected: int | None = None) -> list[bytes]:
    """Encode the surest objects of a frame as payloads of at most `MOST_BYTES`; without any, as one.

    Args:
        number: of the set. now_ns: CLOCK_MONOTONIC. selected: the track id of the selected object.
    """
    objects = {each["object_id"]: each for each in frame["objects"]}
    records = [
        _record(frame, each, None if each["object_id"] is None else objects.get(each["object_id"]), selected)
        for each in surest(frame)
    ]
    age_ms = min(max((now_ns - frame["captured_ns"]) // 1_000_000, 0), 0xFFFF)

    def header(first: int) -> bytes:
        return _HEADER.pack(b"CO", _VERSION, number % 256, len(records), first, age_ms)

    payloads = [header(0)]
    for index, record in enumerate(records):
        if len(payloads[-1]) + len(record) > MOST_BYTES:
            payloads.append(header(index))
        payloads[-1] += record
    return payloads


class Objects:
    """Sends the objects of one camera. `due` is a source of its component.

    Args:
        tracking: of the camera; `streams` gets the interval of TUNNEL.
        target_relative: also send TARGET_RELATIVE of the selected object.
    """

    def __init__(self, tracking: Tracking, *, target_relative: bool) -> None:
        self._tracking = tracking
        self._stream = tracking.streams[mavlink.MAVLINK_MSG_ID_TUNNEL] = Stream(
            INTERVAL_NS, SHORTEST_INTERVAL_NS
        )
        self._targets = Stream(TARGET_INTERVAL_NS if target_relative else None)
        self._number, self._any = 0, False

    def due(self, now_ns: int) -> Iterator[Message]:
        """Return what is to be sent now."""
        frame, selection = self._tracking.newest, self._tracking.selection
        if frame is None or now_ns - frame["captured_ns"] > _MAX_AGE_NS:
            return
        if selection is not None and selection.detection is not None and selection.frame is frame:
            relative = target_relative(frame, selection.detection)
            if relative is not None and self._targets.is_due(now_ns, frame["sequence"]):
                yield relative
        any_now = bool(surest(frame))
        # An end is said once.
        if (any_now or self._any) and self._stream.is_due(now_ns, frame["sequence"]):
            self._number, self._any = self._number + 1, any_now
            selected = None if selection is None else selection.track_id
            for payload in encode(frame, self._number, now_ns, selected):
                yield mavlink.MAVLink_tunnel_message(
                    0, 0, PAYLOAD_TYPE, len(payload), payload.ljust(MOST_BYTES, b"\0")
                )


class TargetRelative(mavlink.MAVLink_message):  # type: ignore[misc]
    """TARGET_RELATIVE of MAVLink's development.xml, which pymavlink 2.4 does not have.

    Attributes:
        fields: in wire order: time (UNIX, microseconds), x, y, z (m), their standard deviations, that of the
            yaw (rad), orientations of the object and of the sensor (w, x, y, z), id, frame, type.
    """

    id = TARGET_RELATIVE_ID
    msgname = "TARGET_RELATIVE"
    crc_extra = CRC_EXTRA[TARGET_RELATIVE_ID]
    unpacker: ClassVar = struct.Struct("<Q3f3ff4f4fBBB")

    def __init__(self, *fields: float) -> None:
        super().__init__(self.id, self.msgname)
        self.fields = fields

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """See MAVLink_message."""
        return bytes(self._pack(mav, self.crc_extra, self.unpacker.pack(*self.fields), force_mavlink1))


def target_relative(frame: DetectionsBody, seen: DetectionBody) -> TargetRelative | None:
    """Return where a detection was from the vehicle, at the frame's capture; None: its range is not known.

    North, east and down of the vehicle. The deviations contain the vehicle's own position error. That of the
    height, and the object's orientation, are not known: NaN.
    """
    bearing_rad, range_m = seen["bearing_rad"], seen["ground_range_m"]
    if bearing_rad is None or range_m is None:
        return None
    distance_m, up = seen["distance_m"] or range_m, (seen["elevation_rad"] or 0.0) > 0.0
    below_m = math.copysign(math.sqrt(max(distance_m**2 - range_m**2, 0.0)), -1.0 if up else 1.0)
    deviations, ellipse = (math.nan, math.nan), seen["error_ellipse"]
    if ellipse is not None:
        cosine, sine = math.cos(ellipse["orientation_rad"]), math.sin(ellipse["orientation_rad"])
        major_m, minor_m = ellipse["semi_major_m"], ellipse["semi_minor_m"]
        deviations = (
            math.hypot(major_m * cosine, minor_m * sine),
            math.hypot(major_m * sine, minor_m * cosine),
        )
    captured_us = (unix_offset_ns() + frame["captured_ns"]) // 1000
    return TargetRelative(
        captured_us,
        range_m * math.cos(bearing_rad),
        range_m * math.sin(bearing_rad),
        below_m,
        *deviations,
        math.nan,
        math.nan,
        *[math.nan] * 4,
        *[0.0] * 4,
        (seen["track_id"] or 0) % 256,
        _LOCAL_OFFSET_NED,
        mavlink.LANDING_TARGET_TYPE_VISION_OTHER,
    )


def _record(
    frame: DetectionsBody, seen: DetectionBody, known: ObjectBody | None, selected: int | None
) -> bytes:
    flags = ObjectFlag(0)
    if seen["track_id"] == selected:
        flags |= ObjectFlag.SELECTED
    if known is not None and known["moving"]:
        flags |= ObjectFlag.MOVING
    if known is not None and known["ambiguous"]:
        flags |= ObjectFlag.AMBIGUOUS
    place: DetectionBody | ObjectBody = seen if known is None else known
    latitude, longitude = _whole(place["latitude_deg"], 1e7), _whole(place["longitude_deg"], 1e7)
    name = seen["class_name"].encode()[:MOST_NAME_BYTES].decode(errors="ignore").encode()
    sizes = (frame["width"], frame["height"]) * 2
    box = (
        round(min(max(edge / size, 0.0), 1.0) * 0xFFFF)
        for edge, size in zip(seen["xyxy"], sizes, strict=True)
    )
    return (
        _OBJECT.pack(
            (seen["track_id"] or 0) & 0xFFFF_FFFF,
            flags,
            round(min(max(seen["confidence"], 0.0), 1.0) * 0xFF),
            *box,
            latitude,
            longitude,
            _whole(place["altitude_amsl_m"], 1e3),
            len(name),
        )
        + name
    )


def _whole(value: float | None, scale: float) -> int:
    if value is None or not abs(value) * scale < _UNKNOWN:  # nor NaN
        return _UNKNOWN
    return round(value * scale)
