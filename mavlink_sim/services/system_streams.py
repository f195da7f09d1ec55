"""Telemetry of the system: modes, health, battery, clocks, home, and the vehicle's identity."""

from __future__ import annotations

import math
from typing import Any

from mavlink_sim.px4.modes import LISTED_MODES, Mode
from mavlink_sim.services import manual_control_service
from mavlink_sim.services.context import ServiceContext
from mavlink_sim.wire.messages import current_event_sequence as event_sequence_message
from mavlink_sim.wire.messages import dialect, time_estimate_to_target
from vision.attitude import quaternion_from_euler

PREARM_CHECK = 0x10000000  # MAV_SYS_STATUS_PREARM_CHECK
# (present, enabled, health) of SYS_STATUS as recorded from a PX4, before and after its estimator started
SENSORS_STARTING = (0x402F, 0x1402F, 0x320883F)
SENSORS_READY = (0x402F, 0x1402F, 0x320C83F)

_U16_UNKNOWN = 65535
_NAN = math.nan


def heartbeat(vehicle: ServiceContext) -> Any:
    autopilot = vehicle.autopilot
    return dialect.MAVLink_heartbeat_message(
        2, 12, autopilot.base_mode, autopilot.mode.custom_mode, int(autopilot.system_status), 3
    )


def timesync(vehicle: ServiceContext) -> Any:
    return dialect.MAVLink_timesync_message(0, vehicle.clock_ns())


def extended_sys_state(vehicle: ServiceContext) -> Any:
    autopilot = vehicle.autopilot
    return dialect.MAVLink_extended_sys_state_message(autopilot.vtol_state, int(autopilot.landed_state))


def sys_status(vehicle: ServiceContext) -> Any:
    autopilot = vehicle.autopilot
    present, enabled, health = SENSORS_READY if autopilot.sensors_ready else SENSORS_STARTING
    if autopilot.can_arm:
        health |= PREARM_CHECK
    receiver = manual_control_service.receiver_bits(vehicle)
    battery = autopilot.supervision.battery
    return dialect.MAVLink_sys_status_message(
        present | receiver, enabled, health | receiver, 120, *battery.system_status, *([0] * 6), 0, 0, 1
    )


def estimator_status(vehicle: ServiceContext) -> Any:
    flags = 895 if vehicle.autopilot.sensors_ready else 164
    return dialect.MAVLink_estimator_status_message(
        vehicle.boot_us, flags, 0.05, 0.05, 0.002, 0.08, 0.001, _NAN, 0.28, 0.19
    )


def open_drone_id_system(vehicle: ServiceContext) -> Any:
    latitude, longitude, altitude = vehicle.local_frame.geographic(vehicle.autopilot.home.position)
    since_2019 = max(vehicle.utc_ns() // 10**9 - 1546300800, 0)  # the standard counts from 2019-01-01
    return dialect.MAVLink_open_drone_id_system_message(
        0,
        0,
        [0] * 20,
        0,
        0,
        round(latitude * 1e7),
        round(longitude * 1e7),
        1,
        0,
        -1000.0,
        -1000.0,
        0,
        0,
        altitude,
        since_2019 & 0xFFFFFFFF,
    )


def ping(vehicle: ServiceContext) -> Any:
    return dialect.MAVLink_ping_message(vehicle.boot_us, vehicle.next_ping(), 0, 0)


def system_time(vehicle: ServiceContext) -> Any:
    return dialect.MAVLink_system_time_message(vehicle.utc_ns() // 1000, vehicle.boot_ms)


def battery_status(vehicle: ServiceContext) -> Any:
    battery = vehicle.autopilot.supervision.battery
    if not battery.connected:
        return None
    return dialect.MAVLink_battery_status_message(
        0,
        1,
        1,
        32767,
        [round(battery.volts * 1000)] + [_U16_UNKNOWN] * 9,
        round(battery.current_a * 100),
        int(battery.discharged_mah),
        -1,
        round(battery.remaining * 100),
        battery.time_remaining_s,
        battery.charge_state,
    )


def current_mode(vehicle: ServiceContext) -> Any:
    autopilot = vehicle.autopilot
    if not vehicle.release.has_current_mode:
        return None
    return dialect.MAVLink_current_mode_message(
        autopilot.mode.standard_mode, autopilot.mode.custom_mode, autopilot.intended_mode.custom_mode
    )


def home_position(vehicle: ServiceContext) -> Any:
    if not vehicle.autopilot.sensors_ready:
        return None  # no home without a position
    home = vehicle.autopilot.home
    latitude, longitude, altitude = vehicle.local_frame.geographic(home.position)
    return dialect.MAVLink_home_position_message(
        round(latitude * 1e7),
        round(longitude * 1e7),
        round(altitude * 1000),
        *home.position,
        quaternion_from_euler(*home.attitude_rad),
        0.0,
        0.0,
        0.0,
        vehicle.boot_us,
    )


def flight_information(vehicle: ServiceContext) -> Any:
    """FLIGHT_INFORMATION; its times are since boot, as in PX4, and 0 if unset."""
    autopilot = vehicle.autopilot
    armed_s = vehicle.now_s - autopilot.ground.armed_for_s(vehicle.now_s) if autopilot.armed else 0.0
    return dialect.MAVLink_flight_information_message(
        vehicle.boot_ms,
        round(armed_s * 1e6),
        round((autopilot.ground.left_s or 0.0) * 1e6),
        int(vehicle.parameters.number("COM_FLIGHT_UUID")),
    )


def available_modes(index: int) -> list[Any]:
    """AVAILABLE_MODES of one mode by its index from 1, of all with index 0; empty for an unknown index."""
    chosen = (
        enumerate(LISTED_MODES, 1)
        if index == 0
        else [(index, mode) for mode in LISTED_MODES[index - 1 : index]]
    )
    return [
        dialect.MAVLink_available_modes_message(
            len(LISTED_MODES),
            number,
            mode.standard_mode,
            mode.custom_mode,
            0 if mode in (Mode.ALTCTL, Mode.POSCTL) else dialect.MAV_MODE_PROPERTY_ADVANCED,
            b"" if mode.standard_mode else mode.title.encode(),
        )
        for number, mode in chosen
    ]


def vibration(vehicle: ServiceContext) -> Any:
    return dialect.MAVLink_vibration_message(vehicle.boot_us, 0.0, 0.011, 0.11, 0, 0, 0)


def time_estimate(vehicle: ServiceContext) -> Any:
    if vehicle.autopilot.landed:
        return time_estimate_to_target(-1, -1)
    home = vehicle.autopilot.home.position
    position = vehicle.estimate.position
    away = math.hypot(position[0] - home[0], position[1] - home[1])
    positive = vehicle.parameters.positive
    seconds = away / positive("MPC_XY_CRUISE") + (home[2] - position[2]) / positive("MPC_LAND_SPEED")
    seconds *= vehicle.parameters.number("RTL_TIME_FACTOR")
    return time_estimate_to_target(round(min(max(seconds, 0.0), 86400.0)), -1)


def current_event_sequence(vehicle: ServiceContext) -> Any:
    return event_sequence_message(vehicle.events.sequence)


def gps_global_origin(vehicle: ServiceContext) -> Any:
    latitude, longitude, altitude = vehicle.local_frame.geographic((0.0, 0.0, 0.0))
    return dialect.MAVLink_gps_global_origin_message(
        round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1000), vehicle.boot_us
    )


def autopilot_version(vehicle: ServiceContext) -> Any:
    return dialect.MAVLink_autopilot_version_message(
        capabilities=59647,
        flight_sw_version=vehicle.release.software_version,
        middleware_sw_version=vehicle.release.software_version,
        os_sw_version=0,
        board_version=1,
        flight_custom_version=[0, 0, 0, 253, 175, 214, 222, 89],
        middleware_custom_version=[0, 0, 0, 253, 175, 214, 222, 89],
        os_custom_version=[0] * 8,
        vendor_id=0,
        product_id=0,
        uid=5283920058631409231,
    )
