"""DO_ORBIT: the circle, the heading on it, its limits, and what is told of it."""

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.flight.orbit import Orbit
from mavlink_sim.physics.geography import HOME_ALTITUDE_M, geographic
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import Cockpit

NAN = math.nan
CENTRE = (12.0, 5.0, 0.0)


def orbit(
    cockpit: Cockpit,
    radius_m: float = 8.0,
    speed_mps: float = 3.0,
    yaw_behaviour: float = 0.0,
    centre: tuple[float, float, float] | None = CENTRE,
    altitude_m: float = NAN,
) -> list[int]:
    """Send DO_ORBIT; its answers."""
    place = (NAN, NAN) if centre is None else geographic(centre)[:2]
    results: list[int] = cockpit.command(34, radius_m, speed_mps, yaw_behaviour, NAN, *place, altitude_m)
    return results


def angle_rad(cockpit: Cockpit) -> float:
    """Direction from the centre to the vehicle, clockwise from north."""
    x, y, _ = cockpit.vehicle.airframe.position
    return math.atan2(y - CENTRE[1], x - CENTRE[0])


def distance_m(cockpit: Cockpit) -> float:
    x, y, _ = cockpit.vehicle.airframe.position
    return math.hypot(y - CENTRE[1], x - CENTRE[0])


def task_of(cockpit: Cockpit) -> Orbit:
    task = cockpit.vehicle.autopilot.task
    assert isinstance(task, Orbit)
    return task


def circling(cockpit: Cockpit, seconds: float = 20.0, **options: Any) -> Any:
    cockpit.take_off(6.0)
    assert orbit(cockpit, **options) == [0]
    cockpit.fly(seconds)
    return cockpit


@pytest.mark.parametrize(
    ("radius_m", "speed_mps", "clockwise"),
    [(8.0, 3.0, True), (-8.0, 3.0, False), (8.0, -3.0, False), (-8.0, -3.0, True)],
)
def test_it_circles_at_the_radius_and_speed_in_the_direction_of_the_signs(
    cockpit: Cockpit, radius_m: float, speed_mps: float, clockwise: bool
) -> None:
    circling(cockpit, radius_m=radius_m, speed_mps=speed_mps)
    assert cockpit.mode == "ORBIT"
    before = angle_rad(cockpit)
    for _ in range(10):
        cockpit.fly(0.5)
        assert distance_m(cockpit) == pytest.approx(8.0, abs=0.6)
        # the integrator cannot follow a drag that turns: the velocity loop's gains leave two thirds of it
        assert 0.65 * 3.0 < math.hypot(*cockpit.vehicle.airframe.velocity) < 3.1
    turned = math.remainder(angle_rad(cockpit) - before, math.tau)
    assert 0.65 < turned * (1.0 if clockwise else -1.0) / (3.0 / 8.0 * 5.0) < 1.05
    assert cockpit.height_m == pytest.approx(6.0, abs=0.9)


def test_the_mode_is_shown_as_orbit_and_cannot_be_armed_in(cockpit: Cockpit) -> None:
    circling(cockpit, seconds=2.0)
    assert cockpit.command(512, 436) == [0]
    mode = cockpit.received("CURRENT_MODE")[-1]
    assert (mode.standard_mode, mode.custom_mode, mode.intended_custom_mode) == (2, 0x01030000, 0x01030000)
    assert (cockpit.heartbeat().custom_mode, cockpit.heartbeat().base_mode) == (0x01030000, 145)


def test_disarmed_the_mode_is_taken_and_arming_is_refused(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    assert orbit(cockpit) == [0]
    assert cockpit.heartbeat().base_mode == 17
    assert cockpit.command(400, 1) == [1]
    assert cockpit.set_mode(4, 3) == [0, 0]
    assert cockpit.command(400, 1) == [0]
    assert orbit(cockpit) == [0]
    cockpit.fly(5.0)
    assert cockpit.height_m == 0.0  # an orbit takes nobody off the ground


def test_set_mode_with_the_orbit_numbers_is_position_mode(cockpit: Cockpit) -> None:
    cockpit.fly(0.1)
    assert cockpit.set_mode(3, 1) == [0, 0]
    assert cockpit.heartbeat().custom_mode == 0x00030000


@pytest.mark.parametrize("behaviour", [0, 1, 2, 3, 4])
def test_each_heading_behaviour(cockpit: Cockpit, behaviour: int) -> None:
    cockpit.take_off(6.0)
    initial = cockpit.vehicle.airframe.yaw_rad
    assert orbit(cockpit, yaw_behaviour=behaviour) == [0]
    cockpit.fly(25.0)
    seen, wanted = [], []
    for _ in range(8):
        cockpit.fly(0.5)
        seen.append(cockpit.vehicle.airframe.yaw_rad)
        inward = angle_rad(cockpit) + math.pi
        # clockwise, the tangent is a quarter turn ahead of the way out
        wanted.append({0: inward, 1: initial, 3: inward - math.pi / 2}.get(behaviour, seen[0]))
    errors = [abs(math.remainder(a - b, math.tau)) for a, b in zip(seen, wanted, strict=True)]
    assert max(errors) < math.radians(15.0)


def test_unchanged_keeps_the_heading_of_the_orbit_before_and_at_first_takes_the_parameter(
    make_cockpit: type[Cockpit],
) -> None:
    cockpit = make_cockpit(parameters={"MC_ORBIT_YAW_MOD": 3})
    circling(cockpit, seconds=1.0, yaw_behaviour=5)
    task = task_of(cockpit)
    assert task.yaw_behaviour == 3
    orbit(cockpit, yaw_behaviour=1)
    orbit(cockpit, yaw_behaviour=5, speed_mps=2.0)
    assert (task.yaw_behaviour, task.speed_mps) == (1, 2.0)


def test_the_altitude_is_approached_with_the_circle(cockpit: Cockpit) -> None:
    circling(cockpit, altitude_m=HOME_ALTITUDE_M + 10.0)
    assert cockpit.height_m == pytest.approx(10.0, abs=0.9)


def test_without_a_centre_it_goes_round_where_it_was(cockpit: Cockpit) -> None:
    cockpit.take_off(6.0)
    x, y, _ = cockpit.vehicle.airframe.position
    assert orbit(cockpit, radius_m=5.0, speed_mps=NAN, centre=None) == [0]
    cockpit.fly(20.0)
    north, east, _ = cockpit.vehicle.airframe.position
    assert math.hypot(north - x, east - y) == pytest.approx(5.0, abs=0.6)
    assert math.hypot(*cockpit.vehicle.airframe.velocity) == pytest.approx(1.0, abs=0.3)


def test_the_speed_is_limited_by_the_centripetal_acceleration(cockpit: Cockpit) -> None:
    circling(cockpit, radius_m=4.5, speed_mps=9.0, seconds=1.0)
    assert task_of(cockpit).speed_mps == pytest.approx(3.0)  # sqrt(2 m/s² * 4.5 m)


@pytest.mark.parametrize("radius_m", [0.0, 0.5, -0.9, 1001.0])
def test_a_radius_out_of_the_limits_is_accepted_and_told_and_the_vehicle_hovers(
    cockpit: Cockpit, radius_m: float
) -> None:
    cockpit.heartbeats.append(("gcs", (245, 190), 6))
    circling(cockpit, seconds=0.1, radius_m=radius_m)
    assert cockpit.texts()[-1] == "Orbit radius limit exceeded\t"
    before = cockpit.vehicle.airframe.position
    cockpit.forget()
    cockpit.fly(5.0)
    assert cockpit.mode == "ORBIT"
    assert math.dist(cockpit.vehicle.airframe.position, before) < 0.3
    assert cockpit.received("ORBIT_EXECUTION_STATUS") == []


def test_a_new_request_changes_the_orbit_that_is_flown(cockpit: Cockpit) -> None:
    circling(cockpit, seconds=15.0)
    assert orbit(cockpit, radius_m=-15.0, speed_mps=NAN, centre=None) == [0]
    cockpit.fly(15.0)
    assert distance_m(cockpit) == pytest.approx(15.0, abs=0.8)
    assert task_of(cockpit).speed_mps == -3.0


@pytest.mark.hears("POSITION_TARGET_GLOBAL_INT", "POSITION_TARGET_LOCAL_NED")
def test_the_execution_is_told_while_it_lasts(cockpit: Cockpit) -> None:
    cockpit.heartbeats.append(("gcs", (245, 190), 6))
    circling(cockpit, radius_m=-8.0, seconds=15.0)
    cockpit.forget()
    cockpit.fly(4.0)
    told = cockpit.received("ORBIT_EXECUTION_STATUS")
    assert 19 <= len(told) <= 21
    assert 7 <= len(cockpit.received("ORBIT_EXECUTION_STATUS", "gcs")) <= 9
    latitude, longitude, _ = geographic(CENTRE)
    last = told[-1]
    assert (last.radius, last.frame) == (-8.0, 0)
    assert (last.x, last.y) == pytest.approx((round(latitude * 1e7), round(longitude * 1e7)), abs=1)
    assert last.z == pytest.approx(HOME_ALTITUDE_M + cockpit.height_m, abs=0.1)
    assert cockpit.received("POSITION_TARGET_GLOBAL_INT") == []
    assert cockpit.received("POSITION_TARGET_LOCAL_NED")[-1].type_mask == 3  # the circle is flown by velocity

    assert cockpit.set_mode(4, 3) == [0, 0]
    cockpit.forget()
    cockpit.fly(2.0)
    assert cockpit.received("ORBIT_EXECUTION_STATUS") == []
    assert cockpit.command(512, 360) == [2]


def test_a_place_that_is_not_on_earth_is_taken_as_px4_takes_it(cockpit: Cockpit) -> None:
    cockpit.take_off(6.0)
    assert cockpit.command(34, 8, 3, 0, NAN, 91.0, 8.0, NAN) == [0]
    assert cockpit.mode == "ORBIT"


def test_turning_by_condition_yaw_is_unsupported(cockpit: Cockpit) -> None:
    assert cockpit.command(115, 90, 20, 1, 0) == [3]


numbers = st.one_of(st.floats(width=32), st.sampled_from([0.0, 1.0, 5.0, -20.0, NAN]))


@settings(max_examples=12, deadline=None)
@given(st.lists(st.lists(numbers, min_size=7, max_size=7), min_size=1, max_size=4))
def test_no_request_makes_the_flight_absurd(make_cockpit: type[Cockpit], requests: list[list[float]]) -> None:
    cockpit = make_cockpit(["everything"], ready_after_s=0.0)
    airframe = cockpit.vehicle.airframe
    airframe.position, airframe.on_ground = (0.0, 0.0, -5.0), False
    cockpit.command(400, 1)
    cockpit.vehicle.autopilot.ground.landed = False
    for values in requests:
        assert cockpit.command(34, *values) in ([0], [2])
        cockpit.fly(0.5)
    assert all(map(math.isfinite, (*airframe.position, *airframe.velocity, airframe.yaw_rad)))
    codec = dialect.MAVLink(None, 1, 1)
    for _, item in cockpit.inbox["onboard"]:
        assert item.pack(codec)
