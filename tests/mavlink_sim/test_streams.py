"""The messages of each link, their rates, and their fields as on a real vehicle."""

import math
import os
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from mavlink_sim.wire.announcements import event_identifier
from mavlink_sim.wire.messages import dialect
from mavlink_sim.wire.streams import Streams
from tests.mavlink_sim.conftest import SimHarness, position_setpoint, velocity_setpoint

pytestmark = pytest.mark.streams("everything")

DATA = Path(os.environ.get("COMPANION_TEST_DATA", Path(__file__).parents[2] / "../shared/data"))
RECORDING = DATA / "px4" / "px4_sih_offboard_flight.tlog"


def counts(harness: SimHarness, link: str, seconds: float) -> Counter[str]:
    harness.forget()
    harness.fly(seconds)
    return Counter(item.message.get_type() for _, item in harness.inbox[link])


# As counted on a real PX4, disarmed, over 20 s; independent of the vehicle's tables.
MEASURED_ONBOARD_HZ = {
    "ATTITUDE": 98.5,
    **dict.fromkeys(("ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "HIGHRES_IMU"), 49.0),
    **dict.fromkeys(("LOCAL_POSITION_NED", "ODOMETRY"), 29.5),
    **dict.fromkeys(("TIMESYNC", "ALTITUDE", "DISTANCE_SENSOR", "ATTITUDE_TARGET"), 9.85),
    **dict.fromkeys(("POSITION_TARGET_LOCAL_NED", "SERVO_OUTPUT_RAW", "VFR_HUD"), 9.85),
    "GPS_RAW_INT": 7.9,
    **dict.fromkeys(("EXTENDED_SYS_STATE", "SYS_STATUS"), 4.95),
    **dict.fromkeys(("HEARTBEAT", "ESTIMATOR_STATUS", "PING", "SCALED_PRESSURE", "SYSTEM_TIME"), 1.0),
    **dict.fromkeys(("OPEN_DRONE_ID_LOCATION", "OPEN_DRONE_ID_SYSTEM"), 1.0),
    **dict.fromkeys(("LINK_NODE_STATUS", "MISSION_CURRENT"), 1.0),
    **dict.fromkeys(("BATTERY_STATUS", "CURRENT_MODE", "HOME_POSITION", "VIBRATION"), 0.5),
    "TIME_ESTIMATE_TO_TARGET": 0.5,
    "CURRENT_EVENT_SEQUENCE": 0.3,
}
MEASURED_GCS_HZ = {
    **dict.fromkeys(("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "ATTITUDE", "ATTITUDE_QUATERNION"), 49.0),
    **dict.fromkeys(("ATTITUDE_TARGET", "POSITION_TARGET_LOCAL_NED", "SERVO_OUTPUT_RAW"), 49.0),
    "GPS_RAW_INT": 5.0,
}


@pytest.fixture
def settled(harness: SimHarness) -> SimHarness:
    harness.fly(6.0)  # what a start alone sends is over
    return harness


def test_streams_have_the_measured_rates(settled: SimHarness) -> None:
    seen = counts(settled, "onboard", 20.0)
    assert set(seen) == set(MEASURED_ONBOARD_HZ)  # nothing else, in particular no RC_CHANNELS
    for name, rate in MEASURED_ONBOARD_HZ.items():
        assert seen[name] / 20.0 == pytest.approx(rate, rel=0.01, abs=0.051), name
    seen = Counter(item.message.get_type() for _, item in settled.inbox["gcs"])
    assert set(seen) <= set(MEASURED_ONBOARD_HZ)
    for name, rate in MEASURED_GCS_HZ.items():
        assert seen.pop(name) / 20.0 == pytest.approx(rate, rel=0.01, abs=0.051), name
    assert seen["HEARTBEAT"] == 20
    assert max(seen.values()) <= 21


def test_modes_with_goal_stream_position_target_global(harness: SimHarness) -> None:
    harness.take_off(5.0)
    harness.forget()
    harness.fly(1.0)
    goals = harness.received("POSITION_TARGET_GLOBAL_INT")
    assert 9 <= len(goals) <= 10
    assert goals[-1].alt == pytest.approx(494.4, abs=0.1)


def test_origin_sent_once_and_on_request(harness: SimHarness) -> None:
    harness.fly(10.0)
    assert len(harness.received("GPS_GLOBAL_ORIGIN")) == 1
    assert harness.command(512, 49) == [0]
    assert len(harness.received("GPS_GLOBAL_ORIGIN")) == 2


def test_the_messages_agree_with_each_other_and_with_the_truth(harness: SimHarness) -> None:
    harness.take_off(5.0)
    there = position_setpoint(4, -3, -6, 0.7)
    harness.offboard(there)
    harness.fly(30.0, there)
    north, east, down = harness.vehicle.airframe.position
    local = harness.received("LOCAL_POSITION_NED")[-1]
    odometry = harness.received("ODOMETRY")[-1]
    world = harness.received("GLOBAL_POSITION_INT")[-1]
    attitude = harness.received("ATTITUDE")[-1]
    hud = harness.received("VFR_HUD")[-1]
    assert (local.x, local.y, local.z) == pytest.approx((north, east, down), abs=0.05)
    assert (odometry.x, odometry.y, odometry.z) == pytest.approx((north, east, down), abs=0.05)
    assert (odometry.frame_id, odometry.child_frame_id) == (1, 1)
    metres = math.radians(1e-7) * 6371000.0
    assert (world.lat - 473977432) * metres == pytest.approx(north, abs=0.05)
    assert (world.lon - 85455942) * metres * math.cos(math.radians(47.4)) == pytest.approx(east, abs=0.05)
    assert world.relative_alt == pytest.approx(-down * 1000, abs=50)
    assert world.alt == pytest.approx(489400 - down * 1000, abs=50)
    assert attitude.yaw == pytest.approx(0.7, abs=0.02)
    assert world.hdg == pytest.approx(math.degrees(0.7) * 100, abs=120)
    assert hud.heading in (39, 40, 41)
    assert harness.received("DISTANCE_SENSOR")[-1].current_distance == pytest.approx(-down * 100, abs=5)


def test_delayed_stream_skips_instead_of_bursting() -> None:
    streams = Streams({"ATTITUDE": 100.0})
    assert streams.due(1_000_000) == ["ATTITUDE"]
    assert streams.due(1_000_000) == []
    assert streams.due(1_010_000) == ["ATTITUDE"]


def test_every_message_survives_the_wire(harness: SimHarness) -> None:
    harness.take_off()
    codec = dialect.MAVLink(None, 1, 1)
    reader = dialect.MAVLink(None)
    for _, item in harness.inbox["onboard"]:
        (message,) = reader.parse_buffer(item.pack(codec))
        if message.get_msgId() in dialect.mavlink_map:
            assert message.get_type() == item.message.get_type()


@pytest.fixture(scope="module")
def recorded() -> dict[str, list[Any]]:
    """The real vehicle's messages by type."""
    if not RECORDING.exists():
        pytest.skip(f"needs the recorded flight {RECORDING}")
    log = mavutil.mavlink_connection(str(RECORDING))
    found: dict[str, list[Any]] = {}
    while (message := log.recv_msg()) is not None:
        own = (message.get_srcSystem(), message.get_srcComponent()) == (1, 1)
        if own or message.get_type().startswith("UNKNOWN"):
            found.setdefault(message.get_type(), []).append(message)
    return found


NAMES_OF_UNKNOWN = {
    "UNKNOWN_8": "LINK_NODE_STATUS",
    "UNKNOWN_380": "TIME_ESTIMATE_TO_TARGET",
    "UNKNOWN_410": "EVENT",
    "UNKNOWN_411": "CURRENT_EVENT_SEQUENCE",
    "UNKNOWN_436": "CURRENT_MODE",  # in the dialects "common" and "ardupilotmega"
}


def test_flight_yields_same_kinds_of_messages_as_real_one(
    harness: SimHarness, recorded: dict[str, list[Any]]
) -> None:
    harness.take_off()
    stream = velocity_setpoint(1, 0, -0.5)
    harness.offboard(stream)
    harness.fly(2.0, stream)
    harness.command(21)
    harness.until(lambda: not harness.armed, 40.0)
    ours = {item.message.get_type() for _, item in harness.inbox["onboard"]}
    theirs = {NAMES_OF_UNKNOWN.get(name, name) for name in recorded}
    assert theirs - ours == {"PARAM_VALUE"}  # a few that PX4 sends unrequested when a parameter changes
    assert ours - theirs == set()


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        ("HEARTBEAT", ("type", "autopilot", "mavlink_version")),
        ("ODOMETRY", ("frame_id", "child_frame_id", "estimator_type", "quality")),
        ("POSITION_TARGET_LOCAL_NED", ("coordinate_frame",)),
        ("POSITION_TARGET_GLOBAL_INT", ("coordinate_frame", "type_mask")),
        ("DISTANCE_SENSOR", ("min_distance", "max_distance", "type", "id", "orientation")),
        ("EXTENDED_SYS_STATE", ("vtol_state",)),
        ("GPS_RAW_INT", ("fix_type", "satellites_visible", "eph", "epv")),
        ("MISSION_CURRENT", ("seq", "total", "mission_state", "mission_mode")),
        ("BATTERY_STATUS", ("id", "battery_function", "type", "temperature", "current_battery")),
        ("PING", ("target_system", "target_component")),
    ],
)
def test_constant_fields_are_those_of_the_real_vehicle(
    harness: SimHarness, recorded: dict[str, list[Any]], kind: str, fields: tuple[str, ...]
) -> None:
    harness.take_off()
    ours, theirs = harness.received(kind)[-1], recorded[kind][-1]
    assert [getattr(ours, field) for field in fields] == [getattr(theirs, field) for field in fields]


def test_events_are_those_of_the_real_flight(harness: SimHarness, recorded: dict[str, list[Any]]) -> None:
    harness.take_off()
    harness.command(21)
    harness.until(lambda: not harness.armed, 40.0)
    theirs = {bytes(message.data)[10:14] for message in recorded["UNKNOWN_410"]}
    events = harness.received("EVENT")
    # Of PX4's report at 2.1 s only the end was recorded: this check of it was not.
    unrecorded = event_identifier("check_estimator_heading_not_stable").to_bytes(4, "little")
    assert {message.id.to_bytes(4, "little") for message in events} - {unrecorded} <= theirs
    assert [message.sequence for message in events] == list(range(1, len(events) + 1))
