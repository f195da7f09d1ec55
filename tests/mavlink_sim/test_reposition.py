"""DO_REPOSITION, DO_CHANGE_ALTITUDE and DO_CHANGE_SPEED: goals and speeds of auto modes."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.flight.tasks import reposition_goal
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.geography import HOME_ALTITUDE_M
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SIH_FRAME, SimHarness, velocity_setpoint

NAN = math.nan
CHANGE_MODE = 1.0
NOT_GIVEN = 2**31 - 1
# A planned flight waits for a vehicle that its drag holds back: 5 m/s and 2 m/s are reached from below.
FAST = pytest.approx(4.4, abs=0.9)
SLOW = pytest.approx(1.8, abs=0.4)


def reposition(
    harness: SimHarness,
    goal: tuple[float, float] | None,
    height_m: float = NAN,
    *,
    speed_mps: float = -1.0,
    flags: float = CHANGE_MODE,
    yaw: float = NAN,
    frame: int = 5,
) -> list[int]:
    """Send DO_REPOSITION as COMMAND_INT to a local position; its answers."""
    x, y = (NOT_GIVEN, NOT_GIVEN)
    if goal is not None:
        latitude, longitude, _ = SIH_FRAME.geographic((*goal, 0.0))
        x, y = round(latitude * 1e7), round(longitude * 1e7)
    values = (speed_mps, flags, 0.0, yaw)
    results: list[int] = harness.command_int(192, values, x, y, HOME_ALTITUDE_M + height_m, frame)
    return results


def top_speed_mps(harness: SimHarness, seconds: float) -> float:
    fastest = 0.0

    def faster() -> bool:
        nonlocal fastest
        vx, vy, _ = harness.vehicle.airframe.velocity
        fastest = max(fastest, math.hypot(vx, vy))
        return False

    harness.until(faster, seconds, must=False)
    return fastest


# ---- where to


@pytest.mark.streams("POSITION_TARGET_GLOBAL_INT")
def test_flies_nose_first_and_holds(harness: SimHarness) -> None:
    harness.take_off(5.0)
    assert reposition(harness, (15.0, 15.0), 8.0) == [0]
    harness.fly(3.0)
    assert harness.mode == "HOLD"
    assert harness.vehicle.airframe.yaw_rad == pytest.approx(math.pi / 4, abs=0.1)
    harness.fly(20.0)
    assert math.dist(harness.vehicle.airframe.position, (15.0, 15.0, -8.0)) < 0.3
    assert harness.vehicle.airframe.yaw_rad == pytest.approx(math.pi / 4, abs=0.1)
    goal = harness.received("POSITION_TARGET_GLOBAL_INT")[-1]
    assert goal.alt == pytest.approx(HOME_ALTITUDE_M + 8.0, abs=0.01)


def test_a_yaw_is_taken_in_radians(harness: SimHarness) -> None:
    harness.take_off(5.0)
    assert reposition(harness, (6.0, 0.0), 5.0, yaw=-1.2) == [0]
    harness.fly(10.0)
    assert harness.vehicle.airframe.yaw_rad == pytest.approx(-1.2, abs=0.02)


@pytest.mark.parametrize(
    ("mode", "yaw_rad"), [(0, math.pi / 2), (1, -math.pi / 2), (2, math.pi / 2), (3, math.pi / 2), (5, 0.0)]
)
def test_without_yaw_parameter_decides_where_nose_points(mode: int, yaw_rad: float) -> None:
    harness = SimHarness(parameters={"MPC_YAW_MODE": mode})
    harness.take_off(5.0)
    assert reposition(harness, (0.0, 30.0), 5.0) == [0]
    harness.fly(6.0)
    assert harness.vehicle.airframe.yaw_rad == pytest.approx(yaw_rad, abs=0.15)


@pytest.mark.parametrize("frame", [0, 3, 5, 6])
def test_frame_ignored_and_altitude_is_amsl(harness: SimHarness, frame: int) -> None:
    harness.take_off(5.0)
    assert reposition(harness, (2.0, 0.0), 7.0, frame=frame) == [0]
    harness.fly(8.0)
    assert harness.height_m == pytest.approx(7.0, abs=0.3)


def test_altitude_only_keeps_horizontal_goal(harness: SimHarness) -> None:
    harness.take_off(5.0)
    reposition(harness, (12.0, 0.0), 5.0)
    harness.fly(1.5)
    assert reposition(harness, None, 9.0) == [0]
    harness.fly(20.0)
    assert math.dist(harness.vehicle.airframe.position, (12.0, 0.0, -9.0)) < 0.4


def test_without_values_it_stops(harness: SimHarness) -> None:
    harness.take_off(5.0)
    reposition(harness, (40.0, 0.0), 5.0)
    harness.fly(4.0)
    assert harness.vehicle.airframe.velocity[0] > 2.5
    assert reposition(harness, None) == [0]
    x = harness.vehicle.airframe.position[0]
    harness.fly(8.0)
    assert math.hypot(*harness.vehicle.airframe.velocity) < 0.15
    assert 1.0 < harness.vehicle.airframe.position[0] - x < 12.0


@pytest.mark.parametrize("flags", [0.0, 2.0, 3.0, NAN])
def test_without_mode_flag_unsupported_but_flown_in_hold(harness: SimHarness, flags: float) -> None:
    """As measured on PX4 v1.17 in SIH: its commander refuses, and its navigator flies."""
    harness.take_off(5.0)
    assert reposition(harness, (9.0, 0.0), 5.0, flags=flags) == [3]
    harness.fly(12.0)
    assert harness.mode == "HOLD"
    assert harness.vehicle.airframe.position[0] == pytest.approx(9.0, abs=0.3)


def test_without_mode_flag_other_modes_continue(harness: SimHarness) -> None:
    harness.take_off(5.0)
    stream = velocity_setpoint(0, 1, 0)
    harness.offboard(stream)
    assert reposition(harness, (9.0, 0.0), 5.0, flags=0.0) == [3]
    harness.fly(4.0, stream)
    assert harness.mode == "OFFBOARD"
    assert abs(harness.vehicle.airframe.position[0]) < 0.5


def test_position_out_of_range_accepted_as_in_px4(harness: SimHarness) -> None:
    harness.take_off(5.0)
    assert harness.command(192, -1, 1, 0, NAN, 91.0, 8.0, 500.0) == [0]
    harness.fly(5.0)
    assert harness.vehicle.airframe.velocity[0] > 2.0
    assert harness.command_int(192, (-1.0, 1.0, 0.0, NAN), NOT_GIVEN, 85_000_000, 500.0) == [0]


def test_nan_in_command_int_is_denied(harness: SimHarness) -> None:
    harness.take_off(5.0)
    for command in (192, 34, 22):
        assert harness.command_int(command, (-1.0, 1.0, 0.0, NAN), 0x7FF80000, 0x7FF80000, 500.0) == [2]
    assert harness.mode == "HOLD"


def test_disarmed_mode_accepted_goal_dropped(harness: SimHarness) -> None:
    harness.wait_ready()
    harness.set_mode(4, 2)
    assert reposition(harness, (20.0, 0.0), 10.0) == [0]
    assert harness.mode == "HOLD"
    harness.take_off(4.0)
    harness.fly(4.0)
    assert math.hypot(*harness.vehicle.airframe.position[:2]) < 0.3


def test_armed_on_the_ground_it_takes_off_to_the_goal(harness: SimHarness) -> None:
    harness.wait_ready()
    assert harness.command(400, 1) == [0]
    assert reposition(harness, (5.0, 0.0), 6.0) == [0]
    harness.fly(25.0)
    assert harness.mode == "HOLD"
    assert math.dist(harness.vehicle.airframe.position, (5.0, 0.0, -6.0)) < 0.4


def test_ends_offboard_despite_setpoints(harness: SimHarness) -> None:
    harness.take_off(5.0)
    stream = velocity_setpoint(1, 0, 0)
    harness.offboard(stream)
    assert reposition(harness, (0.0, 6.0), 5.0) == [0]
    harness.fly(12.0, stream)
    assert harness.mode == "HOLD"
    assert math.dist(harness.vehicle.airframe.position, (0.0, 6.0, -5.0)) < 0.3


def test_do_change_altitude_changes_altitude(harness: SimHarness) -> None:
    harness.take_off(5.0)
    assert harness.command(186, HOME_ALTITUDE_M + 9.0, 0) == [0]
    harness.fly(8.0)
    assert harness.height_m == pytest.approx(9.0, abs=0.3)


coordinate = st.one_of(st.just(NAN), st.floats(-500.0, 500.0))


@settings(max_examples=60, deadline=None)
@given(coordinate, coordinate, coordinate, st.one_of(st.just(NAN), st.floats(-3.0, 3.0)), st.booleans())
def test_goal_is_always_complete(x: float, y: float, z: float, yaw: float, going: bool) -> None:
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


def test_cruise_speed_from_parameter_or_command(harness: SimHarness) -> None:
    harness.take_off(5.0)
    reposition(harness, (50.0, 0.0), 5.0)
    assert top_speed_mps(harness, 12.0) == FAST
    reposition(harness, (0.0, 0.0), 5.0, speed_mps=2.0)
    harness.fly(6.0)
    assert top_speed_mps(harness, 10.0) == SLOW


def test_speed_change_lasts_until_mode_ends(harness: SimHarness) -> None:
    harness.take_off(5.0)
    reposition(harness, (60.0, 0.0), 5.0)
    harness.fly(5.0)
    assert harness.command(178, 1, 2.0, -1) == [0]
    harness.fly(4.0)
    assert top_speed_mps(harness, 4.0) == SLOW
    reposition(harness, (0.0, 0.0), 5.0)
    harness.fly(5.0)
    assert top_speed_mps(harness, 4.0) == SLOW
    harness.set_mode(4, 5)
    harness.set_mode(4, 3)
    reposition(harness, (90.0, 0.0), 5.0)
    assert top_speed_mps(harness, 12.0) == FAST


def test_other_speed_type_applies_to_next_goal(harness: SimHarness) -> None:
    harness.take_off(5.0)
    reposition(harness, (80.0, 0.0), 5.0)
    harness.fly(5.0)
    assert harness.command(178, 0, 2.0, -1) == [0]  # an airspeed
    assert top_speed_mps(harness, 4.0) == FAST
    reposition(harness, (90.0, 0.0), 5.0)
    harness.fly(4.0)
    assert top_speed_mps(harness, 3.0) == SLOW
    assert harness.command(178, 1, 0.0, -1) == [0]
    reposition(harness, (0.0, 0.0), 5.0)
    assert top_speed_mps(harness, 12.0) == FAST


@pytest.mark.parametrize("values", [(1.0, 5.0, -1.0), (NAN, NAN, NAN), (1.0, -7.0, 50.0)])
def test_a_speed_change_is_accepted_in_any_state(harness: SimHarness, values: tuple[float, ...]) -> None:
    harness.fly(0.1)
    assert harness.command(178, *values) == [0]


# ---- number of answers


def test_older_release_single_answer_to_set_mode() -> None:
    harness = SimHarness(px4="1.15")
    harness.take_off()
    assert harness.set_mode(4, 4) == [1]
    assert harness.set_mode(6) == [1]
    assert harness.set_mode(4, 5) == [0]
    assert harness.mode == "RTL"
    harness.send(dialect.MAVLink_set_mode_message(1, 1, 0x03040000))
    harness.fly(0.05)
    assert harness.mode == "HOLD"
