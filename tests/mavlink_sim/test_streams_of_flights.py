"""Every message of a vehicle, in every kind of flight, can be packed and is finite where required."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from mavlink_sim.wire.messages import dialect, parser
from tests.mavlink_sim.conftest import SimHarness
from tests.mavlink_sim.plan_client import circle, land, rally, takeoff, upload, waypoint

NAN = math.nan
HOLD = 0x03040000
NUMBERS = {
    "ATTITUDE": ("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed"),
    "LOCAL_POSITION_NED": ("x", "y", "z", "vx", "vy", "vz"),
    "ODOMETRY": ("x", "y", "z", "vx", "vy", "vz"),
    "VFR_HUD": ("groundspeed", "alt", "climb"),
}


def mission(harness: SimHarness) -> None:
    assert upload(harness, [takeoff(4.0), waypoint(8, 0, 4), land(8, 0)]) == 0
    assert harness.set_mode(4, 4) == [0, 0]
    harness.fly(6.0)


def return_to_a_rally_point(harness: SimHarness) -> None:
    assert upload(harness, [rally(6, 6)], 2) == 0
    assert harness.set_mode(4, 5) == [0, 0]
    harness.fly(6.0)


def precision_landing(harness: SimHarness) -> None:
    seen = dialect.MAVLink_landing_target_message(
        0, 0, 1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.5, 0.0, [1, 0, 0, 0], 2, 1
    )
    harness.fly(0.2, seen)
    assert harness.set_mode(4, 9) == [0, 0]
    harness.fly(6.0, seen)


def geofence(harness: SimHarness) -> None:
    assert upload(harness, [circle(0, 0, 5.0)], 1) == 0
    forward = dialect.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, 1479, 0, 0, 0, 3.0, 0, 0, 0, 0, 0, 0, 0.0
    )
    harness.offboard(forward)
    harness.fly(6.0, forward)


def orbit(harness: SimHarness) -> None:
    assert harness.command(34, 5, 2, 0, NAN, NAN, NAN, NAN) == [0]
    harness.fly(6.0)


def sticks(harness: SimHarness) -> None:
    pushed = dialect.MAVLink_manual_control_message(1, 500, 0, 500, 0, 0)
    harness.fly(0.3, pushed)
    assert harness.set_mode(3) == [0, 0]
    harness.fly(4.0, pushed)


@pytest.mark.parametrize(
    "flight", [mission, return_to_a_rally_point, precision_landing, geofence, orbit, sticks]
)
def test_every_message_of_flights_can_be_packed(flight: Callable[[Any], None]) -> None:
    joystick = {"COM_RC_IN_MODE": 1} if flight is sticks else {}
    harness = SimHarness(["everything"], parameters=joystick)
    harness.take_off(6.0)
    harness.forget()
    flight(harness)
    assert {received.custom_mode for received in harness.received("HEARTBEAT")} - {HOLD}
    codec = parser(1)
    for link in ("onboard", "gcs"):
        for _, item in harness.inbox[link]:
            assert item.pack(codec)
        for kind, names in NUMBERS.items():
            for received in harness.received(kind, link):
                assert all(math.isfinite(getattr(received, name)) for name in names), received
    assert len(harness.received("ATTITUDE")) > 300
