"""Detects streams below their rate and schedules requests for them. Pure: no link, no clock.

Rates are measured in consecutive windows: a stream below half of its rate in a window is missing. It is
requested, and again after a pause that doubles, until a window has enough messages.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

WINDOW_S = 2.0
_MIN_RATIO = 0.5  # of the expected rate
_MESSAGES_PER_WINDOW = 2.0  # expected; a slower stream has a longer window
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 2.0, 8.0


@dataclass(slots=True)
class _Stream:
    expected_hz: float
    began_ns: int
    window_ns: int
    count: int = 0
    is_missing: bool = False
    ask_at_ns: int = 0
    pause_s: float = _FIRST_PAUSE_S

    def begin_window(self, now_ns: int, window_s: float) -> None:
        self.count, self.began_ns, self.window_ns = 0, now_ns, round(window_s * 1e9)


class StreamMonitor:
    """Counts the messages of each stream. All stamps are of one clock, nanoseconds.

    Args:
        expected_hz: message id → expected rate.
        optional: message ids that an autopilot may refuse; then they are not missing.
        first_window_s: length of the first window after `restart`, before the first requests.
    """

    def __init__(
        self,
        expected_hz: Mapping[int, float],
        now_ns: int,
        *,
        optional: Collection[int] = (),
        first_window_s: float = WINDOW_S,
    ) -> None:
        self._expected_hz, self._optional = dict(expected_hz), frozenset(optional)
        self._first_window_s = first_window_s
        self.restart(now_ns)

    def restart(self, now_ns: int) -> None:
        """Start over: the link has opened or returned, or the autopilot has restarted."""
        window_ns = round(self._first_window_s * 1e9)
        self._streams = {
            message_id: _Stream(expected_hz, now_ns, window_ns)
            for message_id, expected_hz in self._expected_hz.items()
        }

    def received(self, message_id: int) -> None:
        """Count one message of the autopilot."""
        stream = self._streams.get(message_id)
        if stream is not None:
            stream.count += 1

    def due(self, now_ns: int) -> list[int]:
        """Return the message ids to request now. Call several times a second; `asked` starts the pause."""
        for stream in self._streams.values():
            elapsed_ns = now_ns - stream.began_ns
            if elapsed_ns < stream.window_ns:
                continue
            stream.is_missing = stream.count < _MIN_RATIO * stream.expected_hz * elapsed_ns * 1e-9
            stream.begin_window(now_ns, max(WINDOW_S, _MESSAGES_PER_WINDOW / stream.expected_hz))
            if not stream.is_missing:
                stream.ask_at_ns, stream.pause_s = 0, _FIRST_PAUSE_S
        return [
            message_id
            for message_id, stream in self._streams.items()
            if stream.is_missing and now_ns >= stream.ask_at_ns
        ]

    def asked(self, message_id: int, now_ns: int) -> None:
        """Note a request: a new window starts, and the pause doubles."""
        stream = self._streams[message_id]
        stream.ask_at_ns = now_ns + round(stream.pause_s * 1e9)
        stream.pause_s = min(2.0 * stream.pause_s, _LONGEST_PAUSE_S)
        stream.begin_window(now_ns, max(WINDOW_S, _MESSAGES_PER_WINDOW / stream.expected_hz))

    def refused(self, message_id: int) -> None:
        """Note a refusal: an optional stream is not requested again until `restart`."""
        if message_id in self._optional:
            self._streams.pop(message_id, None)

    @property
    def missing(self) -> tuple[int, ...]:
        """The message ids below half of their rate in their last window."""
        return tuple(message_id for message_id, stream in self._streams.items() if stream.is_missing)
