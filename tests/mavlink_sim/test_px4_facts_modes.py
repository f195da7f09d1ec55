"""Measured on a real PX4: answers to commands, modes on the ground, loss of the setpoint stream."""

from __future__ import annotations

import itertools

import pytest

from mavlink_sim.vehicles.vehicle import STEP_S
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SimHarness, velocity_setpoint

PREARM_CHECK = 0x10000000
NAN = float("nan")


def test_answer_within_15_ms_without_heartbeat(harness: SimHarness) -> None:
    harness.wait_ready()
    for number, *values in ((400, 1), (400, 0), (401,), (178, 1, 5), (512, 148), (60000,)):
        harness.forget()
        padded = (*values, *([0.0] * (7 - len(values))))
        harness.send(dialect.MAVLink_command_long_message(1, 1, number, 0, *padded))
        assert harness.until(lambda: bool(harness.received("COMMAND_ACK")), 0.1) <= 0.015


def test_take_off_while_flying_is_accepted_and_shown(harness: SimHarness) -> None:
    harness.take_off(8.0)
    assert harness.command(22, NAN, 0, 0, NAN, NAN, NAN, 489.4 + 20.0) == [0]
    assert harness.mode == "TAKEOFF"


def test_takeoff_to_amsl_ends_within_acceptance_radius(harness: SimHarness) -> None:
    harness.wait_ready()
    harness.command(400, 1)
    harness.command(22, NAN, 0, 0, NAN, NAN, NAN, 489.4 + 5.0)
    harness.until(lambda: harness.mode == "HOLD")
    assert harness.height_m == pytest.approx(4.4, abs=0.3)  # 4.6 m was measured


@pytest.mark.parametrize("flags", [0.0, 1.0])
def test_reposition_by_command_long_needs_the_change_of_mode_too(harness: SimHarness, flags: float) -> None:
    harness.take_off()
    values = (-1, flags, 0, NAN, 47.39775, 8.54559, 494.0)
    assert harness.command(192, *values) == [0 if flags else 3]


@pytest.mark.streams("everything")
def test_offboard_left_1_05_to_1_15_s_after_stream(harness: SimHarness) -> None:
    harness.take_off(4.0)
    stream = velocity_setpoint(0, 0, 0)
    harness.offboard(stream)
    harness.command(511, 436, 20_000)
    harness.send(stream)
    harness.forget()
    harness.fly(2.2)
    last = harness.now_s - 2.2
    seen = [
        (stamp - last, item.message.custom_mode)
        for stamp, item in harness.inbox["onboard"]
        if item.message.get_type() == "CURRENT_MODE"
    ]
    left = next(delay for delay, mode in seen if mode != 0x00060000)
    assert 1.05 <= left <= 1.15
    beats = [
        stamp - last
        for stamp, item in harness.inbox["onboard"]
        if item.message.get_type() == "HEARTBEAT" and item.message.custom_mode != 0x00060000
    ]
    assert left <= beats[0] <= left + 1.0  # a heartbeat shows it when its time has come


def test_heartbeat_shows_loss_after_1_4_to_2_s(harness: SimHarness) -> None:
    """PX4's few losses were seen at 1.4 to 2.0 s. At any phase of the heartbeat, 1.05 to 2.15 s can be."""
    harness.take_off(4.0)
    stream = velocity_setpoint(0, 0, 0)
    harness.offboard(stream)
    seen = []
    for tenth in range(10):
        harness.heartbeat()
        harness.fly(0.1 * tenth + 0.05, stream)
        harness.send(stream)
        last = harness.now_s
        harness.forget()
        harness.until(lambda: any(m.custom_mode != 0x00060000 for m in harness.received("HEARTBEAT")), 3.0)
        seen.append(harness.now_s - last)
        harness.fly(2.2, stream)  # back in OFFBOARD
    assert all(1.05 <= delay <= 2.15 for delay in seen)
    assert sum(1.4 <= delay <= 2.05 for delay in seen) >= 6


def test_stream_of_0_9_hz_is_lost_for_50_ms(harness: SimHarness) -> None:
    harness.take_off(4.0)
    stream = velocity_setpoint(0, 0, 0)
    harness.offboard(stream)
    harness.command(511, 436, 4_000)  # sent when it changes
    harness.until(lambda: bool(harness.received("CURRENT_MODE")), 1.0, stream)
    lost = []

    def look() -> bool:
        lost.append(harness.received("CURRENT_MODE")[-1].custom_mode != 0x00060000)
        return False

    harness.until(look, 9.0, stream, 0.9, must=False)
    stretches = [len(list(group)) * STEP_S for away, group in itertools.groupby(lost) if away]
    assert len(stretches) >= 5
    assert all(0.02 <= stretch <= 0.1 for stretch in stretches)


@pytest.mark.parametrize(("action", "mode"), [(3, "RTL"), (4, "LAND"), (5, "HOLD")])
def test_offboard_resumes_from_every_failsafe_action(action: int, mode: str) -> None:
    harness = SimHarness(parameters={"COM_OBL_RC_ACT": action})
    harness.take_off(6.0)
    stream = velocity_setpoint(0, 0, 0)
    harness.offboard(stream)
    harness.until(lambda: harness.mode == mode, 2.0)
    assert harness.heartbeat().system_status == 5
    assert harness.until(lambda: harness.mode == "OFFBOARD", 1.0, stream) <= 0.1
    harness.fly(0.5, stream)
    assert harness.armed


@pytest.mark.parametrize(("hold_first", "shown"), [(False, 0x00060000), (True, 0x03040000)])
def test_mode_before_offboard_shown_after_landing(harness: SimHarness, hold_first: bool, shown: int) -> None:
    harness.take_off()
    harness.offboard(velocity_setpoint(0, 0, 0))
    if hold_first:
        harness.set_mode(4, 3)
    harness.command(21)
    harness.until(lambda: not harness.armed, 30.0)
    assert harness.heartbeat().custom_mode == shown


def test_failsafe_far_from_home_climbs_to_30_m(harness: SimHarness) -> None:
    harness.take_off(4.0)
    harness.offboard(velocity_setpoint(0, 0, 0))
    north, east, down = harness.vehicle.airframe.position
    harness.vehicle.airframe.position = (north + 60.0, east, down)
    harness.until(lambda: harness.mode == "RTL", 2.0)
    harness.fly(2.0)
    assert harness.vehicle.airframe.velocity[2] < -0.5  # no five seconds of holding before
    harness.until(lambda: harness.height_m > 28.0, 40.0)


@pytest.mark.parametrize("command", [20, 21])
def test_gimbal_commands_sent_at_landing_and_return(harness: SimHarness, command: int) -> None:
    harness.take_off(4.0)
    harness.forget()
    harness.command(command)
    harness.fly(3.0)
    sent = harness.received("COMMAND_LONG")
    assert {(m.target_system, m.target_component) for m in sent} == {(1, 0)}
    assert [(m.command, m.confirmation) for m in sent] == [
        (1001, 0), (1000, 0), (1001, 0), (1001, 1), (1001, 2), (1001, 3),
    ]  # fmt: skip


def test_landed_state_landing_only_on_descent_of_return() -> None:
    harness = SimHarness(parameters={"RTL_RETURN_ALT": 8.0, "RTL_MIN_DIST": 1.0})
    harness.take_off(4.0)
    harness.command_int(192, (-1, 1, 0, NAN), 473978330, 85455942, 493.4)
    harness.fly(10.0)
    harness.forget()
    harness.command(20)
    harness.until(lambda: harness.vehicle.autopilot.landed_state == 4, 60.0)
    north, east, _ = harness.vehicle.airframe.position
    assert abs(north) < 1.5
    assert abs(east) < 1.5
    states = {message.landed_state for message in harness.received("EXTENDED_SYS_STATE")}
    assert states == {2}


@pytest.mark.parametrize(("delay_s", "lands_at_m"), [(0.0, 30.0), (1.0, 10.0)])
def test_a_return_lands_from_its_altitude_without_a_delay(delay_s: float, lands_at_m: float) -> None:
    """PX4: LANDING at 20.9 s, as the descent from 30 m begins, which takes 32 s with the landing."""
    harness = SimHarness(parameters={"RTL_LAND_DELAY": delay_s})
    harness.take_off(6.0)
    harness.command_int(192, (-1, 1, 0, NAN), 473980100, 85455942, 495.4)
    harness.fly(15.0)
    harness.command(20)
    returned_s = harness.now_s
    harness.until(lambda: harness.vehicle.autopilot.landed_state == 4, 60.0)
    assert harness.height_m == pytest.approx(lands_at_m, abs=1.0)
    if not delay_s:
        assert harness.now_s - returned_s == pytest.approx(20.9, abs=1.5)
        landing_s = harness.now_s
        harness.until(lambda: not harness.armed, 60.0)
        assert harness.now_s - landing_s == pytest.approx(31.0, abs=2.0)
