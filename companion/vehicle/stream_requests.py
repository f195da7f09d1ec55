"""The streams that are needed: measured for a moment, and asked for where they come too slowly."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any

from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.heard_state import HeardState
from companion.vehicle.mav_result import ACCEPTED, result_name

logger = logging.getLogger(__name__)

_SET_MESSAGE_INTERVAL = 511
_REQUEST_MESSAGE = 512
_MEASURE_S = 1.5
_RATE_TOLERANCE = 0.7


async def ask_for_streams(
    url: object, heard: HeardState, received_count: Counter[int], command: Callable[..., Awaitable[int]]
) -> None:
    """SET_MESSAGE_INTERVAL for what comes too slowly, and home's position if it has not come.

    Args:
        url: of the link, for the log. heard: what the autopilot shows.
        received_count: how often each message, by its id, has come; begun anew here.
        command: sends one command with its parameters; the MAV_RESULT.
    """
    heard.restarted.clear()
    received_count.clear()
    began = time.monotonic()
    await asyncio.sleep(_MEASURE_S)
    elapsed_s = time.monotonic() - began
    requests: list[tuple[int, tuple[Any, ...]]] = [
        (_SET_MESSAGE_INTERVAL, (message_id, round(1e6 / rate_hz)))
        for message_id, rate_hz in heard.manners.rates_hz.items()
        if received_count[message_id] / elapsed_s < _RATE_TOLERANCE * rate_hz
    ]
    if heard.state.home_altitude_amsl_m is None:
        requests += [(_REQUEST_MESSAGE, (message_id,)) for message_id in heard.manners.requested]
    for number, parameters in requests:
        try:
            result = await command(number, *parameters)
        except CommandRefusedError as error:
            logger.warning("%s: asking for message %d: %s", url, parameters[0], error)
            return  # the link is down; it is asked again when it is back
        if result != ACCEPTED:
            what = "at the rate wanted" if number == _SET_MESSAGE_INTERVAL else "now"
            logger.info(
                "%s: the autopilot does not send message %d %s (%s)",
                url,
                parameters[0],
                what,
                result_name(result),
            )
