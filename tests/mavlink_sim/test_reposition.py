"""DO_REPOSITION, DO_CHANGE_ALTITUDE and DO_CHANGE_SPEED: where auto modes fly to, and how fast."""

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.flight.reposition import reposition_goal
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.geography import HOME_ALTITUDE_M, geographic
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import Cockpit

NAN = math.nan
CHANGE_MODE = 1.0
NOT_GIVEN = 2**31 - 1
# A planned flight waits for a vehicle that its drag holds back: 5 m/s and 2 m/s are reached from below.
FAST = pytest.approx(4.4, abs=0.9)
SLOW = pytest.approx(1.8, abs=0.4)


def reposition(
    cockpit: Cockpit,
    place: tuple[float, float] | None,
    height_m: float = NAN,
    *,
    speed_mps: float = -1.0,
    flags: float = CHANGE_MODE,
    yaw: float = NAN,
    frame: int = 5,
) -> list[int]:
    """Send DO_REPOSITION as COMMAND_INT to a local place; its answers."""
    x, y = (NOT_GIVEN, NOT_GIVEN)
    if place is not None:
        latitude, longitude, _ = geographic((*place, 0.0))
        x, y = round(latitude * 1e7), round(longitude * 1e7)
    values = (speed_mps, flags, 0.0, yaw)
    results: list[int] = cockpit.command_int(192, values, x, y, HOME_ALTITUDE_M + height_m, frame)
    return results


def top_speed_mps(cockpit: Cockpit, seconds: float) -> float:
    fastest = 0.0

    def faster() -> bool:
        nonlocal fastest
        vx, vy, _ = cockpit.vehicle.airframe.velocity
        fastest = max(fastest, math.hypot(vx, vy))
        return False

    cockpit.until(faster, seconds, must=False)
    return fastest


# ---- where to


@pytest.mark.hears("POSITION_TARGET_GLOBAL_INT")
def test_it_flies_there_nose_first_and_holds(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    assert reposition(cockpit, (15.0, 15.0), 8.0) == [0]
    cockpit.fly(3.0)
    assert cockpit.mode == "HOLD"
    assert cockpit.vehicle.airframe.yaw_rad == pytest.approx(math.pi / 4, abs=0.1)
    cockpit.fly(20.0)
    assert math.dist(cockpit.vehicle.airframe.position, (15.0, 15.0, -8.0)) < 0.3
    assert cockpit.vehicle.airframe.yaw_rad == pytest.approx(math.pi / 4, abs=0.1)
    goal = cockpit.received("POSITION_TARGET_GLOBAL_INT")[-1]
    assert goal.alt == pytest.approx(HOME_ALTITUDE_M + 8.0, abs=0.01)


def test_a_yaw_is_taken_in_radians(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    assert reposition(cockpit, (6.0, 0.0), 5.0, yaw=-1.2) == [0]
    cockpit.fly(10.0)
    assert cockpit.vehicle.airframe.yaw_rad == pytest.approx(-1.2, abs=0.02)


@pytest.mark.parametrize(
    ("mode", "yaw_rad"), [(0, math.pi / 2), (1, -math.pi / 2), (2, math.pi / 2), (3, math.pi / 2), (5, 0.0)]
)
def test_without_a_yaw_the_parameter_decides_where_the_nose_points(
    make_cockpit: type[Cockpit], mode: int, yaw_rad: float
) -> None:
    cockpit = make_cockpit(parameters={"MPC_YAW_MODE": mode})
    cockpit.take_off(5.0)
    assert reposition(cockpit, (0.0, 30.0), 5.0) == [0]
    cockpit.fly(6.0)
    assert cockpit.vehicle.airframe.yaw_rad == pytest.approx(yaw_rad, abs=0.15)


@pytest.mark.parametrize("frame", [0, 3, 5, 6])
def test_the_frame_is_not_looked_at_the_altitude_is_above_sea_level(cockpit: Cockpit, frame: int) -> None:
    cockpit.take_off(5.0)
    assert reposition(cockpit, (2.0, 0.0), 7.0, frame=frame) == [0]
    cockpit.fly(8.0)
    assert cockpit.height_m == pytest.approx(7.0, abs=0.3)


def test_an_altitude_alone_keeps_the_place_it_was_flying_to(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    reposition(cockpit, (12.0, 0.0), 5.0)
    cockpit.fly(1.5)
    assert reposition(cockpit, None, 9.0) == [0]
    cockpit.fly(20.0)
    assert math.dist(cockpit.vehicle.airframe.position, (12.0, 0.0, -9.0)) < 0.4


def test_with_nothing_given_it_stops(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    reposition(cockpit, (40.0, 0.0), 5.0)
    cockpit.fly(4.0)
    assert cockpit.vehicle.airframe.velocity[0] > 2.5
    assert reposition(cockpit, None) == [0]
    x = cockpit.vehicle.airframe.position[0]
    cockpit.fly(8.0)
    assert math.hypot(*cockpit.vehicle.airframe.velocity) < 0.15
    assert 1.0 < cockpit.vehicle.airframe.position[0] - x < 12.0


@pytest.mark.parametrize("flags", [0.0, 2.0, 3.0, NAN])
def test_without_the_mode_flag_or_with_others_it_is_unsupported_and_flown_in_hold(
    cockpit: Cockpit, flags: float
) -> None:
    """As a PX4 v1.17 in SIH did: its commander refuses, and its navigator flies."""
    cockpit.take_off(5.0)
    assert reposition(cockpit, (9.0, 0.0), 5.0, flags=flags) == [3]
    cockpit.fly(12.0)
    assert cockpit.mode == "HOLD"
    assert cockpit.vehicle.airframe.position[0] == pytest.approx(9.0, abs=0.3)


def test_without_the_mode_flag_another_mode_flies_on(cockpit: Cockpit, velocity_setpoint: Any) -> None:
    cockpit.take_off(5.0)
    stream = velocity_setpoint(0, 1, 0)
    cockpit.offboard(stream)
    assert reposition(cockpit, (9.0, 0.0), 5.0, flags=0.0) == [3]
    cockpit.fly(4.0, stream)
    assert cockpit.mode == "OFFBOARD"
    assert abs(cockpit.vehicle.airframe.position[0]) < 0.5


def test_a_place_that_is_not_on_earth_is_taken_as_px4_takes_it(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    assert cockpit.command(192, -1, 1, 0, NAN, 91.0, 8.0, 500.0) == [0]
    cockpit.fly(5.0)
    assert cockpit.vehicle.airframe.velocity[0] > 2.0
    assert cockpit.command_int(192, (-1.0, 1.0, 0.0, NAN), NOT_GIVEN, 85_000_000, 500.0) == [0]


def test_a_nan_put_into_integers_by_accident_is_denied_whatever_the_command(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    for command in (192, 34, 22):
        assert cockpit.command_int(command, (-1.0, 1.0, 0.0, NAN), 0x7FF80000, 0x7FF80000, 500.0) == [2]
    assert cockpit.mode == "HOLD"


def test_disarmed_the_mode_is_taken_and_the_goal_forgotten(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    cockpit.set_mode(4, 2)
    assert reposition(cockpit, (20.0, 0.0), 10.0) == [0]
    assert cockpit.mode == "HOLD"
    cockpit.take_off(4.0)
    cockpit.fly(4.0)
    assert math.hypot(*cockpit.vehicle.airframe.position[:2]) < 0.3


def test_armed_on_the_ground_it_takes_off_to_the_goal(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    assert cockpit.command(400, 1) == [0]
    assert reposition(cockpit, (5.0, 0.0), 6.0) == [0]
    cockpit.fly(25.0)
    assert cockpit.mode == "HOLD"
    assert math.dist(cockpit.vehicle.airframe.position, (5.0, 0.0, -6.0)) < 0.4


def test_it_ends_offboard_though_the_setpoints_go_on(cockpit: Cockpit, velocity_setpoint: Any) -> None:
    cockpit.take_off(5.0)
    stream = velocity_setpoint(1, 0, 0)
    cockpit.offboard(stream)
    assert reposition(cockpit, (0.0, 6.0), 5.0) == [0]
    cockpit.fly(12.0, stream)
    assert cockpit.mode == "HOLD"
    assert math.dist(cockpit.vehicle.airframe.position, (0.0, 6.0, -5.0)) < 0.3


def test_the_altitude_can_be_changed_by_a_command_of_its_own(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    assert cockpit.command(186, HOME_ALTITUDE_M + 9.0, 0) == [0]
    cockpit.fly(8.0)
    assert cockpit.height_m == pytest.approx(9.0, abs=0.3)


coordinate = st.one_of(st.just(NAN), st.floats(-500.0, 500.0))


@settings(max_examples=60, deadline=None)
@given(coordinate, coordinate, coordinate, st.one_of(st.just(NAN), st.floats(-3.0, 3.0)), st.booleans())
def test_the_goal_is_always_a_whole_place(x: float, y: float, z: float, yaw: float, going: bool) -> None:
    airframe = Multirotor()
    airframe.position, airframe.velocity = (1.0, 2.0, -3.0), (2.0, 0.0, 0.0)
    former = (7.0, 8.0, -9.0) if going else None
    goal = reposition_goal((x, y, z), yaw, airframe, Parameters(), former)
    assert all(map(math.isfinite, goal))
    assert goal[2] == (z if math.isfinite(z) else -3.0)
    if math.isfinite(x) and math.isfinite(y):
        assert goal[:2] == (x, y)
    elif math.isfinite(z) or math.isfinite(yaw):
        assert goal[:2] == ((7.0, 8.0) if going else (1.0, 2.0))
    else:
        assert goal[0] > 1.0  # where it comes to rest


# ---- how fast


def test_the_cruise_speed_is_the_parameters_unless_the_command_has_one(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    reposition(cockpit, (50.0, 0.0), 5.0)
    assert top_speed_mps(cockpit, 12.0) == FAST
    reposition(cockpit, (0.0, 0.0), 5.0, speed_mps=2.0)
    cockpit.fly(6.0)
    assert top_speed_mps(cockpit, 10.0) == SLOW


def test_a_speed_change_acts_at_once_and_on_later_goals_until_the_mode_ends(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    reposition(cockpit, (60.0, 0.0), 5.0)
    cockpit.fly(5.0)
    assert cockpit.command(178, 1, 2.0, -1) == [0]
    cockpit.fly(4.0)
    assert top_speed_mps(cockpit, 4.0) == SLOW
    reposition(cockpit, (0.0, 0.0), 5.0)
    cockpit.fly(5.0)
    assert top_speed_mps(cockpit, 4.0) == SLOW
    cockpit.set_mode(4, 5)
    cockpit.set_mode(4, 3)
    reposition(cockpit, (90.0, 0.0), 5.0)
    assert top_speed_mps(cockpit, 12.0) == FAST


def test_a_speed_of_another_kind_waits_for_the_next_goal_and_zero_takes_it_back(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    reposition(cockpit, (80.0, 0.0), 5.0)
    cockpit.fly(5.0)
    assert cockpit.command(178, 0, 2.0, -1) == [0]  # an airspeed
    assert top_speed_mps(cockpit, 4.0) == FAST
    reposition(cockpit, (90.0, 0.0), 5.0)
    cockpit.fly(4.0)
    assert top_speed_mps(cockpit, 3.0) == SLOW
    assert cockpit.command(178, 1, 0.0, -1) == [0]
    reposition(cockpit, (0.0, 0.0), 5.0)
    assert top_speed_mps(cockpit, 12.0) == FAST


@pytest.mark.parametrize("values", [(1.0, 5.0, -1.0), (NAN, NAN, NAN), (1.0, -7.0, 50.0)])
def test_a_speed_change_is_accepted_in_any_state(cockpit: Cockpit, values: tuple[float, ...]) -> None:
    cockpit.fly(0.1)
    assert cockpit.command(178, *values) == [0]


# ---- how many answers


def test_the_older_behaviour_of_a_single_true_answer_to_set_mode(make_cockpit: type[Cockpit]) -> None:
    cockpit = make_cockpit(px4="1.15")
    cockpit.take_off()
    assert cockpit.set_mode(4, 4) == [1]
    assert cockpit.set_mode(6) == [1]
    assert cockpit.set_mode(4, 5) == [0]
    assert cockpit.mode == "RTL"
    cockpit.send(dialect.MAVLink_set_mode_message(1, 1, 0x03040000))
    cockpit.fly(0.05)
    assert cockpit.mode == "HOLD"
