"""The autopilot's boot clock in a recording, and whether another log has the same clock.

The service sends a TIMESYNC request twice a second; requests and answers are in the recorded MAVLink. The
error of one answer is half of its round trip at most. The best answers are joined by straight lines.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common as mavlink

from companion.recording import RecordingError
from companion.recording.files import RecordingReader
from companion.recording.tlog import link_frames
from companion.vehicle.clock_sync import DRIFT, LONGEST_TRIP_NS

_TIMESYNC = struct.Struct("<qq")  # tc1, ts1
# Messages that PX4 fills from a topic of its log, with that topic's stamp: uint32 milliseconds, then floats.
LOGGED = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: ("vehicle_attitude", ("q[0]", "q[1]", "q[2]", "q[3]")),
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: ("vehicle_local_position", ("x", "y", "z")),
}
# Different values, equal to the last bit in the same millisecond: not by chance.
MIN_EQUAL = 3
_RESTART_MS = 1000  # older stamps than the newest by more are of the next boot
# The best answer of each window is used: long windows suit a slow link, short ones an uneven simulated clock.
_WINDOWS_NS = (1, 2 * 10**9, 5 * 10**9, 10 * 10**9)


@dataclass
class Boot:
    """One boot of an autopilot, as recorded.

    Attributes:
        answers: (boot time, Unix time minus boot time, bound of its error), nanoseconds.
        samples: message → (Unix time of arrival, its first bytes: stamp and the values in `LOGGED`).
    """

    answers: list[tuple[int, int, int]] = field(default_factory=list)
    samples: dict[int, list[tuple[int, bytes]]] = field(default_factory=lambda: {each: [] for each in LOGGED})
    newest_ms: int = 0


def read_boots(reader: RecordingReader) -> list[Boot]:
    """Return the boots of all autopilots on the recorded link that answered TIMESYNC."""
    asked: dict[int, int] = {}
    current: dict[int, Boot] = {}
    found: list[Boot] = []
    for log_time_ns, sent, frame in link_frames(reader):
        if sent:
            if frame.message_id == mavlink.MAVLINK_MSG_ID_TIMESYNC:
                asked[_TIMESYNC.unpack(frame.padded(_TIMESYNC.size))[1]] = log_time_ns
            continue
        if frame.component_id != mavlink.MAV_COMP_ID_AUTOPILOT1:
            continue
        answer, sample = None, b""
        if frame.message_id == mavlink.MAVLINK_MSG_ID_TIMESYNC:
            boot_ns, stamp_ns = _TIMESYNC.unpack(frame.padded(_TIMESYNC.size))
            asked_ns = asked.pop(stamp_ns, log_time_ns + 1)  # without a request the trip is negative
            trip_ns = log_time_ns - asked_ns
            if boot_ns <= 0 or not 0 <= trip_ns <= LONGEST_TRIP_NS:  # or a request of the autopilot's
                continue
            answer = (boot_ns, (asked_ns + log_time_ns) // 2 - boot_ns, (trip_ns + 1) // 2)
            boot_ms = boot_ns // 1_000_000
        elif frame.message_id in LOGGED:
            sample = frame.padded(4 * (1 + len(LOGGED[frame.message_id][1])))
            boot_ms = int.from_bytes(sample[:4], "little")
        else:
            continue
        boot = current.get(frame.system_id)
        if boot is None or boot_ms < boot.newest_ms - _RESTART_MS:
            boot = current[frame.system_id] = Boot()
            found.append(boot)
        boot.newest_ms = max(boot.newest_ms, boot_ms)
        if answer:
            boot.answers.append(answer)
        else:
            boot.samples[frame.message_id].append((log_time_ns, sample))
    return [boot for boot in found if boot.answers]


class BootClock:
    """Converts boot time to Unix time, linearly between answers; with the same offset before and after them.

    Args:
        answers: as in `Boot`.
        window_ns: the best answer of each window of this length is used.
    """

    def __init__(self, answers: Sequence[tuple[int, int, int]], window_ns: int) -> None:
        boot_ns, offsets, errors = np.array(sorted(answers), dtype=np.int64).T
        windows = (boot_ns - boot_ns[0]) // window_ns
        order = np.lexsort((errors, windows))
        best = order[np.unique(windows[order], return_index=True)[1]]
        self._boot_ns, self._offsets, self._errors = boot_ns[best], offsets[best], errors[best]
        self._all = boot_ns, offsets, errors

    def to_unix(self, boot_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return Unix time, nanoseconds."""
        return boot_ns + self._offset(boot_ns)

    def _offset(self, boot_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        # Relative to the first: a double holds Unix time to 0.2 us only.
        begin_ns, first_ns = self._boot_ns[0], self._offsets[0]
        relative = np.interp(boot_ns - begin_ns, self._boot_ns - begin_ns, self._offsets - first_ns)
        return np.asarray(first_ns + np.round(relative).astype(np.int64))

    def error_ns(self, begin_ns: int, end_ns: int) -> int:
        """Return the bound of the error of `to_unix` between two boot times.

        It is the largest of the used answers, and by how much any answer contradicts the straight lines.
        """
        used = _around(self._boot_ns, begin_ns, end_ns)
        boot_ns, offsets, errors = (each[_around(self._all[0], begin_ns, end_ns)] for each in self._all)
        excess = np.abs(offsets - self._offset(boot_ns)) - errors
        outside_ns = max(0, int(boot_ns[0]) - begin_ns, end_ns - int(boot_ns[-1]))
        return int(self._errors[used].max() + max(0, excess.max()) + outside_ns * DRIFT)


def _around(values: NDArray[np.int64], begin: int, end: int) -> slice:
    """The sorted values from `begin` to `end`, and one before and after them."""
    first, last = np.searchsorted(values, (begin, end))
    return slice(max(0, int(first) - 1), int(last) + 1)


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
    spans = ", ".join(f"{boot.answers[0][0] / 1e9:.1f} to {boot.answers[-1][0] / 1e9:.1f}" for boot in boots)
    log_span = f"the log has boot time {begin_ns / 1e9:.1f} to {end_ns / 1e9:.1f} s"
    overlapping = [boot for boot in boots if boot.answers[0][0] <= end_ns and begin_ns <= boot.answers[-1][0]]
    if not overlapping:
        raise RecordingError(f"another flight: {log_span}, the recording {spans} s")
    equal, boot = max(
        ((_equal_samples(boot, logged), boot) for boot in overlapping), key=lambda each: len(each[0])
    )
    if len({sample[4:] for _, sample in equal}) < MIN_EQUAL:
        raise RecordingError(
            f"another flight, or too short: {log_span}, the recording {spans} s, but {len(equal)} samples of "
            f"attitude and position are equal; expected {MIN_EQUAL} different ones at least"
        )
    clocks = [BootClock(boot.answers, window_ns) for window_ns in _WINDOWS_NS]
    clock = min(clocks, key=lambda each: each.error_ns(begin_ns, end_ns))
    error_ns = clock.error_ns(begin_ns, end_ns)
    begin_unix_ns, end_unix_ns = (int(each) for each in clock.to_unix(np.array([begin_ns, end_ns])))
    arrived = np.array([log_time_ns for log_time_ns, _ in equal])
    stamped_ms = np.array([int.from_bytes(sample[:4], "little") for _, sample in equal])
    delays = arrived - clock.to_unix(stamped_ms * 1_000_000)
    early_ns = -int(delays.min())
    if early_ns > error_ns:  # the clock paused between two answers, as that of a loaded simulation does
        error_ns += early_ns
    return Alignment(
        clock,
        begin_ns,
        end_ns,
        offset_ns=begin_unix_ns - begin_ns,
        drift=(end_unix_ns - begin_unix_ns) / max(1, end_ns - begin_ns) - 1,
        error_ns=error_ns,
        equal=len(equal),
        least_delay_ns=-early_ns,
        median_delay_ns=int(np.median(delays)),
    )


def _equal_samples(boot: Boot, logged: Mapping[int, Set[bytes]]) -> list[tuple[int, bytes]]:
    return [
        each for message, samples in boot.samples.items() for each in samples if each[1] in logged[message]
    ]
