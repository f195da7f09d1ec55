"""What a ground station is to know beside the cameras: warnings of the service, and the computer's state."""

from __future__ import annotations

import shutil
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station.component import Message

_S = 1_000_000_000
# Texts to a station: one a second, five at once; the same one every 10 s.
_TEXT_NS, _BURST, _SAME_NS = _S, 5, 10 * _S
_MOST_WAITING, _TEXTS_KEPT = 20, 64
_CHUNK_BYTES, _LONGEST_BYTES = 50, 400
_SEVERITIES = {"warning": mavlink.MAV_SEVERITY_WARNING, "error": mavlink.MAV_SEVERITY_ERROR}
# An event of before the start of this process, which the bus has kept, is no news.
_OLDEST_NS = 30 * _S
# Lines of this process, and why a click failed, which it adds directly; texts that the autopilot has sent.
_NO_NEWS = ("ground_station: ", "select ", "follow track=", "autopilot: ")
_LOSSES_NS = 10 * _S
T = TypeVar("T")
# "Unknown" of ONBOARD_COMPUTER_STATUS.
_U8, _U32, _I8, _I16 = 0xFF, 0xFFFF_FFFF, 0x7F, 0x7FFF


class StatusTexts:
    """STATUSTEXT of warnings and errors, limited.

    Attributes:
        lost: texts that were too many to be sent.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, str]] = deque()
        self._sent: OrderedDict[str, int] = OrderedDict()
        self._allowance, self._filled_ns = float(_BURST), 0
        self._id = 0
        self.lost = 0

    def on_event(self, level: str, text: str, stamp_ns: int, now_ns: int) -> None:
        """Use an event of the service."""
        severity = _SEVERITIES.get(level)
        if severity is not None and now_ns - stamp_ns < _OLDEST_NS and not text.startswith(_NO_NEWS):
            self.add(severity, text, now_ns)

    def add(self, severity: int, text: str, now_ns: int) -> None:
        """Send a text as soon as the limits allow."""
        before_ns = self._sent.pop(text, None)
        if before_ns is not None and now_ns - before_ns < _SAME_NS:
            self._sent[text] = before_ns
            return
        self._sent[text] = now_ns
        if len(self._sent) > _TEXTS_KEPT:
            self._sent.popitem(last=False)
        self._waiting.append((severity, text))
        if len(self._waiting) > _MOST_WAITING:
            self._waiting.popleft()
            self.lost += 1

    def due(self, now_ns: int) -> Iterable[Message]:
        """Return the texts that may be sent now."""
        self._allowance = min(_BURST, self._allowance + (now_ns - self._filled_ns) / _TEXT_NS)
        self._filled_ns = now_ns
        while self._waiting and self._allowance >= 1.0:
            self._allowance -= 1.0
            yield from self._chunks(*self._waiting.popleft())

    def _chunks(self, severity: int, text: str) -> Iterable[Message]:
        chunks = chunks_of(text)
        self._id = 0 if len(chunks) == 1 else self._id % 0xFFFF + 1
        for index, chunk in enumerate(chunks):
            yield mavlink.MAVLink_statustext_message(severity, chunk, self._id, index)


def chunks_of(text: str) -> list[bytes]:
    """Return a text in chunks of STATUSTEXT; no character is divided. A very long text is cut."""
    chunks, chunk, size = [], b"", 0
    for character in " ".join(text.split()):
        encoded = character.encode()
        if size + len(encoded) > _LONGEST_BYTES:
            break
        size += len(encoded)
        if len(chunk) + len(encoded) > _CHUNK_BYTES:
            chunks.append(chunk)
            chunk = b""
        chunk += encoded
    if chunks and len(chunk) == _CHUNK_BYTES:  # the last chunk of several ends with a zero
        return [*chunks, chunk, b""]
    return [*chunks, chunk]


def reported_losses(
    counts: Mapping[str, Callable[[], int]], say: Callable[[str], None]
) -> Callable[[int], Iterable[Message]]:
    """Return a source that says every 10 s which counts have risen. `counts`: what was lost, and why."""
    reported, next_ns = dict.fromkeys(counts, 0), 0

    def due(now_ns: int) -> Iterable[Message]:
        nonlocal next_ns
        if now_ns >= next_ns:
            next_ns = now_ns + _LOSSES_NS
            for what, count in counts.items():
                if (lost := count()) > reported[what]:
                    say(f"{lost - reported[what]} {what}")
                    reported[what] = lost
        return []

    return due


class ComputerStatus:
    """ONBOARD_COMPUTER_STATUS once a second, of Linux; what it does not say has the value of "unknown".

    Args:
        directory: whose disk is reported.
    """

    def __init__(self, directory: Path, root: Path = Path("/")) -> None:
        self._directory, self._root = directory, root
        self._times: list[tuple[int, int]] = []
        self._next_ns = 0

    def due(self, now_ns: int) -> Iterable[Message]:
        """Return the message when it is due."""
        if now_ns < self._next_ns:
            return []
        self._next_ns = (now_ns if now_ns - self._next_ns > _S else self._next_ns) + _S
        return [self._message()]

    def _message(self) -> Message:
        total_mib, free_mib = self._memory_mib()
        unused = [_U32] * 4
        disk = _read(lambda: shutil.disk_usage(self._directory), None)
        kept = [_U32] * 3
        return mavlink.MAVLink_onboard_computer_status_message(
            time.time_ns() // 1000,
            time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1_000_000 & _U32,
            0,
            self._cores(),
            [_U8] * 10,
            [_U8] * 4,
            [_U8] * 10,
            self._temperature_c(),
            [_I8] * 8,
            [_I16] * 4,
            _U32 if total_mib is None or free_mib is None else total_mib - free_mib,
            _U32 if total_mib is None else total_mib,
            unused,
            unused if disk is None else [disk.used >> 20, *kept],
            unused if disk is None else [disk.total >> 20, *kept],
            *[[_U32] * 6] * 5,
        )

    def _cores(self) -> list[int]:
        """Return the load of the first eight cores since the last call, percent."""
        lines = self._lines("proc/stat")
        fields = [
            list(map(int, line.split()[1:])) for line in lines if line[:3] == "cpu" and line[3].isdigit()
        ]
        times = [
            (sum(each[:8]), each[3] + each[4]) for each in fields[:8]
        ]  # all; idle and waiting for a disk
        before, self._times = self._times, times
        loads = []
        for (total, idle), (total_before, idle_before) in zip(times, before, strict=False):
            share = 1 - (idle - idle_before) / (total - total_before) if total > total_before else 0.0
            loads.append(round(100 * min(max(share, 0.0), 1.0)))
        return (loads + [_U8] * 8)[:8]

    def _memory_mib(self) -> tuple[int | None, int | None]:
        """Return all memory and what programs may still have, MiB."""
        words = [line.split() for line in self._lines("proc/meminfo")]
        kib = {each[0]: int(each[1]) for each in words if len(each) > 1 and each[1].isdecimal()}
        total, free = kib.get("MemTotal:"), kib.get("MemAvailable:")
        return (None if total is None else total >> 10), (None if free is None else free >> 10)

    def _temperature_c(self) -> int:
        """Return the highest temperature that the kernel reports, °C."""
        zones = self._root.glob("sys/class/thermal/thermal_zone*/temp")
        texts = [_read(zone.read_text, "").strip() for zone in zones]
        values = [int(text) // 1000 for text in texts if text.removeprefix("-").isdecimal()]
        return max((value for value in values if -128 <= value < _I8), default=_I8)

    def _lines(self, path: str) -> list[str]:
        return _read((self._root / path).read_text, "").splitlines()


def _read(read: Callable[[], T], otherwise: T) -> T:
    try:
        return read()
    except OSError:
        return otherwise
