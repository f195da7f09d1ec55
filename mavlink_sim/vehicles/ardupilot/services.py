"""Copter's handler of each received message."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from mavlink_sim.flight.precision_landing import LandingTarget
from mavlink_sim.px4.parameters import Parameter
from mavlink_sim.services import manual_control_service, microservices
from mavlink_sim.services.parameter_protocol import text_of
from mavlink_sim.vehicles.ardupilot import commands, landing, streams
from mavlink_sim.vehicles.ardupilot.context import CopterContext
from mavlink_sim.vehicles.ardupilot.targets import global_target, local_target
from mavlink_sim.wire.announcements import INFO
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
    parameter = parameters.at(index) if index >= 0 else parameters.get(text_of(message.param_id))
    if parameter is not None:
        vehicle.after(0.0, partial(_send_value, vehicle, link, parameter, index if index >= 0 else NO_INDEX))


def set_parameter(vehicle: CopterContext, link: Link, message: Any) -> None:
    """PARAM_SET: truncate and clamp the value to its type, then send it on every link."""
    name = text_of(message.param_id)
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


MISSION_UNSUPPORTED = 3  # MAV_MISSION_UNSUPPORTED


def _heartbeat(vehicle: CopterContext, link: Link, message: Any) -> None:
    if message.get_srcSystem() == int(vehicle.parameters.number("SYSID_MYGCS")):
        vehicle.copter.watch.ground_station_seen_s = vehicle.now_s


def _local_target(vehicle: CopterContext, link: Link, message: Any) -> None:
    """Outside GUIDED it is silently ignored."""
    guided = vehicle.copter.guided
    if guided is not None:
        frame = vehicle.estimate
        guided.fly(local_target(message, frame.position, frame.yaw_rad))


def _global_target(vehicle: CopterContext, link: Link, message: Any) -> None:
    guided = vehicle.copter.guided
    if guided is not None:
        guided.fly(global_target(message, vehicle.local_frame, vehicle.copter.home.position))


def _landing_target(vehicle: CopterContext, link: Link, message: Any) -> None:
    """LANDING_TARGET: used if precision landing is enabled with type 1 (MAVLink)."""
    value = vehicle.parameters.number
    if not value("PLND_ENABLED") or value("PLND_TYPE") != landing.COMPANION_TYPE:
        return
    frame = vehicle.estimate
    height = -vehicle.airframe.position[2]
    try:
        point = landing.target_position(message, frame.position, frame.quaternion, height)
    except landing.UnsupportedTargetError as error:
        vehicle.send_text_once(INFO, str(error))
        return
    if point is not None:
        vehicle.copter.navigator.target = LandingTarget(point, vehicle.now_s)


def _no_mission(vehicle: CopterContext, link: Link, message: Any) -> None:
    """Missions are not simulated: the list is empty, an upload is refused."""
    sender = (message.get_srcSystem(), message.get_srcComponent())
    kind = int(getattr(message, "mission_type", 0))
    if message.get_type() == "MISSION_REQUEST_LIST":
        link.send(dialect.MAVLink_mission_count_message(*sender, 0, kind))
    else:
        link.send(dialect.MAVLink_mission_ack_message(*sender, MISSION_UNSUPPORTED, kind))


def _setup_signing(vehicle: CopterContext, link: Link, message: Any) -> None:
    """SETUP_SIGNING: a disarmed ArduPilot accepts the key from any link, for all of its links."""
    if vehicle.copter.armed:
        vehicle.send_text(3, "ERROR: Won't setup signing when armed")
        return
    for each in vehicle.links.values():
        each.signing.set_up(bytes(message.secret_key), int(message.initial_timestamp))


Handler = Callable[[CopterContext, Link, Any], None]

HANDLERS: dict[str, Handler] = {
    "HEARTBEAT": _heartbeat,
    "COMMAND_LONG": commands.handle,
    "COMMAND_INT": commands.handle,
    "SET_MODE": commands.set_mode,
    "SET_POSITION_TARGET_LOCAL_NED": _local_target,
    "SET_POSITION_TARGET_GLOBAL_INT": _global_target,
    "MANUAL_CONTROL": manual_control_service.manual_control,
    "RC_CHANNELS_OVERRIDE": manual_control_service.rc_channels_override,
    "TIMESYNC": microservices.HANDLERS["TIMESYNC"],
    "PING": microservices.HANDLERS["PING"],
    "REQUEST_DATA_STREAM": streams.request_data_stream,
    "PARAM_REQUEST_LIST": request_list,
    "PARAM_REQUEST_READ": request_read,
    "PARAM_SET": set_parameter,
    "SETUP_SIGNING": _setup_signing,
    "LANDING_TARGET": _landing_target,
    "MISSION_REQUEST_LIST": _no_mission,
    "MISSION_COUNT": _no_mission,
    "MISSION_CLEAR_ALL": _no_mission,
}
