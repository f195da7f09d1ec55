"""Asks the autopilot for the streams that are needed until they come, and again when they stop."""

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
    """SET_MESSAGE_INTERVAL for what comes too slowly, and home's position until it is known.

    Args:
        url: of the link, for the log. telemetry: what the autopilot shows; its profile are known.
        command: sends one command with its parameters; the MAV_RESULT.
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
        """The link is back, or the autopilot has restarted."""
        self.monitor.restart(time.monotonic_ns())

    async def keep(self) -> None:
        """Ask for what is missing, for ever. Nothing is asked of an autopilot that is not heard."""
        while True:
            await asyncio.sleep(_CHECK_S)
            due = self.monitor.due(time.monotonic_ns())
            self._show()
            if due and self._telemetry.state.connected(time.monotonic_ns()):
                await self._ask_for(due)

    def _show(self) -> None:
        """What is missing into the state, and into the log when it changes."""
        names = tuple(message_name(message_id) for message_id in self.monitor.missing)
        if names == self._telemetry.state.missing_streams:
            return
        self._telemetry.state = replace(self._telemetry.state, missing_streams=names)
        if not names:
            logger.info("%s: every stream comes", self._url)
            return
        # At the beginning it is usual: most autopilots send little unasked.
        level = logging.WARNING if self._asked_before else logging.INFO
        logger.log(level, "%s: missing or too slow, asked for: %s", self._url, ", ".join(names))
        self._asked_before = True

    async def _ask_for(self, due: list[int]) -> None:
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
                            "%s: asking for %s: %s; trying on", self._url, message_name(message_id), error
                        )
                    self._unanswered = True
                    for waiting in due:  # they would fare no better
                        self.monitor.asked(waiting, time.monotonic_ns())
                    return
                self._unanswered = False
                if number == _SET_MESSAGE_INTERVAL:
                    self._take_answer(message_id, result)

    def _take_answer(self, message_id: int, result: int) -> None:
        self.monitor.asked(message_id, time.monotonic_ns())
        if result == ACCEPTED:
            self._refused.discard(message_id)
            return
        self.monitor.refused(message_id)
        if message_id not in self._refused:
            self._refused.add(message_id)
            logger.info(
                "%s: the autopilot does not send %s at the rate wanted (%s)",
                self._url,
                message_name(message_id),
                result_name(result),
            )


def message_name(message_id: int) -> str:
    """MAVLink's name of a message, as people know it."""
    if message_id in _NAMES:
        return _NAMES[message_id]
    message = mavlink.mavlink_map.get(message_id)
    return f"message {message_id}" if message is None else str(message.msgname)
