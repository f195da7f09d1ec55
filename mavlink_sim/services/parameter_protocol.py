"""MAVLink's parameter protocol as in PX4: the hash first, the list in order, PARAM_ERROR for errors."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable
from functools import partial
from typing import Any

from mavlink_sim.px4.parameters import (
    HASH_CHECK,
    INT32,
    NO_INDEX,
    REAL32,
    UINT32,
    Parameter,
    Parameters,
    decode_wire_value,
)
from mavlink_sim.services.context import ServiceContext
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import dialect

logger = logging.getLogger(__name__)

FIRST_ANSWER_S = 0.01
LIST_RATE_HZ = 1000.0
SECOND_ECHO_S = 0.015
SENT_AT_START_S = 0.98
DOES_NOT_EXIST = 1  # MAV_PARAM_ERROR
READ_ONLY = 5
TYPE_UNSUPPORTED = 6
TYPE_MISMATCH = 7
FLIGHT_COUNTERS = ("LND_FLIGHT_T_HI", "LND_FLIGHT_T_LO", "COM_FLIGHT_UUID")
ACCEPTED = 0  # MAV_RESULT
TEMPORARILY_REJECTED = 1
UNSUPPORTED = 3


def request_list(vehicle: ServiceContext, link: Link, message: Any) -> None:
    """PARAM_REQUEST_LIST: the hash, then every parameter at about a thousand per second."""
    vehicle.after(FIRST_ANSWER_S, partial(_begin_list, vehicle, link))


def _begin_list(vehicle: ServiceContext, link: Link) -> None:
    if not link.parameters_left:  # a request during a list restarts it without the hash
        _send_hash(link, vehicle.parameters)
    link.parameters_left = deque(vehicle.parameters)
    link.parameter_credit = 0.0


def continue_list(link: Link, parameters: Parameters, dt_s: float) -> None:
    """Send the part of a running list that is due after another `dt_s`."""
    link.parameter_credit += LIST_RATE_HZ * dt_s
    while link.parameter_credit >= 1.0 and link.parameters_left:
        link.parameter_credit -= 1.0
        _send(link, parameters, parameters[link.parameters_left.popleft().name])


def request_read(vehicle: ServiceContext, link: Link, message: Any) -> None:
    """PARAM_REQUEST_READ, by index or (index -1) by name."""
    index = int(message.param_index)
    name = text_of(message.param_id)
    if index < 0 and name == HASH_CHECK:
        _send_hash(link, vehicle.parameters)
        return
    parameter = vehicle.parameters.at(index) if index >= 0 else vehicle.parameters.get(name)
    if parameter is None:
        _send_error(link, message, name, index, DOES_NOT_EXIST)
    else:
        _send(link, vehicle.parameters, parameter)


def set_parameter(vehicle: ServiceContext, link: Link, message: Any) -> None:
    """PARAM_SET: reply with the value; if it changed, send it again on every link 15 ms later."""
    name = text_of(message.param_id)
    if name == HASH_CHECK:
        link.parameters_left.clear()  # the client has a matching cache and needs no list
        _send_error(link, message, name, -1, READ_ONLY)
        return
    if name not in vehicle.parameters:
        _send_error(link, message, name, -1, DOES_NOT_EXIST)
        return
    parameter = vehicle.parameters[name]
    if message.param_type not in (INT32, REAL32):
        _send_error(link, message, name, -1, TYPE_UNSUPPORTED)
        return
    if parameter.kind != message.param_type:
        _send_error(link, message, name, -1, TYPE_MISMATCH)
        return
    before = parameter.value
    try:
        parameter = vehicle.parameters.set(name, decode_wire_value(parameter.kind, message.param_value))
    except ValueError as error:
        logger.info("PARAM_SET refused, the value is unchanged: %s", error)
    _send(link, vehicle.parameters, parameter)
    if parameter.value != before:
        vehicle.after(SECOND_ECHO_S, partial(broadcast, vehicle, [name]))


def broadcast(vehicle: ServiceContext, names: Iterable[str]) -> None:
    """Send PARAM_VALUE of changed parameters on every link, as PX4 does."""
    for name in names:
        for link in vehicle.links.values():
            _send(link, vehicle.parameters, vehicle.parameters[name])


def reset(vehicle: ServiceContext, action: float) -> int:
    """PREFLIGHT_STORAGE (245), its MAV_RESULT: 2 and 4 reset the parameters; 0, 1 and 3 have no effect.

    Only while disarmed. PX4 does not answer other actions; here they are refused.
    """
    if vehicle.autopilot.armed:
        return TEMPORARILY_REJECTED
    if action not in (0.0, 1.0, 2.0, 3.0, 4.0):
        return UNSUPPORTED
    if action >= 2.0 and action != 3.0:
        # the system id is set at every start, and is not stored
        keep = {"MAV_SYS_ID", *(FLIGHT_COUNTERS if action == 2.0 else ())}
        changed = vehicle.parameters.reset(keep)
        logger.info("%d parameters reset to their defaults", len(changed))
    return ACCEPTED


def _send(link: Link, parameters: Parameters, parameter: Parameter) -> None:
    link.send(
        dialect.MAVLink_param_value_message(
            parameter.name.encode(),
            parameter.wire_value,
            parameter.kind,
            len(parameters),
            parameters.index(parameter.name),
        )
    )


def _send_hash(link: Link, parameters: Parameters) -> None:
    link.send(
        dialect.MAVLink_param_value_message(
            HASH_CHECK.encode(), parameters.hash_wire_value(), UINT32, len(parameters), NO_INDEX
        )
    )


def _send_error(link: Link, message: Any, name: str, index: int, error: int) -> None:
    if not link.has_parameter_errors:
        return
    link.send(
        dialect.MAVLink_param_error_message(
            message.get_srcSystem(), message.get_srcComponent(), name.encode(), index, error
        )
    )


def text_of(field: str | bytes) -> str:
    """The text of a message's field, which ends at a zero."""
    text = field.decode(errors="replace") if isinstance(field, bytes) else field
    return text.split("\0", 1)[0]
