"""The streams of a link: almost none by default, then by REQUEST_DATA_STREAM and SET_MESSAGE_INTERVAL.

Each group has a rate, in the parameters SR0_* (the ground station's link) and SR1_* (the companion's);
REQUEST_DATA_STREAM sets those until the next reboot. An interval set for one message overrides its group's
rate until that group is requested by REQUEST_DATA_STREAM on the link, or until the next reboot.
"""

from __future__ import annotations

from typing import Any

from mavlink_sim.vehicles.ardupilot.context import CopterContext
from mavlink_sim.wire.links import Link

MAX_RATE_HZ = 200.0
MAX_INTERVAL_US = 60_000_000

# The parameter's suffix, MAV_DATA_STREAM, and its messages (those of Copter's list that this vehicle has).
GROUPS: dict[str, tuple[int, tuple[str, ...]]] = {
    "RAW_SENS": (1, ("RAW_IMU", "SCALED_PRESSURE")),
    "EXT_STAT": (2, ("SYS_STATUS", "MISSION_CURRENT", "GPS_RAW_INT", "POSITION_TARGET_GLOBAL_INT")),
    "RC_CHAN": (3, ("SERVO_OUTPUT_RAW", "RC_CHANNELS")),
    "RAW_CTRL": (4, ()),
    "POSITION": (6, ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED")),
    "EXTRA1": (10, ("ATTITUDE",)),
    "EXTRA2": (11, ("VFR_HUD",)),
    "EXTRA3": (12, ("SYSTEM_TIME", "DISTANCE_SENSOR", "BATTERY_STATUS", "EKF_STATUS_REPORT", "VIBRATION")),
}
# In no group: by SET_MESSAGE_INTERVAL or REQUEST_MESSAGE only.
SINGLE = (
    "ATTITUDE_QUATERNION",
    "ATTITUDE_TARGET",
    "POSITION_TARGET_LOCAL_NED",
    "EXTENDED_SYS_STATE",
    "HOME_POSITION",
    "GPS_GLOBAL_ORIGIN",
)
# By default: the heartbeat, and a TIMESYNC request every ten seconds.
UNASKED_HZ = {"HEARTBEAT": 1.0, "TIMESYNC": 0.1}
RATES_HZ: dict[str, float] = (
    UNASKED_HZ | {name: 0.0 for _, names in GROUPS.values() for name in names} | dict.fromkeys(SINGLE, 0.0)
)
ALL_STREAMS = 0  # MAV_DATA_STREAM_ALL
_GROUP_OF = {name: group for group, (_, names) in GROUPS.items() for name in names}


def prefix(vehicle: CopterContext, link: Link) -> str:
    """SR0_ or SR1_, of the link."""
    return "SR0_" if link.name == "gcs" else "SR1_"


def follow_parameters(vehicle: CopterContext, link: Link) -> None:
    """Give every message of a group the group's rate, unless its own was set."""
    own = vehicle.own_intervals[link.name]
    for group, (_, names) in GROUPS.items():
        rate = vehicle.parameters.number(prefix(vehicle, link) + group)
        interval = -1 if rate <= 0 else round(1e6 / min(rate, MAX_RATE_HZ))
        for name in names:
            if name not in own and link.streams.interval_us(name) != interval:
                link.streams.set_interval(name, interval, vehicle.boot_us)


def set_interval(vehicle: CopterContext, link: Link, name: str, interval_us: float) -> None:
    """Set the interval of one message; -1: off, 0: the group's rate."""
    own = vehicle.own_intervals[link.name]
    own.discard(name)
    if interval_us == 0.0:
        if name in _GROUP_OF:
            follow_parameters(vehicle, link)
            return
        rate = UNASKED_HZ.get(name, 0.0)
        interval = round(1e6 / rate) if rate else -1
    else:
        own.add(name)
        shortest = 1e6 / MAX_RATE_HZ
        interval = round(min(max(interval_us, shortest), MAX_INTERVAL_US)) if interval_us > 0.0 else -1
    link.streams.set_interval(name, interval, vehicle.boot_us)


def forget_requests(vehicle: CopterContext) -> None:
    """Drop rates requested by messages at a reboot; those set as parameters stay."""
    for name, rate in vehicle.unsaved_rates.items():
        vehicle.parameters.set(name, rate)
    vehicle.unsaved_rates.clear()
    for link in vehicle.links.values():
        vehicle.own_intervals[link.name].clear()
        follow_parameters(vehicle, link)


def request_data_stream(vehicle: CopterContext, link: Link, message: Any) -> None:
    """REQUEST_DATA_STREAM: the rate of one group or of all; it replaces the intervals of single messages."""
    rate = min(int(message.req_message_rate), int(MAX_RATE_HZ)) if message.start_stop else 0
    for group, (identifier, names) in GROUPS.items():
        if message.req_stream_id in (ALL_STREAMS, identifier):
            name = prefix(vehicle, link) + group
            vehicle.unsaved_rates.setdefault(name, vehicle.parameters.number(name))
            vehicle.parameters.set(name, rate)
            vehicle.own_intervals[link.name].difference_update(names)
    follow_parameters(vehicle, link)
