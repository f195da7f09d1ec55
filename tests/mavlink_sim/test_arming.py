"""Arming, disarming, readiness, and their report in HEARTBEAT and SYS_STATUS."""

import math

import pytest

from tests.mavlink_sim.conftest import SimHarness, velocity_setpoint

PREARM_CHECK = 0x10000000
REJECTED = 1


def prearm(harness: SimHarness) -> bool:
    harness.forget()
    harness.fly(0.25)
    return bool(harness.received("SYS_STATUS")[-1].onboard_control_sensors_health & PREARM_CHECK)


def test_boots_in_hold_and_becomes_ready(harness: SimHarness) -> None:
    assert not prearm(harness)
    first = harness.heartbeat()
    assert (first.type, first.autopilot, first.mavlink_version) == (2, 12, 3)
    assert (first.custom_mode, first.base_mode, first.system_status) == (0x03040000, 29, 0)
    harness.wait_ready()
    assert prearm(harness)
    assert harness.heartbeat().system_status == 3


def test_arming_too_early_is_temporarily_rejected(harness: SimHarness) -> None:
    harness.fly(1.0)
    assert harness.command(400, 1) == [REJECTED]
    assert not harness.armed


def test_arming_when_ready_is_accepted_and_shown(harness: SimHarness) -> None:
    harness.wait_ready()
    assert harness.command(400, 1) == [0]
    beat = harness.heartbeat()
    assert (beat.base_mode, beat.system_status) == (157, 4)
    assert harness.command(400, 1) == [0]  # once more is no error


def test_disarming_on_ground_accepted_and_so_disarming_twice(harness: SimHarness) -> None:
    harness.wait_ready()
    harness.command(400, 1)
    assert harness.command(400, 0) == [0]
    assert not harness.armed
    assert harness.command(400, 0) == [0]


def test_disarming_in_air_is_refused_without_magic_number(harness: SimHarness) -> None:
    harness.take_off()
    assert harness.command(400, 0) == [REJECTED]
    assert harness.armed
    assert harness.command(400, 0, 21196) == [0]
    assert not harness.armed
    harness.until(lambda: "landed" in harness.events, 5.0)
    assert harness.height_m == 0.0


def test_invalid_arming_value_sends_text_and_no_answer(harness: SimHarness) -> None:
    harness.heartbeats.append(("gcs", (245, 190), 6))
    harness.wait_ready()
    for value, texts in ((2.0, "2.000"), (-1.4, "-1.400"), (1.5, "1.500")):
        assert harness.command(400, value) == []
        assert harness.texts()[-1] == f"Unsupported ARM_DISARM param: {texts}\t"
    assert not harness.armed


@pytest.mark.parametrize(("arms", "disarms"), [(0.5, 0.4), (257.0, 256.0), (1.4, math.nan), (1.0, math.inf)])
def test_the_arming_value_is_rounded_and_kept_in_a_byte(
    harness: SimHarness, arms: float, disarms: float
) -> None:
    harness.wait_ready()
    assert harness.command(400, arms) == [0]
    assert harness.armed
    assert harness.command(400, disarms) == [0]
    assert not harness.armed


def test_disarms_after_11_s_without_takeoff(harness: SimHarness) -> None:
    harness.wait_ready()
    harness.command(400, 1)
    assert 10.8 < harness.until(lambda: not harness.armed, 15.0) < 11.6


def test_the_time_to_the_preflight_disarm_is_a_parameter() -> None:
    harness = SimHarness(parameters={"COM_DISARM_PRFLT": 2.0})
    harness.wait_ready()
    harness.command(400, 1)
    assert 2.9 < harness.until(lambda: not harness.armed, 15.0) < 3.5


@pytest.mark.parametrize(
    ("main", "sub", "ready"),
    [
        (4, 3, True),  # HOLD
        (4, 2, True),  # TAKEOFF
        (4, 5, False),  # RTL
        (4, 6, False),  # LAND
        (4, 4, False),  # MISSION
        (3, 0, False),  # POSCTL, without a remote control
        (6, 0, False),  # OFFBOARD, without setpoints
    ],
)
def test_readiness_depends_on_the_mode(harness: SimHarness, main: int, sub: int, ready: bool) -> None:
    harness.wait_ready()
    assert harness.set_mode(main, sub) == [0, 0]
    assert prearm(harness) is ready
    assert harness.heartbeat().system_status == (3 if ready else 0)
    assert harness.command(400, 1) == [0 if ready else REJECTED]


def test_a_remote_control_makes_position_mode_ready(harness: SimHarness) -> None:
    harness.wait_ready()
    assert harness.vehicle.autopilot.pilot_takes_over() == 0
    assert harness.mode == "POSCTL"
    assert harness.command(400, 1) == [0]


def test_an_offboard_stream_makes_offboard_ready(harness: SimHarness) -> None:
    harness.wait_ready()
    harness.offboard(velocity_setpoint(0, 0, 0))
    assert prearm(harness)
    harness.events.clear()
    harness.fly(1.1)  # the stream has stopped
    beat = harness.heartbeat()
    assert (beat.custom_mode, beat.base_mode) == (0x00060000, 17)  # the newest setpoint, however old
    assert harness.events == []
    assert not prearm(harness)
    assert harness.heartbeat().system_status == 0
    assert harness.command(400, 1) == [REJECTED]
