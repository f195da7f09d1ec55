"""ArduPilot's parameter protocol: no hash, no errors; a changed value is sent on every link.

Invalid requests (an unknown name, a non-finite value) are ignored. Values are numbers whatever their type,
and a wrong `param_type` is accepted. An answer to a name, and to a set, has the index 65535.
"""

from __future__ import annotations

import logging
from collections import deque
from functools import partial
from typing import Any

from mavlink_sim.px4.parameters import Parameter
from mavlink_sim.vehicles.ardupilot import streams
from mavlink_sim.vehicles.ardupilot.context import CopterContext
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import dialect

logger = logging.getLogger(__name__)

NO_INDEX = 65535
FIRST_ANSWER_S = 0.01


def request_list(vehicle: CopterContext, link: Link, message: Any) -> None:
    """PARAM_REQUEST_LIST: all of them in the order of their indices."""

    def begin() -> None:
        link.parameters_left = deque(vehicle.parameters)
        link.parameter_credit = 0.0

    vehicle.after(FIRST_ANSWER_S, begin)


def request_read(vehicle: CopterContext, link: Link, message: Any) -> None:
    """PARAM_REQUEST_READ, by index or (index -1) by name."""
    index = int(message.param_index)
    parameters = vehicle.parameters
    parameter = parameters.at(index) if index >= 0 else parameters.get(_text_of(message.param_id))
    if parameter is not None:
        vehicle.after(0.0, partial(_send_value, vehicle, link, parameter, index if index >= 0 else NO_INDEX))


def set_parameter(vehicle: CopterContext, link: Link, message: Any) -> None:
    """PARAM_SET: truncate and clamp the value to its type, then send it on every link."""
    name = _text_of(message.param_id)
    if name not in vehicle.parameters:
        return
    try:
        parameter = vehicle.parameters.set(name, float(message.param_value))
    except ValueError as error:
        logger.info("PARAM_SET is ignored: %s", error)
        return
    vehicle.unsaved_rates.pop(name, None)
    for each in vehicle.links.values():
        if name.startswith(streams.prefix(vehicle, each)):
            streams.follow_parameters(vehicle, each)
        _send_value(vehicle, each, parameter, NO_INDEX)


def _send_value(vehicle: CopterContext, link: Link, parameter: Parameter, index: int) -> None:
    link.send(
        dialect.MAVLink_param_value_message(
            parameter.name.encode(), parameter.wire_value, parameter.kind, len(vehicle.parameters), index
        )
    )


def _text_of(field: str | bytes) -> str:
    text = field.decode(errors="replace") if isinstance(field, bytes) else field
    return text.split("\0", 1)[0]
