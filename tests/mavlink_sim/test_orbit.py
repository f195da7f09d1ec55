"""DO_ORBIT: the circle, the heading on it, its limits, and its telemetry."""

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.flight.orbit import Orbit
from mavlink_sim.physics.geography import HOME_ALTITUDE_M
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SIH_FRAME, SimHarness

NAN = math.nan
CENTRE = (12.0, 5.0, 0.0)
RADIUS_EXCEEDED = "Orbit radius limit exceeded\t"  # STATUSTEXT of PX4


def orbit(
    harness: SimHarness,
    radius_m: float = 8.0,
    speed_mps: float = 3.0,
    yaw_behaviour: float = 0.0,
    centre: tuple[float, float, float] | None = CENTRE,
    altitude_m: float = NAN,
) -> list[int]:
    """Send DO_ORBIT; its answers."""
    position = (NAN, NAN) if centre is None else SIH_FRAME.geographic(centre)[:2]
    results: list[int] = harness.command(34, radius_m, speed_mps, yaw_behaviour, NAN, *position, altitude_m)
    return results


def angle_rad(harness: SimHarness) -> float:
    """Direction from the centre to the vehicle, clockwise from north."""
    x, y, _ = harness.vehicle.airframe.position
    return math.atan2(y - CENTRE[1], x - CENTRE[0])


def distance_m(harness: SimHarness) -> float:
    x, y, _ = harness.vehicle.airframe.position
    return math.hypot(y - CENTRE[1], x - CENTRE[0])


def task_of(harness: SimHarness) -> Orbit:
    task = harness.vehicle.autopilot.task
    assert isinstance(task, Orbit)
    return task


def circling(harness: SimHarness, seconds: float = 20.0, **options: Any) -> Any:
    harness.take_off(6.0)
    assert orbit(harness, **options) == [0]
    harness.fly(seconds)
    return harness


@pytest.mark.parametrize(
    ("radius_m", "speed_mps", "clockwise"),
    [
        (8.0, -3.0, False),
        (-8.0, -3.0, True),
        pytest.param(8.0, 3.0, True, marks=pytest.mark.slow),
        pytest.param(-8.0, 3.0, False, marks=pytest.mark.slow),
    ],
)
def test_it_circles_at_radius_and_speed_in_direction_of_signs(
    harness: SimHarness, radius_m: float, speed_mps: float, clockwise: bool
) -> None:
    circling(harness, radius_m=radius_m, speed_mps=speed_mps)
    assert harness.mode == "ORBIT"
    before = angle_rad(harness)
    for _ in range(10):
        harness.fly(0.5)
        assert distance_m(harness) == pytest.approx(8.0, abs=0.6)
        # the integrator cannot follow a drag that turns: the velocity loop's gains leave two thirds of it
        assert 0.65 * 3.0 < math.hypot(*harness.vehicle.airframe.velocity) < 3.1
    turned = math.remainder(angle_rad(harness) - before, math.tau)
    assert 0.65 < turned * (1.0 if clockwise else -1.0) / (3.0 / 8.0 * 5.0) < 1.05
    assert harness.height_m == pytest.approx(6.0, abs=0.9)


def test_orbit_mode_reported_and_prevents_arming(harness: SimHarness) -> None:
    circling(harness, seconds=2.0)
    assert harness.command(512, 436) == [0]
    mode = harness.received("CURRENT_MODE")[-1]
    assert (mode.standard_mode, mode.custom_mode, mode.intended_custom_mode) == (2, 0x01030000, 0x01030000)
    assert (harness.heartbeat().custom_mode, harness.heartbeat().base_mode) == (0x01030000, 145)


def test_disarmed_orbit_accepted_and_arming_refused(harness: SimHarness) -> None:
    harness.wait_ready()
    assert orbit(harness) == [0]
    assert harness.heartbeat().base_mode == 17
    assert harness.command(400, 1) == [1]
    assert harness.set_mode(4, 3) == [0, 0]
    assert harness.command(400, 1) == [0]
    assert orbit(harness) == [0]
    harness.fly(5.0)
    assert harness.height_m == 0.0  # an orbit does not take off


def test_set_mode_with_the_orbit_numbers_is_position_mode(harness: SimHarness) -> None:
    harness.fly(0.1)
    assert harness.set_mode(3, 1) == [0, 0]
    assert harness.heartbeat().custom_mode == 0x00030000


@pytest.mark.parametrize("behaviour", [0, 1, 2, 3, 4])
def test_each_heading_behaviour(harness: SimHarness, behaviour: int) -> None:
    harness.take_off(6.0)
    initial = harness.vehicle.airframe.yaw_rad
    assert orbit(harness, yaw_behaviour=behaviour) == [0]
    harness.fly(25.0)
    seen, wanted = [], []
    for _ in range(8):
        harness.fly(0.5)
        seen.append(harness.vehicle.airframe.yaw_rad)
        inward = angle_rad(harness) + math.pi
        # clockwise, the tangent is a quarter turn ahead of the radius
        wanted.append({0: inward, 1: initial, 3: inward - math.pi / 2}.get(behaviour, seen[0]))
    errors = [abs(math.remainder(a - b, math.tau)) for a, b in zip(seen, wanted, strict=True)]
    assert max(errors) < math.radians(15.0)


def test_unchanged_keeps_heading_of_previous_orbit() -> None:
    harness = SimHarness(parameters={"MC_ORBIT_YAW_MOD": 3})
    circling(harness, seconds=1.0, yaw_behaviour=5)
    task = task_of(harness)
    assert task.yaw_behaviour == 3
    orbit(harness, yaw_behaviour=1)
    orbit(harness, yaw_behaviour=5, speed_mps=2.0)
    assert (task.yaw_behaviour, task.speed_mps) == (1, 2.0)


def test_the_altitude_is_approached_with_the_circle(harness: SimHarness) -> None:
    circling(harness, altitude_m=HOME_ALTITUDE_M + 10.0)
    assert harness.height_m == pytest.approx(10.0, abs=0.9)


def test_without_centre_orbits_its_position(harness: SimHarness) -> None:
    harness.take_off(6.0)
    x, y, _ = harness.vehicle.airframe.position
    assert orbit(harness, radius_m=5.0, speed_mps=NAN, centre=None) == [0]
    harness.fly(20.0)
    north, east, _ = harness.vehicle.airframe.position
    assert math.hypot(north - x, east - y) == pytest.approx(5.0, abs=0.6)
    assert math.hypot(*harness.vehicle.airframe.velocity) == pytest.approx(1.0, abs=0.3)


def test_the_speed_is_limited_by_the_centripetal_acceleration(harness: SimHarness) -> None:
    circling(harness, radius_m=4.5, speed_mps=9.0, seconds=1.0)
    assert task_of(harness).speed_mps == pytest.approx(3.0)  # sqrt(2 m/s² * 4.5 m)


@pytest.mark.parametrize("radius_m", [0.0, 0.5, -0.9, 1001.0])
def test_invalid_radius_accepted_reported_and_hovers(harness: SimHarness, radius_m: float) -> None:
    harness.heartbeats.append(("gcs", (245, 190), 6))
    circling(harness, seconds=0.1, radius_m=radius_m)
    assert harness.texts()[-1] == RADIUS_EXCEEDED
    before = harness.vehicle.airframe.position
    harness.forget()
    harness.fly(5.0)
    assert harness.mode == "ORBIT"
    assert math.dist(harness.vehicle.airframe.position, before) < 0.3
    assert harness.received("ORBIT_EXECUTION_STATUS") == []


def test_new_request_changes_orbit(harness: SimHarness) -> None:
    circling(harness, seconds=15.0)
    assert orbit(harness, radius_m=-15.0, speed_mps=NAN, centre=None) == [0]
    harness.fly(15.0)
    assert distance_m(harness) == pytest.approx(15.0, abs=0.8)
    assert task_of(harness).speed_mps == -3.0


@pytest.mark.streams("POSITION_TARGET_GLOBAL_INT", "POSITION_TARGET_LOCAL_NED")
def test_execution_status_sent_during_orbit(harness: SimHarness) -> None:
    harness.heartbeats.append(("gcs", (245, 190), 6))
    circling(harness, radius_m=-8.0, seconds=15.0)
    harness.forget()
    harness.fly(4.0)
    reported = harness.received("ORBIT_EXECUTION_STATUS")
    assert 19 <= len(reported) <= 21
    assert 7 <= len(harness.received("ORBIT_EXECUTION_STATUS", "gcs")) <= 9
    latitude, longitude, _ = SIH_FRAME.geographic(CENTRE)
    last = reported[-1]
    assert (last.radius, last.frame) == (-8.0, 0)
    assert (last.x, last.y) == pytest.approx((round(latitude * 1e7), round(longitude * 1e7)), abs=1)
    assert last.z == pytest.approx(HOME_ALTITUDE_M + harness.height_m, abs=0.1)
    assert harness.received("POSITION_TARGET_GLOBAL_INT") == []
    assert harness.received("POSITION_TARGET_LOCAL_NED")[-1].type_mask == 3  # the circle is flown by velocity

    assert harness.set_mode(4, 3) == [0, 0]
    harness.forget()
    harness.fly(2.0)
    assert harness.received("ORBIT_EXECUTION_STATUS") == []
    assert harness.command(512, 360) == [2]


def test_position_out_of_range_accepted_as_in_px4(harness: SimHarness) -> None:
    harness.take_off(6.0)
    assert harness.command(34, 8, 3, 0, NAN, 91.0, 8.0, NAN) == [0]
    assert harness.mode == "ORBIT"


def test_turning_by_condition_yaw_is_unsupported(harness: SimHarness) -> None:
    assert harness.command(115, 90, 20, 1, 0) == [3]


numbers = st.one_of(st.floats(width=32), st.sampled_from([0.0, 1.0, 5.0, -20.0, NAN]))


@settings(max_examples=12, deadline=None)
@given(st.lists(st.lists(numbers, min_size=7, max_size=7), min_size=1, max_size=4))
def test_any_request_stays_finite(requests: list[list[float]]) -> None:
    harness = SimHarness(["everything"], ready_after_s=0.0)
    airframe = harness.vehicle.airframe
    airframe.position, airframe.on_ground = (0.0, 0.0, -5.0), False
    harness.command(400, 1)
    harness.vehicle.autopilot.ground.landed = False
    for values in requests:
        assert harness.command(34, *values) in ([0], [2])
        harness.fly(0.5)
    assert all(map(math.isfinite, (*airframe.position, *airframe.velocity, airframe.yaw_rad)))
    codec = dialect.MAVLink(None, 1, 1)
    for _, item in harness.inbox["onboard"]:
        assert item.pack(codec)
