"""The handler of each received message (MAVLink's "microservices")."""

from __future__ import annotations

import logging
from functools import partial
from typing import Any

from mavlink_sim.autopilot.commander import ACCEPTED
from mavlink_sim.flight.setpoints import (
    SetpointRejectedError,
    flyable,
    global_trajectory_setpoint,
    trajectory_setpoint,
)
from mavlink_sim.services import (
    commands,
    event_protocol,
    file_transfer,
    gimbal_protocol,
    manual_control_service,
    mission_link,
    mission_transfer,
    parameter_protocol,
)
from mavlink_sim.services.context import Handler, ServiceContext
from mavlink_sim.wire.announcements import CRITICAL, Text
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import Command, command_of, dialect, is_misencoded

logger = logging.getLogger(__name__)

MAV_TYPE_GCS = 6
MAV_TYPE_ONBOARD_CONTROLLER = 18
# Commander processes commands from a queue, in order: 0-15 ms after their arrival were measured.
COMMANDER_DELAY_S = 0.004


def _heartbeat(vehicle: ServiceContext, link: Link, message: Any) -> None:
    if message.type == MAV_TYPE_GCS:
        link.ground_station_seen_s = vehicle.autopilot.supervision.ground_station_seen_s = vehicle.now_s
    elif message.type == MAV_TYPE_ONBOARD_CONTROLLER and message.get_srcSystem() == vehicle.system_id:
        vehicle.on_companion_heartbeat()


def _command(vehicle: ServiceContext, link: Link, message: Any) -> None:
    if is_misencoded(message):
        acknowledge(link, message, message.command, commands.DENIED)
        return
    command = command_of(message)
    if command.identifier in commands.ANSWERED_TWICE and vehicle.release.acknowledges_modes_twice:
        acknowledge(link, message, command.identifier, ACCEPTED)
    if command.identifier in commands.ANSWERED_BY_RECEIVER:
        _execute(vehicle, link, message, command)
    else:
        vehicle.after(COMMANDER_DELAY_S, partial(_execute, vehicle, link, message, command))


def _execute(vehicle: ServiceContext, link: Link, message: Any, command: Command) -> None:
    result = vehicle.faults.refuses(command.identifier, command.parameters)
    if result is None:
        result = commands.execute(vehicle, link, command)
    if result is not None:
        acknowledge(link, message, command.identifier, result)


def acknowledge(link: Link, message: Any, command: int, result: int) -> None:
    """Send COMMAND_ACK to the sender of a message."""
    link.send(
        dialect.MAVLink_command_ack_message(
            command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )
    )


def _set_mode(vehicle: ServiceContext, link: Link, message: Any) -> None:
    custom = int(message.custom_mode)
    values = (
        float(message.base_mode),
        float(custom >> 16 & 0xFF),
        float(custom >> 24 & 0xFF),
        0.0,
        0.0,
        0.0,
        0.0,
    )
    command = Command(commands.DO_SET_MODE, values, message.get_srcComponent())
    vehicle.after(COMMANDER_DELAY_S, partial(_execute, vehicle, link, message, command))


def _setpoint(vehicle: ServiceContext, link: Link, message: Any) -> None:
    try:
        frame = vehicle.estimate
        setpoint = trajectory_setpoint(message, frame.yaw_rad, frame.roll_rad, frame.pitch_rad)
    except SetpointRejectedError as error:
        vehicle.autopilot.texts.append(Text(CRITICAL, f"{error}\t"))
        return
    vehicle.autopilot.offboard_setpoint(flyable(setpoint))


def _global_setpoint(vehicle: ServiceContext, link: Link, message: Any) -> None:
    autopilot = vehicle.autopilot
    home_altitude = vehicle.home_altitude_m if autopilot.sensors_ready else None
    try:
        setpoint = global_trajectory_setpoint(message, vehicle.local_frame, home_altitude)
    except SetpointRejectedError as error:
        autopilot.texts.append(Text(CRITICAL, f"{error}\t"))
        return
    if setpoint is not None:
        autopilot.offboard_setpoint(flyable(setpoint))


def _timesync(vehicle: ServiceContext, link: Link, message: Any) -> None:
    if message.tc1 == 0:
        link.send(dialect.MAVLink_timesync_message(vehicle.clock_ns(), message.ts1))


def _vision_position(vehicle: ServiceContext, link: Link, message: Any) -> None:
    covariance = message.covariance
    variances = (covariance[0], covariance[6], covariance[11], covariance[20])
    position = (message.x, message.y, message.z)
    vehicle.vision.add(vehicle.boot_us / 1e6, position, message.yaw, variances, message.reset_counter)
    vehicle.autopilot.position_valid = vehicle.estimate.position_valid


def _setup_signing(vehicle: ServiceContext, link: Link, message: Any) -> None:
    """SETUP_SIGNING: PX4 takes a key on its USB port only and answers nothing; elsewhere it is ignored."""
    if not link.signing.is_usb:
        logger.warning("SETUP_SIGNING on link %s is ignored: only the USB link takes a key", link.name)
        return
    link.signing.set_up(bytes(message.secret_key), int(message.initial_timestamp))
    logger.info("link %s: signing key %s", link.name, "set" if link.signing.has_key else "removed")


def _ping(vehicle: ServiceContext, link: Link, message: Any) -> None:
    if message.target_system == 0 and message.target_component == 0:  # else it is a reply
        link.send(
            dialect.MAVLink_ping_message(
                message.time_usec, message.seq, message.get_srcSystem(), message.get_srcComponent()
            )
        )


HANDLERS: dict[str, Handler] = {
    "HEARTBEAT": _heartbeat,
    "COMMAND_LONG": _command,
    "COMMAND_INT": _command,
    "SET_MODE": _set_mode,
    "SET_POSITION_TARGET_LOCAL_NED": _setpoint,
    "SET_POSITION_TARGET_GLOBAL_INT": _global_setpoint,
    "MANUAL_CONTROL": manual_control_service.manual_control,
    "RC_CHANNELS_OVERRIDE": manual_control_service.rc_channels_override,
    "GIMBAL_MANAGER_SET_ATTITUDE": gimbal_protocol.set_attitude,
    "GIMBAL_MANAGER_SET_PITCHYAW": gimbal_protocol.set_pitchyaw,
    "GIMBAL_MANAGER_SET_MANUAL_CONTROL": gimbal_protocol.set_manual_control,
    "TIMESYNC": _timesync,
    "PING": _ping,
    "PARAM_REQUEST_LIST": parameter_protocol.request_list,
    "PARAM_REQUEST_READ": parameter_protocol.request_read,
    "PARAM_SET": parameter_protocol.set_parameter,
    "FILE_TRANSFER_PROTOCOL": file_transfer.handle,
    "SETUP_SIGNING": _setup_signing,
    "UNKNOWN_412": event_protocol.request,
    **dict.fromkeys(mission_transfer.MESSAGES, mission_transfer.handle),
    "LANDING_TARGET": mission_link.landing_target,
    "OBSTACLE_DISTANCE": mission_link.obstacle_distance,
    "VISION_POSITION_ESTIMATE": _vision_position,
}
