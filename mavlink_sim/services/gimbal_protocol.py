"""MAVLink's gimbal protocol version 2: the manager in the autopilot, and the device it answers for.

As with the gimbal of PX4's Gazebo simulation, the device is implemented by the autopilot's own component, so
its number is 1 and its messages come from there. One component has primary control
(DO_GIMBAL_MANAGER_CONFIGURE); others are denied. PX4 has no secondary control.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

from mavlink_sim.autopilot.commander import Autopilot
from mavlink_sim.flight.position_control import NAN
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.fallible_estimate import FallibleEstimate
from mavlink_sim.physics.geography import LocalFrame
from mavlink_sim.physics.gimbal import Aim, Gimbal, Target
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.wire.announcements import GimbalCommand
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import Command, dialect
from vision.attitude import euler_from_quaternion

ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3  # MAV_RESULT
DEVICE = 1  # gimbal_device_id: implemented by the autopilot's component
DO_SET_ROI_LOCATION, DO_SET_ROI_NONE, DO_SET_ROI = 195, 197, 201
PITCHYAW, CONFIGURE = 1000, 1001
ROI_NONE, ROI_LOCATION = 0, 3  # MAV_ROI

# GIMBAL_MANAGER_FLAGS and GIMBAL_DEVICE_FLAGS
NEUTRAL, ROLL_LOCK, PITCH_LOCK, YAW_LOCK = 2, 4, 8, 16
RETRACT = 1
YAW_IN_EARTH_FRAME = 64
# GIMBAL_DEVICE_CAP_FLAGS: neutral, pitch axis, follow and lock, yaw axis, follow and lock, yaw against north
DEVICE_CAPABILITIES = 2 | 32 | 64 | 128 | 256 | 512 | 1024 | 4096
INFINITE_YAW = 2048
POINTS_AT_GLOBAL_LOCATION = 131072  # GIMBAL_MANAGER_CAP_FLAGS
UNCHANGED, ITSELF, RELEASED = -1, -2, -3  # of DO_GIMBAL_MANAGER_CONFIGURE


class GimbalContext(Protocol):
    """What the gimbal protocol uses of a vehicle.

    Attributes:
        gimbal_manager: None without a gimbal. airframe: the motion (truth). estimate: the vehicle's estimate.
    """

    system_id: int
    parameters: Parameters
    autopilot: Autopilot
    airframe: Multirotor
    estimate: FallibleEstimate
    local_frame: LocalFrame
    gimbal_manager: GimbalManager | None

    @property
    def boot_ms(self) -> int: ...

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """The true `ned_from_body`, (w, x, y, z)."""


class GimbalManager:
    """The gimbal, the component in control, and its target.

    Attributes:
        gimbal: the device.
        primary: (system, component) in control; (0, 0) for none.
        flags: GIMBAL_MANAGER_FLAGS of the newest aim.
    """

    def __init__(self, vehicle: GimbalContext) -> None:
        self._vehicle = vehicle
        self.gimbal = Gimbal(vehicle.parameters)
        self.primary = (0, 0)
        self.flags = NEUTRAL

    def step(self, dt_s: float) -> None:
        vehicle = self._vehicle
        self.gimbal.step(dt_s, vehicle.quaternion, vehicle.estimate.position, vehicle.autopilot.landed)

    def configure(self, system: float, component: float, source: tuple[int, int]) -> None:
        """DO_GIMBAL_MANAGER_CONFIGURE: set the component in primary control."""
        own = (self._vehicle.system_id, 1)
        wanted = (_whole(system), _whole(component))
        chosen = [
            _controller(value, now, itself, asks)
            for value, now, itself, asks in zip(wanted, self.primary, own, source, strict=True)
        ]
        self.primary = (chosen[0], chosen[1])

    def aim(self, flags: int, target: Target) -> None:
        """Apply GIMBAL_MANAGER_FLAGS and a target of the component in control."""
        self.flags = flags & (NEUTRAL | ROLL_LOCK | PITCH_LOCK | YAW_LOCK)
        if flags & RETRACT:
            return  # not supported by this gimbal, and ignored by PX4
        self.gimbal.point(Target() if flags & NEUTRAL else target)

    def look_at(self, location: tuple[float, float, float]) -> None:
        """Track a position, NED metres. Not restricted to the component in control, as in PX4."""
        self.flags = ROLL_LOCK | PITCH_LOCK | YAW_LOCK
        self.gimbal.point(Target(Aim.LOCATION, location=location))

    def look_ahead(self) -> None:
        self.flags = NEUTRAL
        self.gimbal.point(Target())

    def own_command(self, command: GimbalCommand) -> None:
        """Execute the autopilot's own command at a landing or return."""
        identifier, _, values = command
        source = (self._vehicle.system_id, 1)
        if identifier == CONFIGURE:
            self.configure(values[0], values[1], source)
        elif identifier == PITCHYAW and self.primary == source:
            self.aim(int(values[4]), _pitch_and_yaw(values, int(values[4])))


def _controller(value: int, now: int, itself: int, asks: int) -> int:
    if 0 <= value <= 255:
        return value
    if value == ITSELF:
        return itself
    return 0 if value == RELEASED and now == asks else now


def _whole(value: float) -> int:
    return round(value) if math.isfinite(value) else UNCHANGED


def _pitch_and_yaw(values: tuple[float, ...], flags: int) -> Target:
    """The target of DO_GIMBAL_MANAGER_PITCHYAW: angles and rates in degrees."""
    pitch, yaw, pitch_rate, yaw_rate = (
        math.radians(value) if math.isfinite(value) else NAN for value in values[:4]
    )
    return Target(
        Aim.ANGLES, pitch, yaw, pitch_rate, yaw_rate, bool(flags & PITCH_LOCK), bool(flags & YAW_LOCK)
    )


# ---- commands -------------------------------------------------------------------------------------------


def configure(vehicle: GimbalContext, link: Link, command: Command) -> int | None:
    """DO_GIMBAL_MANAGER_CONFIGURE. Without a gimbal there is no answer, as in PX4."""
    manager = vehicle.gimbal_manager
    if manager is None:
        return None
    source = (command.source_system, command.source_component)
    manager.configure(command.parameters[0], command.parameters[1], source)
    return ACCEPTED


def pitchyaw(vehicle: GimbalContext, link: Link, command: Command) -> int | None:
    """DO_GIMBAL_MANAGER_PITCHYAW: denied to all but the component in control."""
    manager = vehicle.gimbal_manager
    if manager is None:
        return None
    if (command.source_system, command.source_component) != manager.primary:
        return DENIED
    flags = max(_whole(command.parameters[4]), 0)
    manager.aim(flags, _pitch_and_yaw(command.parameters, flags))
    return ACCEPTED


def set_roi_location(vehicle: GimbalContext, link: Link, command: Command) -> int:
    """DO_SET_ROI_LOCATION: accepted with or without a gimbal; latitude, longitude, AMSL metres."""
    latitude, longitude, altitude = command.parameters[4:7]
    if not all(map(math.isfinite, (latitude, longitude, altitude))):
        return DENIED
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        return DENIED
    if vehicle.gimbal_manager is not None:
        vehicle.gimbal_manager.look_at(vehicle.local_frame.local(latitude, longitude, altitude))
    return ACCEPTED


def set_roi_none(vehicle: GimbalContext, link: Link, command: Command) -> int:
    """DO_SET_ROI_NONE: look ahead again."""
    if vehicle.gimbal_manager is not None:
        vehicle.gimbal_manager.look_ahead()
    return ACCEPTED


def set_roi(vehicle: GimbalContext, link: Link, command: Command) -> int:
    """DO_SET_ROI, the old form of both."""
    kind = _whole(command.parameters[0])
    if kind == ROI_LOCATION:
        return set_roi_location(vehicle, link, command)
    return set_roi_none(vehicle, link, command) if kind == ROI_NONE else UNSUPPORTED


# ---- messages -------------------------------------------------------------------------------------------


def _in_control(vehicle: GimbalContext, message: Any) -> GimbalManager | None:
    """The manager, if the sender may move this gimbal."""
    manager = vehicle.gimbal_manager
    if manager is None or message.gimbal_device_id not in (0, DEVICE):
        return None
    return manager if (message.get_srcSystem(), message.get_srcComponent()) == manager.primary else None


def set_attitude(vehicle: GimbalContext, link: Link, message: Any) -> None:
    """GIMBAL_MANAGER_SET_ATTITUDE (282): a quaternion, without its roll, and rates."""
    manager = _in_control(vehicle, message)
    if manager is None:
        return
    flags = int(message.flags)
    pitch = yaw = NAN
    if all(map(math.isfinite, message.q)) and any(message.q):
        _, pitch, yaw = euler_from_quaternion(tuple(message.q))
    _aim(manager, flags, pitch, yaw, message.angular_velocity_y, message.angular_velocity_z)


def set_pitchyaw(vehicle: GimbalContext, link: Link, message: Any) -> None:
    """GIMBAL_MANAGER_SET_PITCHYAW (287), radians. (PX4 itself supports only the command of that name.)"""
    manager = _in_control(vehicle, message)
    if manager is not None:
        _aim(manager, int(message.flags), message.pitch, message.yaw, message.pitch_rate, message.yaw_rate)


def set_manual_control(vehicle: GimbalContext, link: Link, message: Any) -> None:
    """GIMBAL_MANAGER_SET_MANUAL_CONTROL (288): rates are shares, -1..1, of MNT_RATE_PITCH and _YAW."""
    manager = _in_control(vehicle, message)
    if manager is None:
        return
    value = vehicle.parameters.number
    _aim(
        manager,
        int(message.flags),
        message.pitch,
        message.yaw,
        message.pitch_rate * math.radians(value("MNT_RATE_PITCH")),
        message.yaw_rate * math.radians(value("MNT_RATE_YAW")),
    )


def _aim(
    manager: GimbalManager, flags: int, pitch: float, yaw: float, pitch_rate: float, yaw_rate: float
) -> None:
    pitch, yaw, pitch_rate, yaw_rate = (
        value if math.isfinite(value) else NAN for value in (pitch, yaw, pitch_rate, yaw_rate)
    )
    locked = (bool(flags & PITCH_LOCK), bool(flags & YAW_LOCK))
    manager.aim(flags, Target(Aim.ANGLES, pitch, yaw, pitch_rate, yaw_rate, *locked))


# ---- telemetry ------------------------------------------------------------------------------------------


def manager_information(vehicle: GimbalContext) -> Any:
    """GIMBAL_MANAGER_INFORMATION; None without a gimbal."""
    manager = vehicle.gimbal_manager
    if manager is None:
        return None
    return dialect.MAVLink_gimbal_manager_information_message(
        vehicle.boot_ms,
        _capabilities(manager.gimbal) | POINTS_AT_GLOBAL_LOCATION,
        DEVICE,
        *_limits(manager.gimbal),
    )


def _capabilities(gimbal: Gimbal) -> int:
    return DEVICE_CAPABILITIES if math.isfinite(gimbal.furthest_rad) else DEVICE_CAPABILITIES | INFINITE_YAW


def _limits(gimbal: Gimbal) -> tuple[float, float, float, float, float, float]:
    """Lowest and highest roll, pitch and yaw; NaN where there is no limit."""
    furthest = gimbal.furthest_rad if math.isfinite(gimbal.furthest_rad) else NAN
    return (0.0, 0.0, gimbal.lowest_rad, gimbal.highest_rad, -furthest, furthest)


def manager_status(vehicle: GimbalContext) -> Any:
    """GIMBAL_MANAGER_STATUS; None without a gimbal."""
    manager = vehicle.gimbal_manager
    if manager is None:
        return None
    return dialect.MAVLink_gimbal_manager_status_message(
        vehicle.boot_ms, manager.flags, DEVICE, *manager.primary, 0, 0
    )


def device_information(vehicle: GimbalContext) -> Any:
    """GIMBAL_DEVICE_INFORMATION; None without a gimbal."""
    manager = vehicle.gimbal_manager
    if manager is None:
        return None
    return dialect.MAVLink_gimbal_device_information_message(
        vehicle.boot_ms,
        b"mavlink-companion",
        b"two-axis",
        b"",
        0x01000000,
        0x01000000,
        0,
        _capabilities(manager.gimbal),
        0,
        *_limits(manager.gimbal),
        DEVICE,
    )


def device_attitude_status(vehicle: GimbalContext) -> Any:
    """GIMBAL_DEVICE_ATTITUDE_STATUS: the attitude relative to north; None without a gimbal."""
    manager = vehicle.gimbal_manager
    if manager is None:
        return None
    gimbal = manager.gimbal
    return dialect.MAVLink_gimbal_device_attitude_status_message(
        0,
        0,
        vehicle.boot_ms,
        manager.flags | YAW_IN_EARTH_FRAME,
        list(gimbal.quaternion),
        *gimbal.angular_velocity(vehicle.airframe.rates),
        0,
        vehicle.airframe.yaw_rad,
        vehicle.airframe.rates[2],
        0,
    )


def mount_orientation(vehicle: GimbalContext) -> Any:
    """MOUNT_ORIENTATION, in degrees; None without a gimbal."""
    manager = vehicle.gimbal_manager
    if manager is None:
        return None
    roll, pitch, yaw = (math.degrees(angle) for angle in euler_from_quaternion(manager.gimbal.quaternion))
    return dialect.MAVLink_mount_orientation_message(
        vehicle.boot_ms, roll, pitch, math.degrees(manager.gimbal.pan_rad), yaw
    )
