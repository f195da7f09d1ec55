"""A simulated link and the ULog of the same flight, whose clocks and attitude are known exactly."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import common

from companion.bench.lockstep_flight import plain_settings
from companion.guidance.core import GuidanceOptions
from companion.recording.convert import Converter
from companion.recording.encoding import dumps
from companion.recording.link_bytes import LinkBytes, pack_link_bytes
from companion.recording.tap import run_record
from tests.companion.recording.lockstep_recording import new_writer

ATTITUDE = "uint64_t timestamp;float[4] q;uint8_t[4] _padding0;"
BEGIN_NS = 500_000_000_000  # CLOCK_MONOTONIC when the recording begins


@dataclass(frozen=True)
class Flight:
    """An autopilot that booted `booted_s` before the recording; its clock is fast by `drift`.

    Attributes:
        seed: of the attitudes and the link's delays.
        delay_s: least of each direction; a random time is added.
    """

    seed: int
    booted_s: float = 40.0
    drift: float = 60e-6
    seconds: float = 60.0
    delay_s: float = 0.0005

    def boot_us(self, now_ns: float) -> int:
        return int((now_ns - BEGIN_NS + self.booted_s * 1e9) * (1 + self.drift) / 1000)

    def now_ns(self, boot_us: float) -> float:
        return boot_us * 1000 / (1 + self.drift) - self.booted_s * 1e9 + BEGIN_NS

    def attitudes(self) -> Iterator[tuple[float, int, list[float]]]:
        """(CLOCK_MONOTONIC ns, stamp in microseconds, quaternion) at 250 Hz, in single precision."""
        rng = np.random.default_rng(self.seed)
        drawn = rng.uniform(-1, 1, (round(self.seconds * 250), 4)).astype(np.float32)
        for number, values in enumerate(drawn.tolist()):
            now_ns = BEGIN_NS + number * 4e6
            yield now_ns, self.boot_us(now_ns), values


def link_pieces(flight: Flight, *, answers: bool = True) -> list[LinkBytes]:
    """What a service records: TIMESYNC each 0.5 s, and each fifth attitude."""
    ours, theirs = common.MAVLink(None, 1, 191), common.MAVLink(None, 1, 1)
    rng = random.Random(flight.seed + 1000)

    def delay_ns() -> float:
        return (flight.delay_s + rng.expovariate(1 / 0.004)) * 1e9

    pieces = []
    for number, (now_ns, stamp_us, values) in enumerate(flight.attitudes()):
        if number % 125 == 0:
            asked_ns, at_ns = int(now_ns), now_ns + delay_ns()
            request = ours.timesync_encode(0, asked_ns).pack(ours)
            answer = theirs.timesync_encode(flight.boot_us(at_ns) * 1000, asked_ns).pack(theirs)
            pieces.append(LinkBytes(asked_ns, True, bytes(request)))
            if answers:
                pieces.append(LinkBytes(int(at_ns + delay_ns()), False, bytes(answer)))
        if number % 5 == 0:
            message = theirs.attitude_quaternion_encode(stamp_us // 1000, *values, 0.0, 0.0, 0.0)
            pieces.append(LinkBytes(int(now_ns + delay_ns()), False, bytes(message.pack(theirs))))
    return sorted(pieces)


def write_recording(folder: Path, pieces: Sequence[LinkBytes]) -> tuple[Path, int]:
    """Returns the file, and Unix time minus CLOCK_MONOTONIC in it."""
    writer, converter = new_writer(folder), Converter("vehicle1")
    run = run_record(plain_settings(), GuidanceOptions(), "service1")
    offset_ns = run["unix_offset_ns"]
    for message in converter.convert("@record/run", dumps(run)):
        writer.write(message.channel, BEGIN_NS + offset_ns, message.data)
    for number, piece in enumerate(pieces):
        for message in converter.convert("@record/mavlink", pack_link_bytes(number, [piece])):
            writer.write(*message)
    writer.close()
    return writer.path, offset_ns


class UlogBytes:
    """Writes a ULog by its specification (https://docs.px4.io/main/en/dev_log/ulog_file_format)."""

    def __init__(self, start_us: int) -> None:
        self.data = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", start_us))
        self._message("B", bytes(40))
        self._subscribed = 0

    def _message(self, kind: str, body: bytes) -> None:
        self.data += struct.pack("<HB", len(body), ord(kind)) + body

    def define(self, name: str, fields: str) -> None:
        self._message("F", f"{name}:{fields}".encode())

    def subscribe(self, name: str, instance: int = 0) -> int:
        self._message("A", struct.pack("<BH", instance, self._subscribed) + name.encode())
        self._subscribed += 1
        return self._subscribed - 1

    def add(self, identifier: int, body: bytes) -> None:
        self._message("D", struct.pack("<H", identifier) + body)

    def log(self, level: int, stamp_us: int, text: str) -> None:
        self._message("L", struct.pack("<BQ", ord(str(level)), stamp_us) + text.encode())

    def gap(self, duration_ms: int) -> None:
        self._message("O", struct.pack("<H", duration_ms))


def ulog_of(flight: Flight, begin_s: float, end_s: float, **formats: str) -> UlogBytes:
    """The log of a part of a flight: the attitude at about 20 Hz, and one text in the middle.

    Args:
        formats: name → fields, of further messages.
    """
    ulog = UlogBytes(flight.boot_us(BEGIN_NS + begin_s * 1e9))
    for name, fields in {"vehicle_attitude": ATTITUDE, **formats}.items():
        ulog.define(name, fields)
    identifier = ulog.subscribe("vehicle_attitude")
    rows = list(flight.attitudes())[round(begin_s * 250) : round(end_s * 250) : 13]
    for number, (_, stamp_us, values) in enumerate(rows):
        ulog.add(identifier, struct.pack("<Q4f", stamp_us, *values))
        if number == len(rows) // 2:
            ulog.log(4, stamp_us, "high wind")
    return ulog


def write_ulog(path: Path, flight: Flight, begin_s: float, end_s: float) -> None:
    """Write `ulog_of`."""
    path.write_bytes(ulog_of(flight, begin_s, end_s).data)
