"""Manual control over MAVLink: joysticks, channels of a remote control, and their telemetry."""

from __future__ import annotations

from typing import Any

from mavlink_sim.flight.transmitter import CHANNELS, Sticks
from mavlink_sim.services.context import ServiceContext
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import dialect

CHANNEL_UNUSED = 65535  # UINT16_MAX
FIRST_EXTENSION_CHANNEL = (
    9  # channels 9 to 18 of RC_CHANNELS_OVERRIDE are an extension: there 0 means unused too
)
FRAME_LIFETIME_S = 0.2  # RC_CHANNELS is sent while frames arrive
FULL_SIGNAL = 100  # RC_CHANNELS.rssi of a MAVLink remote control
RC_RECEIVER = 0x10000  # MAV_SYS_STATUS_SENSOR_RC_RECEIVER


def manual_control(vehicle: ServiceContext, link: Link, message: Any) -> None:
    """MANUAL_CONTROL (69): a joystick. An axis out of range is taken as centred."""
    if message.target not in (0, vehicle.system_id):
        return
    sticks = Sticks(
        roll=_axis(message.y),
        pitch=_axis(message.x),
        yaw=_axis(message.r),
        throttle=message.z / 500.0 - 1.0 if 0 <= message.z <= 1000 else 0.0,
    )
    vehicle.autopilot.supervision.joystick(sticks, list(vehicle.links.values()).index(link))


def _axis(value: int) -> float:
    return value / 1000.0 if -1000 <= value <= 1000 else 0.0


def rc_channels_override(vehicle: ServiceContext, link: Link, message: Any) -> None:
    """RC_CHANNELS_OVERRIDE (70): for PX4 the channels of a remote control, not an override of one."""
    widths = [int(getattr(message, f"chan{number}_raw")) for number in range(1, CHANNELS + 1)]
    while widths and _is_unused(len(widths), widths[-1]):
        widths.pop()
    if widths:
        vehicle.autopilot.supervision.remote_control(widths)


def _is_unused(number: int, width_us: int) -> bool:
    return width_us == CHANNEL_UNUSED or (width_us == 0 and number >= FIRST_EXTENSION_CHANNEL)


def rc_channels(vehicle: ServiceContext) -> Any:
    """RC_CHANNELS (65) of the newest frame; None without a remote control."""
    supervision = vehicle.autopilot.supervision
    widths = supervision.channels_us
    if not widths or vehicle.now_s - supervision.channels_s > FRAME_LIFETIME_S:
        return None
    padded = (widths + [CHANNEL_UNUSED] * CHANNELS)[:CHANNELS]
    return dialect.MAVLink_rc_channels_message(vehicle.boot_ms, len(widths), *padded, FULL_SIGNAL)


def receiver_bits(vehicle: ServiceContext) -> int:
    """SYS_STATUS' bit of the remote control: present and healthy while there are sticks."""
    return RC_RECEIVER if vehicle.autopilot.pilot_has_sticks else 0
