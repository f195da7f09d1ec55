"""TAKEOFF, LAND, RTL and HOLD, their landed states, and the detection of take-off and landing."""

from __future__ import annotations

import itertools
import math

import pytest

from mavlink_sim.autopilot.ground_contact import RAMP_CREEP_MPS, GroundContact, asks_to_rise
from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.position_control import TrajectorySetpoint
from mavlink_sim.physics.airframe import GRAVITY_MPS2, Multirotor
from mavlink_sim.px4.parameters import Parameters
from tests.mavlink_sim.conftest import SIH_FRAME, SimHarness, velocity_setpoint

NAN = math.nan


def landed_states(harness: SimHarness) -> list[int]:
    """The EXTENDED_SYS_STATE.landed_state received, without repetitions."""
    found: list[int] = []
    for message in harness.received("EXTENDED_SYS_STATE"):
        if found[-1:] != [message.landed_state]:
            found.append(message.landed_state)
    return found


def test_take_off_climbs_to_two_and_a_half_metres_and_holds(harness: SimHarness) -> None:
    harness.wait_ready()
    assert harness.command(400, 1) == [0]
    harness.forget()
    armed_s = harness.now_s
    assert harness.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN) == [0]
    assert harness.mode == "TAKEOFF"
    harness.until(lambda: not harness.vehicle.autopilot.landed)
    assert 1.5 < harness.now_s - armed_s < 2.5
    harness.until(lambda: harness.mode == "HOLD")
    assert 6.5 <= harness.now_s - armed_s <= 9.0
    assert 1.8 <= harness.height_m <= 2.2
    harness.fly(6.0)
    assert harness.height_m == pytest.approx(2.5, abs=0.15)
    assert landed_states(harness) == [1, 3, 2]


@pytest.mark.parametrize("seed", range(4))
def test_takeoff_with_gusts_ends_as_measured(seed: int) -> None:
    harness = SimHarness(noise=True, gusts_mps=None, seed=seed)
    harness.wait_ready()
    assert harness.command(400, 1) == [0]
    armed_s = harness.now_s
    harness.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN)
    harness.until(lambda: harness.mode == "HOLD")
    assert 6.5 <= harness.now_s - armed_s <= 9.0
    assert 1.8 <= harness.height_m <= 2.2


@pytest.mark.parametrize(("height_m", "least_s", "most_s"), [(4.0, 7.2, 8.0), (5.0, 7.8, 8.7)])
def test_a_higher_take_off_holds_as_soon_as_measured(
    harness: SimHarness, height_m: float, least_s: float, most_s: float
) -> None:
    harness.wait_ready()
    harness.command(400, 1)
    harness.command(22, NAN, 0, 0, NAN, NAN, NAN, 489.4 + height_m)
    assert harness.mode == "TAKEOFF"
    assert least_s <= harness.until(lambda: harness.mode == "HOLD") + 0.04 <= most_s


def test_in_air_only_when_hold_begins(harness: SimHarness) -> None:
    harness.wait_ready()
    harness.command(400, 1)
    harness.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN)
    states: list[tuple[str, int]] = []

    def watch() -> bool:
        state = (harness.mode, int(harness.vehicle.autopilot.landed_state))
        if states[-1:] != [state]:
            states.append(state)
        return bool(state[0] == "HOLD")

    harness.until(watch)
    assert states == [("TAKEOFF", 1), ("TAKEOFF", 3), ("HOLD", 2)]


def test_take_off_to_a_given_altitude_above_sea(harness: SimHarness) -> None:
    harness.take_off(6.0)
    harness.fly(6.0)
    assert harness.height_m == pytest.approx(6.0, abs=0.3)


def test_take_off_is_accepted_before_arming_and_waits_for_it(harness: SimHarness) -> None:
    harness.fly(0.5)  # not even ready
    assert harness.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN) == [0]
    assert not harness.armed
    harness.wait_ready()
    assert harness.command(400, 1) == [0]
    harness.until(lambda: harness.mode == "HOLD")
    assert harness.height_m > 1.5


def test_takeoff_mode_takes_off_once_armed(harness: SimHarness) -> None:
    harness.wait_ready()
    assert harness.set_mode(4, 2) == [0, 0]
    assert harness.command(400, 1) == [0]
    harness.until(lambda: harness.mode == "HOLD")
    assert harness.height_m > 1.5


def test_take_off_while_flying_is_accepted_and_does_not_descend(harness: SimHarness) -> None:
    harness.take_off(6.0)
    harness.fly(5.0)
    assert harness.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN) == [0]
    harness.fly(3.0)
    assert harness.height_m > 5.5
    assert harness.mode == "HOLD"


def test_landing_touches_down_softly_and_disarms_2_s_later(harness: SimHarness) -> None:
    harness.take_off(4.0)
    harness.fly(4.0)
    harness.forget()
    assert harness.command(21, 0, 0, 0, NAN, NAN, NAN, NAN) == [0]
    assert harness.heartbeat().custom_mode == 0x06040000
    took = harness.until(lambda: harness.vehicle.airframe.on_ground, 20.0)
    harness.until(lambda: harness.vehicle.autopilot.landed, 5.0)
    assert 6.0 <= took <= 12.0
    assert 1.9 < harness.until(lambda: not harness.armed, 5.0) < 2.1
    harness.fly(0.5)
    assert landed_states(harness) == [4, 1]


def test_mode_before_landing_restored(harness: SimHarness) -> None:
    harness.take_off()
    harness.command(21)
    harness.until(lambda: not harness.armed, 30.0)
    assert harness.mode == "HOLD"
    assert harness.heartbeat().system_status == 3


def test_leaving_land_in_the_air_is_in_air_again(harness: SimHarness) -> None:
    harness.take_off(5.0)
    harness.forget()
    harness.command(21)
    harness.fly(1.0)
    harness.set_mode(4, 3)
    harness.fly(1.0)
    assert landed_states(harness)[-2:] == [4, 2]


def test_return_close_to_home_stays_low_lands_and_disarms(harness: SimHarness) -> None:
    harness.take_off(4.0)
    harness.fly(4.0)
    harness.forget()
    highest = harness.height_m
    assert harness.command(20) == [0]
    assert harness.mode == "RTL"
    harness.until(lambda: not harness.armed, 60.0)
    assert highest < 4.5
    assert landed_states(harness)[-2:] == [4, 1]


def test_return_from_afar_climbs_first_and_lands_at_home() -> None:
    harness = SimHarness(parameters={"RTL_RETURN_ALT": 12.0})
    harness.take_off(4.0)
    assert harness.command_int(192, (-1, 1, 0, NAN), 473980000, 85455942, 494.4) == [0]
    harness.fly(14.0)
    assert math.dist(harness.vehicle.airframe.position, (28.5, 0.0, -5.0)) < 1.5
    harness.command(20)
    harness.until(lambda: harness.vehicle.airframe.position[0] < 15.0, 40.0)
    assert abs(math.degrees(harness.vehicle.airframe.yaw_rad)) > 150.0  # it flies nose first
    highest = 0.0

    def done() -> bool:
        nonlocal highest
        highest = max(highest, harness.height_m)
        return not harness.armed

    harness.until(done, 90.0)
    assert 11.5 < highest < 13.0
    assert math.hypot(*harness.vehicle.airframe.position[:2]) < 1.0
    # and lands with the heading at arming, as measured on a real PX4
    assert harness.vehicle.airframe.yaw_rad == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(
    ("parameters", "heading_deg", "landed_deg"),
    [({}, 70.0, 70.0), ({"WV_EN": 1}, 70.0, 120.0), ({}, math.nan, 120.0)],
)
def test_close_to_home_a_return_turns_to_the_heading_of_home(
    parameters: dict[str, float], heading_deg: float, landed_deg: float
) -> None:
    harness = SimHarness(parameters=parameters)
    harness.take_off(5.0)
    latitude, longitude, altitude = SIH_FRAME.geographic((0.0, 0.0, 0.0))
    assert harness.command(179, 0, 0, 0, heading_deg, latitude, longitude, altitude) == [0]
    at, above = (round(latitude * 1e7) + 540, round(longitude * 1e7)), altitude + 5.0  # 6 m north
    assert harness.command_int(192, (-1, 1, 0, math.radians(120.0)), *at, above) == [0]
    harness.fly(8.0)
    assert math.degrees(harness.vehicle.airframe.yaw_rad) == pytest.approx(120.0, abs=2.0)
    harness.command(20)
    harness.until(lambda: not harness.armed, 60.0)
    assert math.degrees(harness.vehicle.airframe.yaw_rad) == pytest.approx(landed_deg, abs=3.0)


@pytest.mark.parametrize(
    ("seed", "wind_mps"), [*(pytest.param(seed, 0.0, marks=pytest.mark.slow) for seed in (0, 1)), (2, 5.0)]
)
def test_return_in_moving_air_ends_at_home_too(seed: int, wind_mps: float) -> None:
    harness = SimHarness(gusts_mps=None, seed=seed, wind_mps=wind_mps)
    harness.take_off(6.0)
    away = velocity_setpoint(3, 0, 0)
    harness.offboard(away)
    harness.fly(6.0, away)  # no more setpoints: the failsafe returns
    harness.until(lambda: not harness.armed, 90.0)
    # depends on the gusts of the last metres: with other seeds it is 0.4 to 3 m
    assert math.hypot(*harness.vehicle.airframe.position[:2]) < 3.5


def test_hold_brakes_and_stays(harness: SimHarness) -> None:
    harness.take_off(5.0)
    fast = velocity_setpoint(4, 0, 0)
    harness.offboard(fast)
    harness.fly(5.0, fast)
    before = harness.vehicle.airframe.position[0]
    harness.set_mode(4, 3)
    harness.fly(12.0)
    assert math.hypot(*harness.vehicle.airframe.velocity) < 0.12
    assert 1.0 < harness.vehicle.airframe.position[0] - before < 8.0


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
