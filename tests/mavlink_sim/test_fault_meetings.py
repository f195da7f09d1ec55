"""Where faults meet each other, failsafes, missions and reboots."""

from __future__ import annotations

import math
from typing import Any

import pytest


ORBIT, CHANGE_ALTITUDE, SET_HOME = 34, 186, 179
RETURN_ACTION, TERMINATE_ACTION = 3, 4  # GF_ACTION


def begin(cockpit: Any, line: str) -> int:
    return cockpit.vehicle.faults.begin(line)


def lose_position(cockpit: Any) -> int:
    """Begin a gps_loss and wait until the position is invalid and the vehicle sinks."""
    number = begin(cockpit, "gps_loss")
    cockpit.until(lambda: not cockpit.vehicle.autopilot.position_valid, 6.0)
    cockpit.fly(0.1)
    return number


def position_comes_back(cockpit: Any) -> None:
    cockpit.vehicle.faults.end("gps_loss")
    cockpit.until(lambda: cockpit.vehicle.autopilot.position_valid, 2.0)
    cockpit.fly(0.1)


# ---- a lost position and failsafes


def breach_the_fence(cockpit: Any, action: int, waits_s: float = 0.0) -> None:
    """Too high for a moment; what GF_ACTION asks for then lasts longer than the breach."""
    parameters = cockpit.vehicle.parameters
    parameters.set("COM_FAIL_ACT_T", waits_s)
    parameters.set("GF_ACTION", action)
    parameters.set("GF_MAX_VER_DIST", 2.0)
    cockpit.until(lambda: cockpit.vehicle.autopilot.failsafe, 5.0)
    parameters.set("GF_MAX_VER_DIST", 0.0)
    cockpit.fly(0.1)


def task_of(cockpit: Any) -> str:
    return type(cockpit.vehicle.autopilot.task).__name__


def test_a_latched_failsafe_goes_on_when_the_position_is_back(cockpit) -> None:
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


def test_a_failsafe_without_a_position_sinks_and_returns_when_it_is_back(cockpit) -> None:
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
    cockpit, position_setpoint, mode
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


def test_a_terminated_flight_is_disarmed_once_it_is_down(cockpit) -> None:
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
def test_without_a_position_no_command_is_taken_that_needs_one(cockpit, command, values) -> None:
    cockpit.take_off(30.0)
    lose_position(cockpit)
    assert cockpit.command(command, *values) == [1]
    assert cockpit.mode == "LAND"


# ---- faults of the estimate


def test_two_losses_of_gps_that_overlap_leave_no_error(cockpit) -> None:
    cockpit.take_off(10.0)
    begin(cockpit, "gps_loss for=4")
    cockpit.fly(2.0)
    begin(cockpit, "gps_loss for=4")
    cockpit.fly(6.0)
    estimate = cockpit.vehicle.estimate
    assert estimate.position_valid
    assert estimate.position == pytest.approx(cockpit.vehicle.airframe.position, abs=1e-6)
    assert estimate.velocity == pytest.approx(cockpit.vehicle.airframe.velocity, abs=1e-6)


def test_home_here_is_where_the_vehicle_believes_to_be(cockpit) -> None:
    cockpit.wait_ready()
    begin(cockpit, "ekf_reset 3 0 0")
    assert cockpit.command(SET_HOME, 1) == [0]
    assert cockpit.vehicle.autopilot.home[0] == pytest.approx(3.0, abs=0.01)
    cockpit.vehicle.faults.end()
    assert cockpit.vehicle.estimate.position[0] == pytest.approx(0.0, abs=0.01)
