"""How every part of a service is, as one message."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from companion.bus.session import Bus
from companion.guidance.pilot import Pilot
from companion.guidance.pose_sharing import PoseSharing
from companion.perception.views import View
from companion.vehicle.state import VehicleState
from companion.vehicle.streamer import Streamer


def status_message(
    now_ns: int,
    *,
    uptime_s: float,
    healthy: bool,
    state: VehicleState,
    pilot: Pilot,
    streamer: Streamer,
    views: Sequence[View],
    steering: View,
    poses: PoseSharing,
    gimbal: dict[str, Any] | None,
    bus: Bus,
) -> dict[str, Any]:
    """What is published on `status` (`docs/messages.md`).

    Args:
        now_ns: CLOCK_MONOTONIC. uptime_s: since the service began. gimbal: as `GimbalHand.status`.
    """
    return {
        "stamp_ns": now_ns,
        "uptime_s": round(uptime_s, 1),
        "healthy": healthy,
        "vehicle": {
            "connected": state.connected(now_ns),
            "mode": state.mode.value,
            "armed": state.armed,
            "failsafe": state.failsafe,
        },
        "pilot": {
            "in_command": pilot.in_command,
            "behaviour": pilot.status,
            "stream": streamer.state.value,
            "setpoints_sent": streamer.sent_count,
        },
        "perception": views[0].keeper.status.as_dict(),
        "views": {view.name: view.keeper.status.as_dict() for view in views if view.name},
        "targets": {
            "view": steering.name,
            "count": len(steering.targets),
            "problem": steering.unplaced,
        },
        "gimbal": gimbal,
        "neighbours": poses.status(now_ns),
        "bus": {
            "connected": bus.connected,
            "published": dict(bus.published),
            "unsent": bus.unsent,
        },
    }
