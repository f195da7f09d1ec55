"""Requests the required streams from the autopilot until they arrive, and again when they stop.

Rates are measured in consecutive windows: a stream below half of its rate in a window is missing. It is
requested, and again after a pause that doubles, until a window has enough messages.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Collection, Mapping
from dataclasses import dataclass, replace

from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.framing import CURRENT_MODE_ID, EKF_STATUS_REPORT_ID
from companion.vehicle.mav_result import ACCEPTED, result_name
from companion.vehicle.telemetry_state import TelemetryState

logger = logging.getLogger(__name__)

WINDOW_S = 2.0
_MIN_RATIO = 0.5  # of the expected rate
_MESSAGES_PER_WINDOW = 2.0  # expected; a slower stream has a longer window
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 2.0, 8.0
_SET_MESSAGE_INTERVAL = 511
_REQUEST_MESSAGE = 512
_MEASURE_S = 1.5
_CHECK_S = 0.2
# Messages that pymavlink's "common" does not have.
_NAMES = {CURRENT_MODE_ID: "CURRENT_MODE", EKF_STATUS_REPORT_ID: "EKF_STATUS_REPORT"}


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
        once: message ids that a vehicle may lack: after one answer they are not missing.
        first_window_s: length of the first window after `restart`, before the first requests.
    """

    def __init__(
        self,
        expected_hz: Mapping[int, float],
        now_ns: int,
        *,
        optional: Collection[int] = (),
        once: Collection[int] = (),
        first_window_s: float = WINDOW_S,
    ) -> None:
        self._expected_hz, self._optional = dict(expected_hz), frozenset(optional)
        self._once = frozenset(once)
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
        stream = self._streams.get(message_id)
        if stream is None:  # an earlier answer has removed it
            return
        stream.ask_at_ns = now_ns + round(stream.pause_s * 1e9)
        stream.pause_s = min(2.0 * stream.pause_s, _LONGEST_PAUSE_S)
        stream.begin_window(now_ns, max(WINDOW_S, _MESSAGES_PER_WINDOW / stream.expected_hz))

    def answered(self, message_id: int, *, accepted: bool) -> None:
        """Note an answer: an optional stream, if refused, is not requested again until `restart`."""
        if message_id in self._once or (not accepted and message_id in self._optional):
            self._streams.pop(message_id, None)

    @property
    def missing(self) -> tuple[int, ...]:
        """The message ids below half of their rate in their last window."""
        return tuple(message_id for message_id, stream in self._streams.items() if stream.is_missing)


class StreamRequests:
    """Sends SET_MESSAGE_INTERVAL for slow streams, and requests home's position until it is known.

    Args:
        url: of the link, for the log. telemetry: the autopilot's state, with its profile selected.
        command: sends one command with its parameters and returns the MAV_RESULT.
    """

    def __init__(
        self, url: object, telemetry: TelemetryState, command: Callable[..., Awaitable[int]]
    ) -> None:
        self._url, self._telemetry, self._command = url, telemetry, command
        self._refused: set[int] = set()
        self._asked_before = self._unanswered = False
        self.monitor = StreamMonitor(
            {**telemetry.profile.rates_hz, **telemetry.profile.expected_hz},
            time.monotonic_ns(),
            optional=telemetry.profile.optional,
            once=telemetry.profile.once,
            first_window_s=_MEASURE_S,
        )

    def restart(self) -> None:
        """Start over: the link has returned, or the autopilot has restarted."""
        self.monitor.restart(time.monotonic_ns())

    async def run(self) -> None:
        """Request missing streams until cancelled; nothing is requested without a heartbeat."""
        while True:
            await asyncio.sleep(_CHECK_S)
            due = self.monitor.due(time.monotonic_ns())
            self._update_state()
            if due and self._telemetry.state.connected(time.monotonic_ns()):
                await self._request(due)

    def _update_state(self) -> None:
        """Write the missing streams into the state, and log changes."""
        names = tuple(message_name(message_id) for message_id in self.monitor.missing)
        before = self._telemetry.state.missing_streams
        if names == before:
            return
        self._telemetry.state = replace(self._telemetry.state, missing_streams=names)
        if not names:
            logger.info("%s: all streams received", self._url)
            return
        # Usual at the start: most autopilots send few streams without a request, and some begin late.
        lost = self._asked_before and set(names) - set(before)
        level = logging.WARNING if lost else logging.INFO
        logger.log(level, "%s: streams missing or too slow, requested: %s", self._url, ", ".join(names))
        self._asked_before = True

    async def _request(self, due: list[int]) -> None:
        profile = self._telemetry.profile
        for message_id in due:
            requests: list[tuple[float, ...]] = [
                (_SET_MESSAGE_INTERVAL, message_id, round(1e6 / profile.rates_hz[message_id]))
            ]
            if message_id in profile.requested and self._telemetry.state.home_altitude_amsl_m is None:
                requests.append((_REQUEST_MESSAGE, message_id))
            for number, *parameters in requests:
                try:
                    result = await self._command(number, *parameters)
                except CommandRefusedError as error:
                    if not self._unanswered:
                        logger.warning(
                            "%s: request for %s: %s; retrying", self._url, message_name(message_id), error
                        )
                    self._unanswered = True
                    for waiting in due:  # they would not be answered either
                        self.monitor.asked(waiting, time.monotonic_ns())
                    return
                self._unanswered = False
                if number == _SET_MESSAGE_INTERVAL:
                    self._on_answer(message_id, result)

    def _on_answer(self, message_id: int, result: int) -> None:
        self.monitor.asked(message_id, time.monotonic_ns())
        self.monitor.answered(message_id, accepted=result == ACCEPTED)
        if result == ACCEPTED:
            self._refused.discard(message_id)
            return
        if message_id not in self._refused:
            self._refused.add(message_id)
            logger.info(
                "%s: requested rate of %s refused (%s)",
                self._url,
                message_name(message_id),
                result_name(result),
            )


def message_name(message_id: int) -> str:
    """Return MAVLink's name of a message."""
    if message_id in _NAMES:
        return _NAMES[message_id]
    message = mavlink.mavlink_map.get(message_id)
    return f"message {message_id}" if message is None else str(message.msgname)
