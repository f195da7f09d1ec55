"""Combinations of faults, failsafes, missions and reboots."""

from __future__ import annotations

import math

import pytest

from mavlink_sim import LockstepVehicle
from mavlink_sim.missions.items import MissionItem
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SIH_FRAME, SimHarness, position_setpoint
from tests.mavlink_sim.plan_client import land, takeoff, upload, waypoint

SET_HOME = 179
RETURN_ACTION, TERMINATE_ACTION = 3, 4  # GF_ACTION


def begin(harness: SimHarness, line: str) -> int:
    return harness.vehicle.faults.begin(line)


def lose_position(harness: SimHarness) -> int:
    """Begin a gps_loss and wait until the position is invalid and the vehicle sinks."""
    number = begin(harness, "gps_loss")
    harness.until(lambda: not harness.vehicle.autopilot.position_valid, 6.0)
    harness.fly(0.1)
    return number


def position_comes_back(harness: SimHarness) -> None:
    harness.vehicle.faults.end("gps_loss")
    harness.until(lambda: harness.vehicle.autopilot.position_valid, 2.0)
    harness.fly(0.1)


# ---- a lost position and failsafes


def breach_the_fence(harness: SimHarness, action: int, waits_s: float = 0.0) -> None:
    """A short breach; the action of GF_ACTION lasts longer than the breach."""
    parameters = harness.vehicle.parameters
    parameters.set("COM_FAIL_ACT_T", waits_s)
    parameters.set("GF_ACTION", action)
    parameters.set("GF_MAX_VER_DIST", 2.0)
    harness.until(lambda: harness.vehicle.autopilot.failsafe, 5.0)
    parameters.set("GF_MAX_VER_DIST", 0.0)
    harness.fly(0.1)


def task_of(harness: SimHarness) -> str:
    return type(harness.vehicle.autopilot.task).__name__


def test_latched_failsafe_continues_with_regained_position(harness: SimHarness) -> None:
    harness.take_off(30.0)
    breach_the_fence(harness, RETURN_ACTION)
    assert harness.mode == "RTL"
    lose_position(harness)
    assert (harness.mode, task_of(harness)) == ("LAND", "Descend")
    position_comes_back(harness)
    assert harness.mode == "RTL"
    assert harness.vehicle.autopilot.failsafe
    harness.fly(5.0)
    assert harness.mode == "RTL"


def test_failsafe_descends_blind_then_returns(harness: SimHarness) -> None:
    harness.take_off(40.0)
    lose_position(harness)
    harness.vehicle.parameters.set("COM_FAIL_ACT_T", 0.0)
    harness.vehicle.autopilot.supervision.conditions.flight_time_exceeded = True
    harness.fly(0.1)
    assert (harness.mode, task_of(harness)) == ("LAND", "Descend")
    position_comes_back(harness)
    assert harness.mode == "RTL"


@pytest.mark.parametrize("mode", ["HOLD", "TAKEOFF", "OFFBOARD", "RTL by the fence"])
def test_blind_landing_stays_down_with_regained_position(harness: SimHarness, mode: str) -> None:
    up = position_setpoint(0.0, 0.0, -20.0)
    harness.take_off(4.0)
    harness.vehicle.parameters.set("COM_DISARM_LAND", 30.0)
    if mode == "TAKEOFF":
        assert harness.command(22, math.nan, 0, 0, math.nan, math.nan, math.nan, 489.4 + 40.0) == [0]
    elif mode == "OFFBOARD":
        harness.vehicle.parameters.set("COM_OBL_RC_ACT", 3)
        harness.offboard(position_setpoint(0.0, 0.0, -4.0))
    elif mode != "HOLD":
        breach_the_fence(harness, RETURN_ACTION)
    harness.vehicle.faults.begin("gps_loss")
    harness.until(lambda: task_of(harness) == "Descend", 6.0, position_setpoint(0.0, 0.0, -4.0))
    harness.until(lambda: harness.vehicle.autopilot.landed, 60.0, up)
    harness.vehicle.faults.end("gps_loss")
    harness.until(lambda: harness.vehicle.autopilot.position_valid, 2.0, up)
    harness.fly(6.0, up)
    assert harness.armed
    assert harness.vehicle.autopilot.landed
    assert harness.height_m < 0.1


def test_a_terminated_flight_is_disarmed_once_it_is_down(harness: SimHarness) -> None:
    harness.take_off(5.0)
    breach_the_fence(harness, TERMINATE_ACTION)
    assert harness.vehicle.autopilot.terminated
    assert harness.armed
    harness.until(lambda: not harness.armed, 15.0)
    assert harness.vehicle.autopilot.landed


# ---- faults of the estimate


def test_two_losses_of_gps_that_overlap_leave_no_error(harness: SimHarness) -> None:
    harness.take_off(10.0)
    begin(harness, "gps_loss for=4")
    harness.fly(2.0)
    begin(harness, "gps_loss for=4")
    harness.fly(6.0)
    estimate = harness.vehicle.estimate
    assert estimate.position_valid
    assert estimate.position == pytest.approx(harness.vehicle.airframe.position, abs=1e-6)
    assert estimate.velocity == pytest.approx(harness.vehicle.airframe.velocity, abs=1e-6)


def test_home_here_uses_estimate(harness: SimHarness) -> None:
    harness.wait_ready()
    begin(harness, "ekf_reset 3 0 0")
    assert harness.command(SET_HOME, 1) == [0]
    assert harness.vehicle.autopilot.home.position[0] == pytest.approx(3.0, abs=0.01)
    harness.vehicle.faults.end()
    assert harness.vehicle.estimate.position[0] == pytest.approx(0.0, abs=0.01)


# ---- commands


def test_refuse_mode_does_not_affect_mission(harness: SimHarness) -> None:
    """DO_SET_MODE in a mission is not refused by the fault."""
    harness.take_off(5.0)
    begin(harness, "refuse_mode any")
    assert harness.set_mode(4, 5) == [0, 1]
    own = MissionItem(176, parameters=(1.0, 4.0, 5.0, 0.0, 0.0, 0.0, 0.0))
    harness.vehicle.autopilot.navigator.commands.append(own)
    harness.fly(0.1)
    assert harness.mode == "RTL"


# ---- reboots


@pytest.mark.streams("ATTITUDE", "ODOMETRY")
def test_a_reboot_begins_a_new_boot(harness: SimHarness) -> None:
    harness.heartbeats = [("gcs", (245, 190), 6)]
    vehicle = harness.vehicle
    vehicle.parameters.set("MPC_XY_CRUISE", 4.0)
    harness.take_off(6.0)
    begin(harness, "ekf_reset 3 0 0")
    assert vehicle.estimate.reset_counter
    harness.vehicle.faults.end()
    begin(harness, "reboot 2")
    assert vehicle.now_s == 0.0
    assert not harness.armed
    harness.forget()
    harness.fly(2.5)
    assert harness.received("ATTITUDE")[0].time_boot_ms == pytest.approx(2000, abs=30)
    assert harness.received("ODOMETRY")[-1].reset_counter == 0
    assert not harness.received("HOME_POSITION")
    assert vehicle.parameters.number("MPC_XY_CRUISE") == 4.0
    assert harness.received("CURRENT_EVENT_SEQUENCE") == []
    harness.until(lambda: bool(harness.received("HOME_POSITION")), 5.0)
    assert vehicle.autopilot.landed
    assert vehicle.autopilot.home.position[2] == pytest.approx(0.0, abs=0.01)


def test_boot_while_falling_is_in_air(harness: SimHarness) -> None:
    harness.take_off(60.0)
    begin(harness, "reboot 0.5")
    harness.forget()
    harness.fly(1.5)
    assert harness.height_m > 20.0
    assert harness.received("EXTENDED_SYS_STATE")[-1].landed_state == 2
    harness.until(lambda: harness.vehicle.airframe.on_ground, 20.0)
    harness.fly(1.0)
    assert harness.received("EXTENDED_SYS_STATE")[-1].landed_state == 1


def test_after_a_reboot_a_ground_station_can_be_lost(harness: SimHarness) -> None:
    harness.heartbeats = [("gcs", (245, 190), 6)]
    harness.fly(60.0)
    begin(harness, "reboot 1")
    harness.fly(4.0)
    assert not harness.vehicle.autopilot.supervision.conditions.ground_station_lost
    harness.heartbeats = []
    harness.fly(15.0)
    assert harness.vehicle.autopilot.supervision.conditions.ground_station_lost


def test_reboot_keeps_mission_item_not_reached(harness: SimHarness) -> None:
    harness.wait_ready()
    assert upload(harness, [takeoff(4.0), waypoint(4, 0, 4), waypoint(30, 0, 4), land(30, 0)]) == 0
    assert harness.set_mode(4, 4) == [0, 0]
    assert harness.command(400, 1) == [0]
    harness.until(lambda: harness.vehicle.autopilot.navigator.mission.reached == 1, 60.0)
    begin(harness, "reboot 1")
    mission = harness.vehicle.autopilot.navigator.mission
    assert (len(mission.items), mission.current, mission.reached) == (4, 2, -1)
    harness.forget()
    harness.fly(6.0)
    assert mission.valid
    assert not harness.received("MISSION_ITEM_REACHED")


@pytest.mark.streams("ATTITUDE")
def test_time_jump_survives_reboot_and_ends(harness: SimHarness) -> None:
    harness.fly(5.0)
    number = begin(harness, "time_jump 100")
    begin(harness, "reboot 1")
    harness.fly(2.0)
    assert harness.received("ATTITUDE")[-1].time_boot_ms == pytest.approx(102_000, abs=30)
    harness.vehicle.faults.end(number)
    harness.fly(0.5)
    assert harness.received("ATTITUDE")[-1].time_boot_ms == pytest.approx(2_500, abs=30)


def test_reboot_without_fix_has_no_position_until_there_is_one(harness: SimHarness) -> None:
    harness.wait_ready()
    number = begin(harness, "gps_loss")
    begin(harness, "reboot 1")
    harness.fly(6.0)
    assert not harness.vehicle.autopilot.can_arm
    harness.vehicle.faults.end(number)
    harness.fly(1.5)
    assert harness.vehicle.autopilot.can_arm


def test_reboot_at_reacquisition_has_position(harness: SimHarness) -> None:
    harness.wait_ready()
    begin(harness, "gps_loss")
    harness.fly(6.0)
    harness.vehicle.faults.end()
    begin(harness, "reboot 1")
    harness.fly(5.0)
    assert harness.vehicle.autopilot.can_arm
    estimate = harness.vehicle.estimate
    assert estimate.position == pytest.approx(harness.vehicle.airframe.position, abs=1e-6)


def test_lockstep_repeats_through_reboot_and_stall() -> None:
    vehicle = LockstepVehicle(seed=1)
    vehicle.step(20.0)
    vehicle.repeat(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), 1.0)
    vehicle.vehicle.faults.begin("reboot 1")
    vehicle.vehicle.faults.begin("stall for=2")
    assert vehicle.run_until(lambda truth: truth.time_s > 3.0, 10.0) == pytest.approx(5.0, abs=0.1)
    assert vehicle.vehicle.links["onboard"].received == 4


# ---- the clock and a second autopilot


@pytest.mark.streams("ATTITUDE", "TIMESYNC")
def test_all_clocks_agree_after_stall(harness: SimHarness) -> None:
    harness.fly(2.0)
    begin(harness, "stall for=3")
    harness.fly(4.0)
    harness.send(dialect.MAVLink_timesync_message(0, 5))
    assert harness.received("TIMESYNC")[-1].tc1 == pytest.approx(3e9, abs=2e7)
    assert harness.received("ATTITUDE")[-1].time_boot_ms == pytest.approx(3000, abs=20)


def test_second_autopilot_does_not_move_the_vehicle() -> None:
    harness = SimHarness(["GLOBAL_POSITION_INT"], start_ned_m=(100.0, 200.0))
    harness.wait_ready()
    begin(harness, "second_autopilot 9")
    harness.forget()
    harness.fly(1.0)
    positions = {
        message.get_srcSystem() if hasattr(message, "_system") else 1: SIH_FRAME.local(
            message.lat / 1e7, message.lon / 1e7, 0.0
        )
        for message in harness.received("GLOBAL_POSITION_INT")
    }
    assert positions[1][:2] == pytest.approx((100.0, 200.0), abs=0.05)
    assert positions[9][:2] == pytest.approx((100.0, 225.0), abs=0.5)


def test_second_autopilot_continues_during_stall(harness: SimHarness) -> None:
    harness.wait_ready()
    begin(harness, "second_autopilot 9")
    begin(harness, "stall")
    harness.forget()
    harness.fly(2.5)
    assert {message.get_srcSystem() for message in harness.received("HEARTBEAT")} == {9}
    arm = dialect.MAVLink_command_long_message(9, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    harness.send(arm)
    harness.fly(0.1)
    assert [ack.command for ack in harness.received("COMMAND_ACK")] == [400]
    harness.vehicle.faults.end("stall")
    harness.fly(0.1)
    assert len(harness.received("COMMAND_ACK")) == 1


@pytest.mark.streams("SERVO_OUTPUT_RAW")
def test_servo_output_has_each_rotor_command(harness: SimHarness) -> None:
    harness.take_off(20.0)
    begin(harness, "motor_failure 2")
    harness.forget()
    harness.fly(0.5)
    reported = harness.received("SERVO_OUTPUT_RAW")[-1]
    widths = [reported.servo1_raw, reported.servo2_raw, reported.servo3_raw, reported.servo4_raw]
    expected = [1000 + round(1000 * command) for command in harness.vehicle.airframe.rotor_commands]
    assert widths == pytest.approx(expected, abs=150)
    assert len(set(widths)) > 1
    assert widths[1] > 1000  # it gives nothing, but is asked to
    assert harness.vehicle.airframe.rotor_thrusts[1] < 0.01


def test_offboard_after_first_setpoint_is_no_failsafe() -> None:
    for phase in (0, 2, 4):  # of the watch, which looks every other control step
        harness = SimHarness()
        harness.take_off(5.0)
        harness.fly(0.004 * phase + 1e-6)
        harness.send(position_setpoint(0.0, 0.0, -5.0))
        assert harness.set_mode(6) == [0, 0]
        assert [event for event in harness.events if "RTL" in event or "failsafe" in event] == []
        assert harness.mode == "OFFBOARD"
