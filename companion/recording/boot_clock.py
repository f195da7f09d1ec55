"""The autopilot's boot clock in a recording, and whether another log has the same clock.

The service sends a TIMESYNC request twice a second; requests and answers are in the recorded MAVLink. As in
flight (`companion.vehicle.clock_sync`) the shortest round trip of the last ten seconds is used.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Set
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common as mavlink

from companion.recording import RecordingError
from companion.recording.files import RecordingReader
from companion.recording.tlog import link_frames
from companion.vehicle.clock_sync import DRIFT, ClockSync

_TIMESYNC = struct.Struct("<qq")  # tc1, ts1
# Messages that PX4 fills from a topic of its log, with that topic's stamp: uint32 milliseconds, then floats.
LOGGED = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: ("vehicle_attitude", ("q[0]", "q[1]", "q[2]", "q[3]")),
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: ("vehicle_local_position", ("x", "y", "z")),
}
# Different values, equal to the last bit in the same millisecond: not by chance.
MIN_EQUAL = 3
_RESTART_MS = 1000  # older stamps than the newest by more are of the next boot


@dataclass
class Boot:
    """One boot of an autopilot, as recorded.

    Attributes:
        nodes: (Unix time of an answer, boot time minus Unix time, bound of its error), nanoseconds.
        samples: message → (Unix time of arrival, its first bytes: stamp and the values in `LOGGED`).
    """

    nodes: list[tuple[int, int, int]] = field(default_factory=list)
    samples: dict[int, list[tuple[int, bytes]]] = field(default_factory=lambda: {each: [] for each in LOGGED})
    newest_ms: int = 0
    sync: ClockSync = field(default_factory=ClockSync)


def read_boots(reader: RecordingReader) -> list[Boot]:
    """Return the boots of all autopilots on the recorded link that answered TIMESYNC."""
    asked: dict[int, int] = {}
    current: dict[int, Boot] = {}
    found: list[Boot] = []
    for log_time_ns, sent, frame in link_frames(reader):
        if frame.message_id == mavlink.MAVLINK_MSG_ID_TIMESYNC:
            boot_ns, stamp_ns = _TIMESYNC.unpack(frame.padded(_TIMESYNC.size))
            if sent:
                asked[stamp_ns] = log_time_ns
                continue
            asked_ns = asked.pop(stamp_ns, None)
            if asked_ns is None or boot_ns <= 0:  # a request of the autopilot's
                continue
            boot_ms = boot_ns // 1_000_000
        elif frame.message_id in LOGGED and not sent:
            sample = frame.padded(4 * (1 + len(LOGGED[frame.message_id][1])))
            boot_ms = int.from_bytes(sample[:4], "little")
        else:
            continue
        if frame.component_id != mavlink.MAV_COMP_ID_AUTOPILOT1:
            continue
        boot = current.get(frame.system_id)
        if boot is None or boot_ms < boot.newest_ms - _RESTART_MS:
            boot = current[frame.system_id] = Boot()
            found.append(boot)
        boot.newest_ms = max(boot.newest_ms, boot_ms)
        if frame.message_id in LOGGED:
            boot.samples[frame.message_id].append((log_time_ns, sample))
        elif boot.sync.answer(asked_ns, boot_ns, log_time_ns):
            known = boot.sync.offset(log_time_ns)
            assert known is not None
            boot.nodes.append((log_time_ns, known.offset_ns, known.error_ns))
    return [boot for boot in found if boot.nodes]


class BootClock:
    """Converts boot time to Unix time, linearly between the answers; the same offset before and after them.

    Attributes:
        begin_ns, end_ns: boot time of the first and last answer.
    """

    def __init__(self, boot: Boot) -> None:
        times, offsets, errors = np.array(boot.nodes, dtype=np.int64).T
        self._boot_ns, self._offsets, self._errors = times + offsets, offsets, errors
        self.begin_ns, self.end_ns = int(self._boot_ns[0]), int(self._boot_ns[-1])

    def to_unix(self, boot_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return Unix time, nanoseconds."""
        # Relative to the first: a double holds Unix time to 0.2 us only.
        relative = np.interp(
            boot_ns - self.begin_ns, self._boot_ns - self.begin_ns, self._offsets - self._offsets[0]
        )
        return boot_ns - self._offsets[0] - np.round(relative).astype(np.int64)

    def error_ns(self, begin_ns: int, end_ns: int) -> int:
        """Return the bound of the error of `to_unix` between two boot times.

        Neighbouring answers that contradict each other (a simulated clock that does not run evenly) widen it.
        """
        first, last = np.searchsorted(self._boot_ns, (begin_ns, end_ns))
        used = slice(max(0, first - 1), last + 1)
        errors, steps = self._errors[used], np.abs(np.diff(self._offsets[used]))
        excess = np.maximum(0, steps - errors[1:] - errors[:-1])
        outside_ns = max(0, self.begin_ns - begin_ns, end_ns - self.end_ns)
        return int(errors.max() + excess.max(initial=0) + outside_ns * DRIFT)


@dataclass(frozen=True, slots=True)
class Alignment:
    """The clock of a log of the autopilot against the recording's.

    Attributes:
        clock: converts the log's stamps.
        begin_ns, end_ns: of the log, boot time.
        offset_ns: Unix time minus boot time at the log's begin.
        drift: change of the same per time.
        error_ns: bound of the error of all stamps.
        equal: samples that are in both.
        least_delay_ns, median_delay_ns: from the stamps of those to their arrival.
    """

    clock: BootClock
    begin_ns: int
    end_ns: int
    offset_ns: int
    drift: float
    error_ns: int
    equal: int
    least_delay_ns: int
    median_delay_ns: int


def align(boots: list[Boot], begin_ns: int, end_ns: int, logged: Mapping[int, Set[bytes]]) -> Alignment:
    """Find the boot that a log is of.

    Args:
        begin_ns, end_ns: of the log, boot time.
        logged: message of `LOGGED` → the samples in the log, as in `Boot`.

    Raises:
        RecordingError: the log is not of a flight in the recording.
    """
    if not boots:
        raise RecordingError("the recording has no answers to TIMESYNC: the autopilot's clock is unknown")
    clocks = [(boot, BootClock(boot)) for boot in boots]
    spans = ", ".join(f"{clock.begin_ns / 1e9:.1f} to {clock.end_ns / 1e9:.1f}" for _, clock in clocks)
    log_span = f"the log has boot time {begin_ns / 1e9:.1f} to {end_ns / 1e9:.1f} s"
    overlapping = [
        (boot, clock) for boot, clock in clocks if clock.begin_ns <= end_ns and begin_ns <= clock.end_ns
    ]
    if not overlapping:
        raise RecordingError(f"another flight: {log_span}, the recording {spans} s")
    counted = [(_equal_samples(boot, logged), clock) for boot, clock in overlapping]
    equal, clock = max(counted, key=lambda each: len(each[0]))
    if len({sample[4:] for _, sample in equal}) < MIN_EQUAL:
        raise RecordingError(
            f"another flight, or too short: {log_span}, the recording {spans} s, but {len(equal)} samples of "
            f"attitude and position are equal; expected {MIN_EQUAL} different ones at least"
        )
    begin_unix_ns, end_unix_ns = (int(each) for each in clock.to_unix(np.array([begin_ns, end_ns])))
    arrived = np.array([log_time_ns for log_time_ns, _ in equal])
    stamped_ms = np.array([int.from_bytes(sample[:4], "little") for _, sample in equal])
    delays = arrived - clock.to_unix(stamped_ms * 1_000_000)
    return Alignment(
        clock,
        begin_ns,
        end_ns,
        offset_ns=begin_unix_ns - begin_ns,
        drift=(end_unix_ns - begin_unix_ns) / max(1, end_ns - begin_ns) - 1,
        error_ns=clock.error_ns(begin_ns, end_ns),
        equal=len(equal),
        least_delay_ns=int(delays.min()),
        median_delay_ns=int(np.median(delays)),
    )


def _equal_samples(boot: Boot, logged: Mapping[int, Set[bytes]]) -> list[tuple[int, bytes]]:
    return [
        each for message, samples in boot.samples.items() for each in samples if each[1] in logged[message]
    ]
