"""Detection of take-off and landing."""

from __future__ import annotations

import itertools
import math

import pytest

from mavlink_sim.autopilot.ground_contact import RAMP_CREEP_MPS, GroundContact, asks_to_rise
from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.position_control import TrajectorySetpoint
from mavlink_sim.physics.airframe import GRAVITY_MPS2, Multirotor
from mavlink_sim.px4.parameters import Parameters

NOTHING = (math.nan, math.nan, math.nan)


def contact(detection_s: float = 1.5) -> tuple[Multirotor, GroundContact]:
    airframe = Multirotor()
    airframe.thrust_mps2 = GRAVITY_MPS2
    return airframe, GroundContact(airframe, Parameters({"MPC_TKO_RAMP_T": 2.0}), detection_s)


def wanted(position: float = math.nan, velocity: float = math.nan, acceleration: float = math.nan) -> bool:
    setpoint = TrajectorySetpoint(
        (math.nan, math.nan, position), (math.nan, math.nan, velocity), (math.nan, math.nan, acceleration)
    )
    return asks_to_rise(flight.Offboard(), setpoint, -2.0)


def test_only_upward_setpoints_take_off() -> None:
    assert not wanted()
    assert [wanted(position=down) for down in (-2.2, -2.05, 0.0)] == [True, False, False]
    assert [wanted(velocity=down) for down in (-0.1, 0.0, 1.0)] == [True, False, False]
    assert [wanted(acceleration=down) for down in (-0.4, -0.2, 1.0)] == [True, False, False]
    assert wanted(position=0.0, velocity=-1.0)
    assert not asks_to_rise(None, TrajectorySetpoint(NOTHING, NOTHING, NOTHING), -2.0)


def test_hold_stays_and_takeoff_rises() -> None:
    airframe, parameters = Multirotor(), Parameters()
    up = TrajectorySetpoint(NOTHING, (0.0, 0.0, -3.0), NOTHING)
    none = TrajectorySetpoint(NOTHING, NOTHING, NOTHING)
    assert not asks_to_rise(flight.Hold(airframe, parameters), up, 0.0)
    assert asks_to_rise(flight.Takeoff(airframe, parameters, -5.0), none, 0.0)


def test_ramp_restarts_with_each_takeoff() -> None:
    _, ground = contact()
    assert ground.climb_limit_mps(0.0) == math.inf  # no take-off in progress
    assert ground.rests(1.0, rises=False)
    assert not ground.rests(2.0, rises=True)
    ramp = [ground.climb_limit_mps(2.0 + step / 10) for step in range(20)]
    assert ramp[0] == ramp[15] == RAMP_CREEP_MPS
    assert all(before <= after for before, after in itertools.pairwise(ramp))
    assert ground.climb_limit_mps(4.5) == Parameters().number("MPC_TKO_SPEED")  # not off the ground yet
    ground.leave(1.0)
    assert ground.climb_limit_mps(4.6) == math.inf
    ground.touch_down(9.0)
    assert ground.rests(9.1, rises=False)
    assert not ground.rests(10.0, rises=True)
    assert ground.climb_limit_mps(10.1) == RAMP_CREEP_MPS


@pytest.mark.parametrize("detection_s", [1.0, 1.5])
def test_landed_after_continuous_ground_contact(detection_s: float) -> None:
    airframe, ground = contact(detection_s)
    ground.leave(1.0)
    assert not ground.presses(0.0, 1.0)
    assert not ground.presses(detection_s - 0.1, 1.0)
    assert not ground.presses(detection_s, math.nan)  # no setpoint, and the rotors carry it
    assert not ground.presses(detection_s + 0.1, 1.0)
    airframe.thrust_mps2 = 0.4 * GRAVITY_MPS2
    assert ground.presses(2.0 * detection_s + 0.1, math.nan)  # or they do not
    airframe.on_ground = False
    assert not ground.presses(2.0 * detection_s + 0.2, 1.0)


def test_has_flown_resets_at_arming() -> None:
    _, ground = contact()
    ground.arm(1.0)
    ground.leave(1.0)
    assert (ground.landed, ground.has_flown) == (False, True)
    ground.touch_down(8.0)
    assert (ground.landed, ground.has_flown) == (True, True)
    ground.arm(10.0)
    assert not ground.has_flown
    assert (ground.armed_for_s(11.0), ground.landed_for_s(11.0)) == (1.0, 3.0)
