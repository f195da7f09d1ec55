"""Where faults meet each other, failsafes, missions and reboots."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from mavlink_sim import LockstepVehicle
from mavlink_sim.missions.items import MissionItem
from mavlink_sim.physics.geography import local
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import Cockpit
from tests.mavlink_sim.plan_client import land, takeoff, upload, waypoint

ORBIT, CHANGE_ALTITUDE, SET_HOME = 34, 186, 179
RETURN_ACTION, TERMINATE_ACTION = 3, 4  # GF_ACTION


def begin(cockpit: Cockpit, line: str) -> int:
    return cockpit.vehicle.faults.begin(line)


def lose_position(cockpit: Cockpit) -> int:
    """Begin a gps_loss and wait until the position is invalid and the vehicle sinks."""
    number = begin(cockpit, "gps_loss")
    cockpit.until(lambda: not cockpit.vehicle.autopilot.position_valid, 6.0)
    cockpit.fly(0.1)
    return number


def position_comes_back(cockpit: Cockpit) -> None:
    cockpit.vehicle.faults.end("gps_loss")
    cockpit.until(lambda: cockpit.vehicle.autopilot.position_valid, 2.0)
    cockpit.fly(0.1)


# ---- a lost position and failsafes


def breach_the_fence(cockpit: Cockpit, action: int, waits_s: float = 0.0) -> None:
    """Too high for a moment; what GF_ACTION asks for then lasts longer than the breach."""
    parameters = cockpit.vehicle.parameters
    parameters.set("COM_FAIL_ACT_T", waits_s)
    parameters.set("GF_ACTION", action)
    parameters.set("GF_MAX_VER_DIST", 2.0)
    cockpit.until(lambda: cockpit.vehicle.autopilot.failsafe, 5.0)
    parameters.set("GF_MAX_VER_DIST", 0.0)
    cockpit.fly(0.1)


def task_of(cockpit: Cockpit) -> str:
    return type(cockpit.vehicle.autopilot.task).__name__


def test_a_latched_failsafe_goes_on_when_the_position_is_back(cockpit: Cockpit) -> None:
    cockpit.take_off(30.0)
    breach_the_fence(cockpit, RETURN_ACTION)
    assert cockpit.mode == "RTL"
    lose_position(cockpit)
    assert (cockpit.mode, task_of(cockpit)) == ("LAND", "Descend")
    position_comes_back(cockpit)
    assert cockpit.mode == "RTL"
    assert cockpit.vehicle.autopilot.failsafe
    cockpit.fly(5.0)
    assert cockpit.mode == "RTL"


def test_a_failsafe_without_a_position_sinks_and_returns_when_it_is_back(cockpit: Cockpit) -> None:
    cockpit.take_off(40.0)
    lose_position(cockpit)
    cockpit.vehicle.parameters.set("COM_FAIL_ACT_T", 0.0)
    cockpit.vehicle.autopilot.supervision.conditions.flight_time_exceeded = True
    cockpit.fly(0.1)
    assert (cockpit.mode, task_of(cockpit)) == ("LAND", "Descend")
    position_comes_back(cockpit)
    assert cockpit.mode == "RTL"


@pytest.mark.parametrize("mode", ["HOLD", "TAKEOFF", "OFFBOARD", "RTL by the fence"])
def test_a_vehicle_that_landed_blindly_stays_down_when_the_position_is_back(
    cockpit: Cockpit, position_setpoint: Callable[..., Any], mode: str
) -> None:
    up = position_setpoint(0.0, 0.0, -20.0)
    cockpit.take_off(4.0)
    cockpit.vehicle.parameters.set("COM_DISARM_LAND", 30.0)
    if mode == "TAKEOFF":
        assert cockpit.command(22, math.nan, 0, 0, math.nan, math.nan, math.nan, 489.4 + 40.0) == [0]
    elif mode == "OFFBOARD":
        cockpit.offboard(position_setpoint(0.0, 0.0, -4.0))
    elif mode != "HOLD":
        breach_the_fence(cockpit, RETURN_ACTION)
    cockpit.vehicle.faults.begin("gps_loss")
    cockpit.until(lambda: task_of(cockpit) == "Descend", 6.0, position_setpoint(0.0, 0.0, -4.0))
    cockpit.until(lambda: cockpit.vehicle.autopilot.landed, 60.0, up)
    cockpit.vehicle.faults.end("gps_loss")
    cockpit.until(lambda: cockpit.vehicle.autopilot.position_valid, 2.0, up)
    cockpit.fly(6.0, up)
    assert cockpit.armed
    assert cockpit.vehicle.autopilot.landed
    assert cockpit.height_m < 0.1


def test_a_terminated_flight_is_disarmed_once_it_is_down(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    breach_the_fence(cockpit, TERMINATE_ACTION)
    assert cockpit.vehicle.autopilot.terminated
    assert cockpit.armed
    cockpit.until(lambda: not cockpit.armed, 15.0)
    assert cockpit.vehicle.autopilot.landed


@pytest.mark.parametrize(
    ("command", "values"),
    [(ORBIT, (10, 2, 0, 0, math.nan, math.nan, math.nan)), (CHANGE_ALTITUDE, (520.0,))],
    ids=["orbit", "altitude"],
)
def test_without_a_position_no_command_is_taken_that_needs_one(
    cockpit: Cockpit, command: int, values: tuple[float, ...]
) -> None:
    cockpit.take_off(30.0)
    lose_position(cockpit)
    assert cockpit.command(command, *values) == [1]
    assert cockpit.mode == "LAND"


# ---- faults of the estimate


def test_two_losses_of_gps_that_overlap_leave_no_error(cockpit: Cockpit) -> None:
    cockpit.take_off(10.0)
    begin(cockpit, "gps_loss for=4")
    cockpit.fly(2.0)
    begin(cockpit, "gps_loss for=4")
    cockpit.fly(6.0)
    estimate = cockpit.vehicle.estimate
    assert estimate.position_valid
    assert estimate.position == pytest.approx(cockpit.vehicle.airframe.position, abs=1e-6)
    assert estimate.velocity == pytest.approx(cockpit.vehicle.airframe.velocity, abs=1e-6)


def test_home_here_is_where_the_vehicle_believes_to_be(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    begin(cockpit, "ekf_reset 3 0 0")
    assert cockpit.command(SET_HOME, 1) == [0]
    assert cockpit.vehicle.autopilot.home.position[0] == pytest.approx(3.0, abs=0.01)
    cockpit.vehicle.faults.end()
    assert cockpit.vehicle.estimate.position[0] == pytest.approx(0.0, abs=0.01)


# ---- commands


def test_a_mode_that_is_refused_to_clients_is_not_refused_to_the_mission(cockpit: Cockpit) -> None:
    """DO_SET_MODE among the items of a mission is PX4's own affair."""
    cockpit.take_off(5.0)
    begin(cockpit, "refuse_mode any")
    assert cockpit.set_mode(4, 5) == [0, 1]
    own = MissionItem(176, parameters=(1.0, 4.0, 5.0, 0.0, 0.0, 0.0, 0.0))
    cockpit.vehicle.autopilot.navigator.commands.append(own)
    cockpit.fly(0.1)
    assert cockpit.mode == "RTL"


# ---- reboots


@pytest.mark.hears("ATTITUDE", "ODOMETRY")
def test_a_reboot_begins_a_new_boot(cockpit: Cockpit) -> None:
    cockpit.heartbeats = [("gcs", (245, 190), 6)]
    vehicle = cockpit.vehicle
    vehicle.parameters.set("MPC_XY_CRUISE", 4.0)
    cockpit.take_off(6.0)
    begin(cockpit, "ekf_reset 3 0 0")
    assert vehicle.estimate.reset_counter
    cockpit.vehicle.faults.end()
    begin(cockpit, "reboot 2")
    assert vehicle.now_s == 0.0
    assert not cockpit.armed
    cockpit.forget()
    cockpit.fly(2.5)
    assert cockpit.received("ATTITUDE")[0].time_boot_ms == pytest.approx(2000, abs=30)
    assert cockpit.received("ODOMETRY")[-1].reset_counter == 0
    assert not cockpit.received("HOME_POSITION")
    assert vehicle.parameters.number("MPC_XY_CRUISE") == 4.0
    assert cockpit.received("CURRENT_EVENT_SEQUENCE") == []
    cockpit.until(lambda: bool(cockpit.received("HOME_POSITION")), 5.0)
    assert vehicle.autopilot.landed
    assert vehicle.autopilot.home.position[2] == pytest.approx(0.0, abs=0.01)


def test_a_vehicle_that_boots_while_it_falls_is_in_the_air(cockpit: Cockpit) -> None:
    cockpit.take_off(60.0)
    begin(cockpit, "reboot 0.5")
    cockpit.forget()
    cockpit.fly(1.5)
    assert cockpit.height_m > 20.0
    assert cockpit.received("EXTENDED_SYS_STATE")[-1].landed_state == 2
    cockpit.until(lambda: cockpit.vehicle.airframe.on_ground, 20.0)
    cockpit.fly(1.0)
    assert cockpit.received("EXTENDED_SYS_STATE")[-1].landed_state == 1


def test_after_a_reboot_a_ground_station_can_be_lost(cockpit: Cockpit) -> None:
    cockpit.heartbeats = [("gcs", (245, 190), 6)]
    cockpit.fly(60.0)
    begin(cockpit, "reboot 1")
    cockpit.fly(4.0)
    assert not cockpit.vehicle.autopilot.supervision.conditions.ground_station_lost
    cockpit.heartbeats = []
    cockpit.fly(15.0)
    assert cockpit.vehicle.autopilot.supervision.conditions.ground_station_lost


def test_a_mission_and_its_place_outlive_a_reboot_but_not_what_was_reached(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    assert upload(cockpit, [takeoff(4.0), waypoint(4, 0, 4), waypoint(30, 0, 4), land(30, 0)]) == 0
    assert cockpit.set_mode(4, 4) == [0, 0]
    assert cockpit.command(400, 1) == [0]
    cockpit.until(lambda: cockpit.vehicle.autopilot.navigator.mission.reached == 1, 60.0)
    begin(cockpit, "reboot 1")
    mission = cockpit.vehicle.autopilot.navigator.mission
    assert (len(mission.items), mission.current, mission.reached) == (4, 2, -1)
    cockpit.forget()
    cockpit.fly(6.0)
    assert mission.valid
    assert not cockpit.received("MISSION_ITEM_REACHED")


@pytest.mark.hears("ATTITUDE")
def test_a_jump_of_the_clock_outlives_a_reboot_and_ends_cleanly(cockpit: Cockpit) -> None:
    cockpit.fly(5.0)
    number = begin(cockpit, "time_jump 100")
    begin(cockpit, "reboot 1")
    cockpit.fly(2.0)
    assert cockpit.received("ATTITUDE")[-1].time_boot_ms == pytest.approx(102_000, abs=30)
    cockpit.vehicle.faults.end(number)
    cockpit.fly(0.5)
    assert cockpit.received("ATTITUDE")[-1].time_boot_ms == pytest.approx(2_500, abs=30)


def test_a_reboot_without_a_fix_has_no_position_until_there_is_one(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    number = begin(cockpit, "gps_loss")
    begin(cockpit, "reboot 1")
    cockpit.fly(6.0)
    assert not cockpit.vehicle.autopilot.can_arm
    cockpit.vehicle.faults.end(number)
    cockpit.fly(1.5)
    assert cockpit.vehicle.autopilot.can_arm


def test_a_reboot_in_the_moment_of_reacquisition_finds_the_position(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    begin(cockpit, "gps_loss")
    cockpit.fly(6.0)
    cockpit.vehicle.faults.end()
    begin(cockpit, "reboot 1")
    cockpit.fly(5.0)
    assert cockpit.vehicle.autopilot.can_arm
    estimate = cockpit.vehicle.estimate
    assert estimate.position == pytest.approx(cockpit.vehicle.airframe.position, abs=1e-6)


def test_waiting_and_repeating_in_lockstep_go_on_through_a_reboot_and_a_standstill() -> None:
    vehicle = LockstepVehicle(seed=1)
    vehicle.step(20.0)
    vehicle.repeat(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), 1.0)
    vehicle.vehicle.faults.begin("reboot 1")
    vehicle.vehicle.faults.begin("stall for=2")
    assert vehicle.run_until(lambda truth: truth.time_s > 3.0, 10.0) == pytest.approx(5.0, abs=0.1)
    assert vehicle.vehicle.links["onboard"].received == 4


# ---- the clock and other voices


@pytest.mark.hears("ATTITUDE", "TIMESYNC")
def test_after_a_standstill_every_clock_tells_the_same_time(cockpit: Cockpit) -> None:
    cockpit.fly(2.0)
    begin(cockpit, "stall for=3")
    cockpit.fly(4.0)
    cockpit.send(dialect.MAVLink_timesync_message(0, 5))
    assert cockpit.received("TIMESYNC")[-1].tc1 == pytest.approx(3e9, abs=2e7)
    assert cockpit.received("ATTITUDE")[-1].time_boot_ms == pytest.approx(3000, abs=20)


def test_a_second_autopilot_stands_beside_the_vehicle_and_moves_nothing_of_it(
    make_cockpit: type[Cockpit],
) -> None:
    cockpit = make_cockpit(["GLOBAL_POSITION_INT"], start_ned_m=(100.0, 200.0))
    cockpit.wait_ready()
    begin(cockpit, "second_autopilot 9")
    cockpit.forget()
    cockpit.fly(1.0)
    places = {
        message.get_srcSystem() if hasattr(message, "_system") else 1: local(
            message.lat / 1e7, message.lon / 1e7, 0.0
        )
        for message in cockpit.received("GLOBAL_POSITION_INT")
    }
    assert places[1][:2] == pytest.approx((100.0, 200.0), abs=0.05)
    assert places[9][:2] == pytest.approx((100.0, 225.0), abs=0.5)


def test_a_second_autopilot_goes_on_while_the_vehicle_stands_still(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    begin(cockpit, "second_autopilot 9")
    begin(cockpit, "stall")
    cockpit.forget()
    cockpit.fly(2.5)
    assert {message.get_srcSystem() for message in cockpit.received("HEARTBEAT")} == {9}
    arm = dialect.MAVLink_command_long_message(9, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    cockpit.send(arm)
    cockpit.fly(0.1)
    assert [ack.command for ack in cockpit.received("COMMAND_ACK")] == [400]
    cockpit.vehicle.faults.end("stall")
    cockpit.fly(0.1)
    assert len(cockpit.received("COMMAND_ACK")) == 1


@pytest.mark.hears("SERVO_OUTPUT_RAW")
def test_every_rotor_shows_its_own_command_and_a_dead_one_what_it_is_asked_for(cockpit: Cockpit) -> None:
    cockpit.take_off(20.0)
    begin(cockpit, "motor_failure 2")
    cockpit.forget()
    cockpit.fly(0.5)
    told = cockpit.received("SERVO_OUTPUT_RAW")[-1]
    widths = [told.servo1_raw, told.servo2_raw, told.servo3_raw, told.servo4_raw]
    expected = [1000 + round(1000 * command) for command in cockpit.vehicle.airframe.rotor_commands]
    assert widths == pytest.approx(expected, abs=150)
    assert len(set(widths)) > 1
    assert widths[1] > 1000  # it gives nothing, but is asked to
    assert cockpit.vehicle.airframe.rotor_thrusts[1] < 0.01


def test_offboard_right_after_the_first_setpoint_is_no_failsafe(
    make_cockpit: type[Cockpit], position_setpoint: Callable[..., Any]
) -> None:
    for phase in (0, 2, 4):  # of the watch, which looks every other control step
        cockpit = make_cockpit()
        cockpit.take_off(5.0)
        cockpit.fly(0.004 * phase + 1e-6)
        cockpit.send(position_setpoint(0.0, 0.0, -5.0))
        assert cockpit.set_mode(6) == [0, 0]
        assert [event for event in cockpit.events if "RTL" in event or "failsafe" in event] == []
        assert cockpit.mode == "OFFBOARD"
