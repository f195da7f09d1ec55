"""COMMAND_LONG and COMMAND_INT: the supported commands, and PX4's MAV_RESULT of each."""

from __future__ import annotations

import math
from collections.abc import Callable

from mavlink_sim.autopilot.commander import ACCEPTED, TEMPORARILY_REJECTED
from mavlink_sim.flight.orbit import OrbitRequest
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.modes import CUSTOM_MODE_ENABLED, Mode, mode_of
from mavlink_sim.services import gimbal_protocol, parameter_protocol
from mavlink_sim.services.context import ServiceContext
from mavlink_sim.services.system_streams import available_modes
from mavlink_sim.services.telemetry import MESSAGE_IDS
from mavlink_sim.wire.announcements import CRITICAL, Text
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import Command, dialect, protocol_version

DENIED = 2  # MAV_RESULT
UNSUPPORTED = 3
FAILED = 4

FORCE_DISARM = 21196
SPEED_TYPE_GROUNDSPEED = 1
MAX_ALTITUDE_M = 100_000.0
MAX_INTERVAL_US = 2**31 - 1  # MESSAGE_INTERVAL carries an int32
GROUND_STATION_COMPONENT = 190  # MAV_COMP_ID_MISSIONPLANNER

NAV_RETURN_TO_LAUNCH = 20
NAV_LAND = 21
NAV_TAKEOFF = 22
DO_ORBIT = 34
DO_SET_MODE = 176
DO_CHANGE_SPEED = 178
DO_CHANGE_ALTITUDE = 186
DO_REPOSITION = 192
PREFLIGHT_STORAGE = 245
ARM_DISARM = 400
GET_MESSAGE_INTERVAL = 510
SET_MESSAGE_INTERVAL = 511
REQUEST_MESSAGE = 512
GET_HOME_POSITION = 410
MESSAGE_INTERVAL = 244  # a message that REQUEST_MESSAGE requests with another's number
AVAILABLE_MODES = 435  # the same with the index of a mode, 0 for all
# ACTUATOR_OUTPUT_FUNCTION: motors 1-12, servos 1-8, and from 1000 on PX4's own numbers
_TESTED_FUNCTIONS = (range(1, 13), range(33, 41), range(1000, 2**31))


def execute(vehicle: ServiceContext, link: Link, command: Command) -> int | None:
    """Execute a command. Returns its MAV_RESULT, None where PX4 sends no answer."""
    if command.identifier == 0:
        return None
    handler = _HANDLERS.get(command.identifier)
    if command.identifier not in ANSWERED_BY_RECEIVER:
        vehicle.autopilot.commands_handled += 1
    return UNSUPPORTED if handler is None else handler(vehicle, link, command)


def _arm(vehicle: ServiceContext, link: Link, command: Command) -> int | None:
    wanted, force = command.parameters[:2]
    action = _nearest(wanted) & 0xFF  # PX4 keeps it in a byte
    if action == 1:
        return vehicle.autopilot.arm()
    if action == 0:
        return vehicle.autopilot.disarm(force=_nearest(force) == FORCE_DISARM)
    vehicle.autopilot.texts.append(Text(CRITICAL, f"Unsupported ARM_DISARM param: {wanted:.3f}\t"))
    return None  # PX4 sends the text and no answer


def _do_set_mode(vehicle: ServiceContext, link: Link, command: Command) -> int:
    autopilot = vehicle.autopilot
    base, main, sub = command.parameters[:3]
    if not all(map(math.isfinite, (base, main, sub))) or not int(base) & CUSTOM_MODE_ENABLED:
        return TEMPORARILY_REJECTED
    mode = mode_of(int(main), int(sub))
    if mode is None:
        autopilot.texts.append(Text(CRITICAL, "Unsupported main mode\t"))
        return TEMPORARILY_REJECTED
    if mode is Mode.LAND:
        return autopilot.force_mode(mode)
    return autopilot.set_mode(mode, report=command.source_component == GROUND_STATION_COMPONENT)


def _takeoff(vehicle: ServiceContext, link: Link, command: Command) -> int:
    altitude = command.parameters[6]
    if not math.isfinite(altitude):
        return vehicle.autopilot.takeoff(None)
    altitude = min(max(altitude, -MAX_ALTITUDE_M), MAX_ALTITUDE_M)
    home_altitude = vehicle.local_frame.geographic(vehicle.autopilot.home.position)[2]
    return vehicle.autopilot.takeoff(altitude - home_altitude)


def _reposition(vehicle: ServiceContext, link: Link, command: Command) -> int:
    speed, flags, _, yaw = command.parameters[:4]
    goal = _point_of(vehicle, *command.parameters[4:7])
    # MAV_DO_REPOSITION_FLAGS_CHANGE_MODE, and no other: the commander refuses the rest. The navigator of PX4
    # ignores the flags, so a vehicle that holds flies there whatever the answer is.
    if math.isfinite(flags) and int(flags) == 1:
        return vehicle.autopilot.reposition(goal, yaw, speed)
    vehicle.autopilot.move_hold_to(goal, yaw, speed)
    return UNSUPPORTED


def _change_altitude(vehicle: ServiceContext, link: Link, command: Command) -> int:
    altitude = command.parameters[0]  # AMSL; PX4 ignores the frame here too
    return vehicle.autopilot.reposition(_point_of(vehicle, math.nan, math.nan, altitude), math.nan)


def _change_speed(vehicle: ServiceContext, link: Link, command: Command) -> int:
    kind, speed = command.parameters[:2]
    vehicle.autopilot.change_speed(speed, at_once=_identifier(kind) == SPEED_TYPE_GROUNDSPEED)
    return ACCEPTED


def _orbit(vehicle: ServiceContext, link: Link, command: Command) -> int:
    radius, speed, yaw_behaviour = command.parameters[:3]
    centre = _point_of(vehicle, *command.parameters[4:7])
    return vehicle.autopilot.orbit(OrbitRequest(radius, speed, yaw_behaviour, centre))


def _point_of(
    vehicle: ServiceContext, latitude_deg: float, longitude_deg: float, altitude_m: float
) -> Vector:
    """Local NED, NaN for non-finite values. Positions out of range, which PX4 accepts, are clamped."""
    return vehicle.local_frame.local(
        _within(latitude_deg, 90.0), _within(longitude_deg, 180.0), _within(altitude_m, MAX_ALTITUDE_M)
    )


def _within(value: float, limit: float) -> float:
    return min(max(value, -limit), limit) if math.isfinite(value) else math.nan


def _accept(vehicle: ServiceContext, link: Link, command: Command) -> int:
    return ACCEPTED


def _run_prearm_checks(vehicle: ServiceContext, link: Link, command: Command) -> int:
    if not vehicle.autopilot.armed:
        vehicle.autopilot.report_checks()
    return ACCEPTED


def _mission_start(vehicle: ServiceContext, link: Link, command: Command) -> int:
    """Mode MISSION and arming. Parameter 1: the item to begin with, -1 for the current one."""
    autopilot, first = vehicle.autopilot, command.parameters[0]
    mission = autopilot.navigator.mission
    if not mission.valid:
        autopilot.texts.append(Text(CRITICAL, "Mission start denied! No valid mission\t"))
        return DENIED
    if not (math.isfinite(first) and -1.0 <= first < len(mission.items)):
        return DENIED
    if first >= 0.0:
        autopilot.navigator.set_current(int(first))
    if autopilot.set_mode(Mode.MISSION) == ACCEPTED and autopilot.arm() == ACCEPTED:
        return ACCEPTED
    autopilot.report_unavailable(Mode.MISSION)
    return TEMPORARILY_REJECTED


def _set_home(vehicle: ServiceContext, link: Link, command: Command) -> int:
    autopilot, estimate = vehicle.autopilot, vehicle.estimate
    use_current, *attitude_deg = command.parameters[:4]
    point = command.parameters[4:7]
    if not vehicle.parameters.number("COM_HOME_EN"):
        return DENIED
    if not use_current > 0.5 and not all(map(math.isfinite, point)):
        return DENIED
    if not autopilot.sensors_ready:  # no origin yet; with one, a lost position is no reason to refuse
        return TEMPORARILY_REJECTED
    if use_current > 0.5:
        autopilot.home.is_here(estimate)
    else:
        roll, pitch, yaw = (math.radians(angle) if math.isfinite(angle) else None for angle in attitude_deg)
        attitude_rad = (roll or 0.0, pitch or 0.0, math.nan if yaw is None else yaw)
        autopilot.home.is_at(_point_of(vehicle, *point), attitude_rad)
    return ACCEPTED


def _flight_termination(vehicle: ServiceContext, link: Link, command: Command) -> int:
    # CBRK_FLIGHTTERM is engaged on this vehicle: a termination is accepted and has no effect
    return ACCEPTED if command.parameters[0] > 0.5 else DENIED


def _request_message(vehicle: ServiceContext, link: Link, command: Command) -> int:
    if _identifier(command.parameters[0]) == MESSAGE_INTERVAL:
        return _send_interval(vehicle, link, command.parameters[1])
    if _identifier(command.parameters[0]) == AVAILABLE_MODES:
        modes = available_modes(_identifier(command.parameters[1]))
        for message in modes:
            link.send(message)
        return ACCEPTED if modes else DENIED
    name = MESSAGE_IDS.get(_identifier(command.parameters[0]))
    if name is None or not vehicle.send_built(link, name):
        return DENIED
    return ACCEPTED


def _actuator_test(vehicle: ServiceContext, link: Link, command: Command) -> int | None:
    """No actuator moves. An unknown function is not answered, as in PX4."""
    if vehicle.autopilot.armed or vehicle.parameters.number("COM_MOT_TEST_EN") != 1:
        return DENIED
    function = _identifier(command.parameters[4])
    return ACCEPTED if any(function in known for known in _TESTED_FUNCTIONS) else None


def _calibrate(vehicle: ServiceContext, link: Link, command: Command) -> int:
    """All zero ends a calibration; there is none here."""
    if vehicle.autopilot.armed:
        return TEMPORARILY_REJECTED
    return UNSUPPORTED if any(command.parameters) else ACCEPTED


def _silence(vehicle: ServiceContext, link: Link, command: Command) -> None:
    """For a module of PX4 that is not simulated: no answer."""


def _request_capabilities(vehicle: ServiceContext, link: Link, command: Command) -> int:
    if command.parameters[0] != 1.0:
        return DENIED
    vehicle.send_built(link, "AUTOPILOT_VERSION")
    return ACCEPTED


def _request_protocol_version(vehicle: ServiceContext, link: Link, command: Command) -> int:
    link.send(protocol_version())
    return ACCEPTED


def _set_message_interval(vehicle: ServiceContext, link: Link, command: Command) -> int:
    name = MESSAGE_IDS.get(_identifier(command.parameters[0]))
    interval = command.parameters[1]
    if name is None or name == "HEARTBEAT" or name not in link.streams or not math.isfinite(interval):
        return FAILED
    if name == "CURRENT_MODE":
        link.status_is_due = False
    link.streams.set_interval(name, min(round(interval), MAX_INTERVAL_US), vehicle.boot_us)
    return ACCEPTED


def _send_interval(vehicle: ServiceContext, link: Link, message_id: float) -> int:
    identifier = _identifier(message_id)
    name = MESSAGE_IDS.get(identifier)
    interval = -1 if name is None else link.streams.interval_us(name)  # -1: no such stream, or off
    link.send(dialect.MAVLink_message_interval_message(identifier & 0xFFFF, interval))
    return ACCEPTED


def _identifier(value: float) -> int:
    return round(value) if math.isfinite(value) else -1


def _nearest(value: float) -> int:
    """C's lroundf: a half away from zero; 0 for a non-finite value."""
    return math.floor(abs(value) + 0.5) * (1 if value > 0.0 else -1) if math.isfinite(value) else 0


_HANDLERS: dict[int, Callable[[ServiceContext, Link, Command], int | None]] = {
    NAV_RETURN_TO_LAUNCH: lambda vehicle, link, command: vehicle.autopilot.return_home(),
    NAV_LAND: lambda vehicle, link, command: vehicle.autopilot.land(),
    NAV_TAKEOFF: _takeoff,
    DO_ORBIT: _orbit,
    DO_SET_MODE: _do_set_mode,
    DO_CHANGE_SPEED: _change_speed,
    179: _set_home,  # DO_SET_HOME
    185: _flight_termination,  # DO_FLIGHTTERMINATION
    DO_CHANGE_ALTITUDE: _change_altitude,
    187: _accept,  # DO_SET_ACTUATOR
    DO_REPOSITION: _reposition,
    gimbal_protocol.DO_SET_ROI_LOCATION: gimbal_protocol.set_roi_location,
    gimbal_protocol.DO_SET_ROI_NONE: gimbal_protocol.set_roi_none,
    gimbal_protocol.DO_SET_ROI: gimbal_protocol.set_roi,
    205: _silence,  # DO_MOUNT_CONTROL
    241: _calibrate,  # PREFLIGHT_CALIBRATION
    PREFLIGHT_STORAGE: lambda vehicle, link, command: parameter_protocol.reset(
        vehicle, command.parameters[0]
    ),
    # PREFLIGHT_REBOOT_SHUTDOWN
    246: lambda vehicle, link, command: UNSUPPORTED if any(command.parameters) else ACCEPTED,
    300: _mission_start,
    310: _actuator_test,  # ACTUATOR_TEST
    ARM_DISARM: _arm,
    401: _run_prearm_checks,
    GET_HOME_POSITION: lambda vehicle, link, command: (
        ACCEPTED if vehicle.send_built(link, "HOME_POSITION") else DENIED
    ),
    GET_MESSAGE_INTERVAL: lambda vehicle, link, command: _send_interval(vehicle, link, command.parameters[0]),
    SET_MESSAGE_INTERVAL: _set_message_interval,
    REQUEST_MESSAGE: _request_message,
    519: _request_protocol_version,  # REQUEST_PROTOCOL_VERSION
    520: _request_capabilities,  # REQUEST_AUTOPILOT_CAPABILITIES
    531: _silence,  # SET_CAMERA_ZOOM
    2510: _silence,  # LOGGING_START
    gimbal_protocol.PITCHYAW: gimbal_protocol.pitchyaw,
    gimbal_protocol.CONFIGURE: gimbal_protocol.configure,
}

# PX4's MAVLink receiver accepts these at once, before Commander's own answer (since v1.16).
ANSWERED_TWICE = frozenset({DO_SET_MODE})
# These do not pass Commander's queue.
ANSWERED_BY_RECEIVER = frozenset(
    {GET_HOME_POSITION, GET_MESSAGE_INTERVAL, SET_MESSAGE_INTERVAL, REQUEST_MESSAGE, 519, 520}
)
