"""The state of every part of a service as one message."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from companion.bus.session import Bus
from companion.guidance.core import Guidance
from companion.perception.cameras import WorkerCamera
from companion.service.inputs import InputAssembler
from companion.service.other_commanders import OtherCommanders
from companion.vehicle.driver import Driver
from companion.vehicle.state import VehicleState
from companion.vehicle.streamer import Streamer


def status_message(
    now_ns: int,
    *,
    healthy: bool,
    driver: Driver,
    guidance: Guidance,
    streamer: Streamer,
    cameras: Sequence[WorkerCamera],
    inputs: InputAssembler,
    bus: Bus,
    others: OtherCommanders,
    dropped_lines: int,
) -> dict[str, Any]:
    """Create the message published on `status` (`docs/messages.md`).

    Args:
        now_ns: CLOCK_MONOTONIC.
        dropped_lines: of the log.
    """
    steering, state = inputs.steering, driver.state
    return {
        "stamp_ns": now_ns,
        "service": inputs.poses.source,
        "uptime_s": round(others.uptime_s(now_ns), 1),
        "healthy": healthy,
        "vehicle": {
            "name": inputs.poses.vehicle,
            "connected": state.connected(now_ns),
            "autopilot": state.autopilot,
            "driver": driver.library,
            "mode": state.mode.value,
            "armed": state.armed,
            "failsafe": state.failsafe,
            "missing_streams": list(state.missing_streams),
            "status_texts": [report.text for report in state.reports],
            "other_commanders": others.status(state, now_ns),
        },
        "pilot": {
            "in_command": guidance.in_command,
            "behaviour": guidance.status,
            "stream": streamer.state.value,
            "setpoints_sent": streamer.sent_count,
        },
        "perception": cameras[0].supervisor.status.as_dict(),
        "cameras": {camera.name: camera.supervisor.status.as_dict() for camera in cameras if camera.name},
        "targets": {
            "camera": steering.name,
            "count": len(steering.targets),
            "localization_error": steering.localization_error,
        },
        "gimbal": guidance.gimbal.status(now_ns, state),
        "neighbours": inputs.poses.status(now_ns),
        "bus": {
            "connected": bus.connected,
            "published": dict(bus.published),
            "publish_failed": bus.publish_failed,
            "refused_commands": bus.intake.refused,
        },
        "log": {"dropped_lines": dropped_lines},
    }


def hud_lines(state: VehicleState, status: str) -> tuple[str, ...]:
    """Return the overlay lines of the recorded video. `status`: guidance's, as text."""
    altitude = "-" if state.altitude_m is None else f"{state.altitude_m:.1f} m"
    speed = state.velocity_ned_mps
    horizontal = "-" if speed is None else f"{(speed[0] ** 2 + speed[1] ** 2) ** 0.5:.1f} m/s"
    return (
        f"{state.mode.value}  {'armed' if state.armed else 'disarmed'}",
        status,
        f"height {altitude}  speed {horizontal}",
    )
