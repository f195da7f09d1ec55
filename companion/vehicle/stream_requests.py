"""Requests the required streams from the autopilot until they arrive, and again when they stop."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace

from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.framing import CURRENT_MODE_ID, EKF_STATUS_REPORT_ID
from companion.vehicle.mav_result import ACCEPTED, result_name
from companion.vehicle.stream_monitor import StreamMonitor
from companion.vehicle.telemetry_state import TelemetryState

logger = logging.getLogger(__name__)

_SET_MESSAGE_INTERVAL = 511
_REQUEST_MESSAGE = 512
_MEASURE_S = 1.5
_CHECK_S = 0.2
# Messages that pymavlink's "common" does not have.
_NAMES = {CURRENT_MODE_ID: "CURRENT_MODE", EKF_STATUS_REPORT_ID: "EKF_STATUS_REPORT"}


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
        if result == ACCEPTED:
            self._refused.discard(message_id)
            return
        self.monitor.refused(message_id)
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
