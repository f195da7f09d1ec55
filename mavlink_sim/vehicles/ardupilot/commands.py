"""COMMAND_LONG and COMMAND_INT as Copter answers them: one COMMAND_ACK each, the real result.

Heights of NAV_TAKEOFF are above home (PX4's are above the sea). A refused mode or arming is FAILED.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from mavlink_sim.autopilot.commander import ACCEPTED, TEMPORARILY_REJECTED
from mavlink_sim.flight.setpoints import GLOBAL_RELATIVE_ALT_INT, GLOBAL_TERRAIN_ALT_INT
from mavlink_sim.physics.geography import HOME_ALTITUDE_M
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.modes import CUSTOM_MODE_ENABLED
from mavlink_sim.services.commands import (
    ARM_DISARM,
    DENIED,
    DO_CHANGE_SPEED,
    DO_REPOSITION,
    DO_SET_MODE,
    FORCE_DISARM,
    GET_HOME_POSITION,
    GET_MESSAGE_INTERVAL,
    NAV_LAND,
    NAV_RETURN_TO_LAUNCH,
    NAV_TAKEOFF,
    REQUEST_MESSAGE,
    SET_MESSAGE_INTERVAL,
    UNSUPPORTED,
)
from mavlink_sim.services.microservices import acknowledge
from mavlink_sim.vehicles.ardupilot import streams
from mavlink_sim.vehicles.ardupilot.autopilot import FAILED
from mavlink_sim.vehicles.ardupilot.context import CopterContext
from mavlink_sim.vehicles.ardupilot.modes import CopterMode, mode_of
from mavlink_sim.vehicles.ardupilot.targets import GLOBAL_RELATIVE_ALT, GLOBAL_TERRAIN_ALT, GuidedTarget
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import Command, command_of, dialect

FORCE_ARM = 2989.0
NAV_LOITER_UNLIM = 17
CONDITION_YAW = 115
DO_SET_HOME = 179
DO_PAUSE_CONTINUE = 193
CHANGE_MODE = 1  # MAV_DO_REPOSITION_FLAGS_CHANGE_MODE
CLIMB_SPEED, DESCENT_SPEED = 2, 3  # SPEED_TYPE; airspeed and ground speed are one here
ANSWER_DELAY_S = 0.004
_ABOVE_HOME = (GLOBAL_RELATIVE_ALT, GLOBAL_RELATIVE_ALT_INT, GLOBAL_TERRAIN_ALT, GLOBAL_TERRAIN_ALT_INT)


def handle(vehicle: CopterContext, link: Link, message: Any) -> None:
    """COMMAND_LONG or COMMAND_INT: executed shortly after, then acknowledged to the sender."""
    command = command_of(message)
    frame = int(getattr(message, "frame", GLOBAL_RELATIVE_ALT))
    vehicle.after(ANSWER_DELAY_S, partial(_answer, vehicle, link, message, command, frame))


def _answer(vehicle: CopterContext, link: Link, message: Any, command: Command, frame: int) -> None:
    result = vehicle.faults.refuses(command.identifier, command.parameters)
    if result is None:
        handler = _HANDLERS.get(command.identifier)
        result = UNSUPPORTED if handler is None else handler(vehicle, link, command, frame)
    acknowledge(link, message, command.identifier, result)


def set_mode(vehicle: CopterContext, link: Link, message: Any) -> None:
    """SET_MODE (11): its acknowledgement names the message's number, not DO_SET_MODE's."""
    result = _mode_result(vehicle, float(message.base_mode), float(message.custom_mode))
    acknowledge(link, message, 11, result)


def _mode_result(vehicle: CopterContext, base: float, custom: float) -> int:
    if not (math.isfinite(base) and math.isfinite(custom)) or not int(base) & CUSTOM_MODE_ENABLED:
        return DENIED
    mode = mode_of(int(custom))
    if mode is None:
        vehicle.send_text(4, f"No such mode {int(custom)}")
        return FAILED
    return vehicle.copter.request_mode(mode)


def _do_set_mode(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    return _mode_result(vehicle, *command.parameters[:2])


def _arm(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    arm, magic = command.parameters[:2]
    if arm == 1.0:
        if magic == FORCE_ARM and not vehicle.copter.armed:
            vehicle.copter.force_arm()
            return ACCEPTED
        return vehicle.copter.arm()
    if arm == 0.0:
        return vehicle.copter.disarm(force=magic == FORCE_DISARM)
    return UNSUPPORTED


def _takeoff(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    if frame not in (GLOBAL_RELATIVE_ALT, GLOBAL_RELATIVE_ALT_INT):
        return DENIED
    height = command.parameters[6]
    return vehicle.copter.user_takeoff(height) if math.isfinite(height) else FAILED


def _to_mode(mode: CopterMode) -> Handler:
    return lambda vehicle, link, command, frame: vehicle.copter.request_mode(mode)


def _condition_yaw(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    angle, rate, direction, relative = command.parameters[:4]
    if not 0.0 <= angle <= 360.0 or relative not in (0.0, 1.0):
        return FAILED
    guided = vehicle.copter.guided
    if guided is not None:
        yaw = math.radians(angle)
        if relative:
            yaw = guided.heading.yaw_rad + (-yaw if direction < 0.0 else yaw)
        slew = math.radians(rate) if rate > 0.0 else math.nan
        guided.heading.take(math.remainder(yaw, math.tau), math.nan, slew)
    return ACCEPTED


def _change_speed(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    """For GUIDED, RTL and LAND until they end; vertical speeds set the parameters of the control loops."""
    kind, speed = command.parameters[:2]
    if not 0.0 < speed < math.inf or kind not in (0.0, 1.0, 2.0, 3.0):
        return DENIED
    task = vehicle.copter.task
    if vehicle.copter.guided is None and vehicle.copter.mode is not CopterMode.RTL:
        return FAILED
    if kind == CLIMB_SPEED:
        vehicle.parameters.set("MPC_Z_V_AUTO_UP", speed)
    elif kind == DESCENT_SPEED:
        vehicle.parameters.set("MPC_Z_V_AUTO_DN", speed)
    elif task is not None:
        task.cruise_at(speed)
    return ACCEPTED


def _reposition(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    """DO_REPOSITION, as COMMAND_INT or COMMAND_LONG; changes to GUIDED only if its flag says so."""
    copter = vehicle.copter
    flags = command.parameters[1]
    changes = math.isfinite(flags) and bool(int(flags) & CHANGE_MODE)
    if copter.guided is None and not changes:
        return DENIED
    point = _point_of(vehicle, command, frame)
    if point is None:
        return DENIED
    if copter.guided is None and copter.request_mode(CopterMode.GUIDED) != ACCEPTED:
        return FAILED
    if copter.guided is not None:
        copter.guided.fly(GuidedTarget(position=point))
    return ACCEPTED


def _pause_or_continue(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    """DO_PAUSE_CONTINUE, in GUIDED alone here."""
    guided, choice = vehicle.copter.guided, command.parameters[0]
    if choice not in (0.0, 1.0):
        return DENIED
    if guided is None:
        return FAILED
    guided.paused = choice == 0.0
    return ACCEPTED


def _point_of(vehicle: CopterContext, command: Command, frame: int) -> Vector | None:
    latitude, longitude, altitude = command.parameters[4:7]
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and math.isfinite(altitude)):
        return None
    if frame in _ABOVE_HOME:
        altitude += HOME_ALTITUDE_M - vehicle.copter.home.position[2]
    return vehicle.local_frame.local(latitude, longitude, altitude)


def _set_home(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    here = command.parameters[0] == 1.0
    if here and not vehicle.copter.position_valid:
        return FAILED
    point = vehicle.copter.position if here else _point_of(vehicle, command, frame)
    if point is None:
        return DENIED
    # ArduPilot locks home in both cases: arming elsewhere does not move it.
    vehicle.copter.home.is_at(point, (math.nan,) * 3)
    vehicle.send_home()
    return ACCEPTED


def _get_home(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    if not vehicle.copter.sensors_ready:
        return FAILED
    vehicle.send_soon(link, "HOME_POSITION")
    return ACCEPTED


def _request_message(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    """Request a message: it follows the acknowledgement."""
    name = vehicle.message_named(command.parameters[0])
    if name is None:
        return FAILED
    vehicle.send_soon(link, name)
    return ACCEPTED


def _request_capabilities(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    if command.parameters[0] != 1.0:
        return DENIED
    vehicle.send_soon(link, "AUTOPILOT_VERSION")
    return ACCEPTED


def _set_message_interval(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    name = vehicle.message_named(command.parameters[0])
    if name is None or name not in link.streams or not math.isfinite(command.parameters[1]):
        return FAILED
    streams.set_interval(vehicle, link, name, command.parameters[1])
    return ACCEPTED


def _get_message_interval(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    name = vehicle.message_named(command.parameters[0])
    if name is None:
        return FAILED
    identifier = int(command.parameters[0]) & 0xFFFF
    link.send(dialect.MAVLink_message_interval_message(identifier, link.streams.interval_us(name)))
    return ACCEPTED


def _flight_termination(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    if not command.parameters[0] > 0.5:
        return FAILED
    return vehicle.copter.disarm(force=True)


def _run_prearm_checks(vehicle: CopterContext, link: Link, command: Command, frame: int) -> int:
    if vehicle.copter.armed:
        return TEMPORARILY_REJECTED
    vehicle.copter.send_prearm()
    return ACCEPTED


Handler = Callable[[CopterContext, Link, Command, int], int]

_HANDLERS: dict[int, Handler] = {
    NAV_LOITER_UNLIM: _to_mode(CopterMode.LOITER),
    NAV_RETURN_TO_LAUNCH: _to_mode(CopterMode.RTL),
    NAV_LAND: _to_mode(CopterMode.LAND),
    NAV_TAKEOFF: _takeoff,
    CONDITION_YAW: _condition_yaw,
    DO_SET_MODE: _do_set_mode,
    DO_CHANGE_SPEED: _change_speed,
    DO_SET_HOME: _set_home,
    185: _flight_termination,
    DO_REPOSITION: _reposition,
    DO_PAUSE_CONTINUE: _pause_or_continue,
    ARM_DISARM: _arm,
    401: _run_prearm_checks,
    GET_HOME_POSITION: _get_home,
    GET_MESSAGE_INTERVAL: _get_message_interval,
    SET_MESSAGE_INTERVAL: _set_message_interval,
    REQUEST_MESSAGE: _request_message,
    520: _request_capabilities,
}
