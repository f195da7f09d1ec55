"""Print the objects that `companion` sends to ground stations: python decode_objects.py udpin:0.0.0.0:14550

It needs pymavlink. The format is described in companion/ground_station/objects.py.
"""

import struct
import sys
from collections.abc import Iterator
from typing import Any

from pymavlink import mavutil

PAYLOAD_TYPE = 0xC0B0
HEADER, OBJECT = struct.Struct("<2sBBBBH"), struct.Struct("<IBB4HiiiB")


def decode(payload: bytes) -> Iterator[dict[str, Any]]:
    """Yield the objects of one payload of TUNNEL."""
    if len(payload) < HEADER.size or payload[:3] != b"CO\x01":  # version 1
        return
    _magic, _version, number, total, _first, age_ms = HEADER.unpack_from(payload)
    at = HEADER.size
    while at < len(payload):
        track, flags, confidence, *rest, length = OBJECT.unpack_from(payload, at)
        name, at = payload[at + OBJECT.size :][:length].decode(), at + OBJECT.size + length
        box = [edge / 65535 for edge in rest[:4]]
        place = None if rest[4] == 2**31 - 1 else (rest[4] / 1e7, rest[5] / 1e7)
        altitude = None if rest[6] == 2**31 - 1 else rest[6] / 1e3
        shown = {"set": number, "of": total, "age_ms": age_ms, "track": track, "class": name, "box": box}
        named = {"selected": bool(flags & 1), "moving": bool(flags & 2), "ambiguous": bool(flags & 4)}
        yield {**shown, **named, "confidence": confidence / 255, "place": place, "altitude_m": altitude}


if __name__ == "__main__":
    link = mavutil.mavlink_connection(sys.argv[1])
    while True:
        message = link.recv_match(type="TUNNEL", blocking=True)
        if message.payload_type == PAYLOAD_TYPE:
            for each in decode(bytes(message.payload[: message.payload_length])):
                print(f"camera {message.get_srcComponent()}: {each}", flush=True)
