"""The recorded MAVLink as frames, and as a .tlog for ground stations and pymavlink.

A .tlog is a sequence of frames, each after its time of arrival: microseconds of Unix time, 64 bits big-endian
(`pymavlink.mavutil.mavlogfile` reads it, and QGroundControl and Mission Planner write it).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from companion.recording import RecordingError
from companion.recording.convert import RECEIVED_CHANNEL, SENT_CHANNEL
from companion.recording.files import RecordingReader, new_file
from companion.vehicle.framing import Frame, Framer

_STAMP = struct.Struct(">Q")


class LinkFrame(NamedTuple):
    """One frame of the autopilot's link. `log_time_ns`: Unix time of the bytes that completed it."""

    log_time_ns: int
    sent: bool
    frame: Frame


def link_frames(reader: RecordingReader) -> Iterator[LinkFrame]:
    """Return the recorded frames of both directions, in the order of the recording."""
    # On a serial link or TCP a frame may be in two messages, so a datagram is read like these.
    framers = {RECEIVED_CHANNEL: Framer(), SENT_CHANNEL: Framer()}
    for channel, log_time_ns, data in reader.messages(*framers):
        for frame in framers[channel.topic].feed(data, datagram=False):
            yield LinkFrame(log_time_ns, channel.topic == SENT_CHANNEL, frame)


def write_tlog(path: Path, output: Path) -> tuple[list[str], int]:
    """Write the frames of a recording to a new .tlog.

    Returns:
        the recording's damage, a line each, and the number of frames.

    Raises:
        RecordingError: the recording cannot be read or has no frames; the file cannot be written or exists.
    """
    reader = RecordingReader(path)
    frames = link_frames(reader)
    first = next(frames, None)
    if first is None:
        raise RecordingError(f"{path}: has no MAVLink: expected frames in '{RECEIVED_CHANNEL}'")
    count = 0
    with new_file(output) as file:
        for log_time_ns, _, frame in chain((first,), frames):
            file.write(_STAMP.pack(log_time_ns // 1000) + frame.raw)
            count += 1
    return reader.problems, count
