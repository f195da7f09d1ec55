"""The destination of RTL: home, a rally point, the mission's landing, or back along the mission."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavlink_sim.missions.items import item_of
from mavlink_sim.missions.plan import Mission
from mavlink_sim.missions.return_flight import Goal, destination, mission_route
from mavlink_sim.physics.geography import SIH_FRAME
from mavlink_sim.px4.parameters import Parameters
from tests.mavlink_sim.conftest import SimHarness
from tests.mavlink_sim.plan_client import item, land, listen, message, rally, takeoff, upload, waypoint

HOME = (0.0, 0.0, 0.0)


def stored(*items: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(item_of(message(index, fields)) for index, fields in enumerate(items))


def chosen(
    kind: int, north: float, east: float, points: tuple[Any, ...] = (), mission: Mission | None = None
) -> Any:
    found, _ = destination(
        points, mission or Mission(), Parameters({"RTL_TYPE": kind}), HOME, SIH_FRAME, (north, east, -5.0)
    )
    return found


POINTS = stored(rally(60, 0), rally(0, 60), rally(5, 0))
LANDING = Mission(stored(takeoff(5.0), waypoint(100, 0, 10), land(100, 30)), valid=True)


@pytest.mark.parametrize(
    ("kind", "point", "goal", "north"),
    [
        (0, (50, 0), Goal.RALLY, 60.0),
        (0, (10, 0), Goal.HOME, 0.0),
        (0, (5, 0), Goal.HOME, 0.0),  # a rally point next to home is none
        (5, (5, 0), Goal.RALLY, 5.0),  # unless home is not allowed
        (1, (10, 0), Goal.RALLY, 60.0),
        (3, (99, 29), Goal.MISSION_LANDING, 100.0),
        (3, (1, 1), Goal.HOME, 0.0),
    ],
)
def test_nearest_allowed_destination_selected(
    kind: int, point: tuple[float, float], goal: Goal, north: float
) -> None:
    found = chosen(kind, *point, POINTS, LANDING)
    assert found.kind is goal
    assert found.position[0] == pytest.approx(north, abs=0.02)


def test_without_rally_type_5_lands_here_type_1_at_home() -> None:
    assert chosen(5, 20, 0).kind is Goal.HERE
    assert chosen(1, 20, 0).kind is Goal.HOME


@given(st.floats(-200, 200), st.floats(-200, 200))
def test_no_allowed_destination_is_much_nearer(north: float, east: float) -> None:
    found = chosen(3, north, east, POINTS[:2], LANDING)
    nearest = min(math.dist((north, east), point) for point in ((0, 0), (60, 0), (0, 60), (100, 30)))
    assert math.dist((north, east), found.position[:2]) <= nearest + 4.1


def test_rally_point_in_integer_frame_is_refused_as_px4_does() -> None:
    points = stored(rally(60, 0, frame=6))
    found, words = destination(points, Mission(), Parameters(), HOME, SIH_FRAME, (59.0, 0.0, -5.0))
    assert found.kind is Goal.HOME
    assert words == ["RTL: unsupported MAV_FRAME\t"]


def test_mission_route_leads_to_landing_or_home() -> None:
    there = Mission(LANDING.items, current=1, valid=True)
    points, end = mission_route(there, Parameters({"RTL_TYPE": 2}), HOME, SIH_FRAME) or ([], HOME)
    assert [point[0] for point in points] == [pytest.approx(100.0, abs=0.02)]
    assert end[1] == pytest.approx(30.0, abs=0.02)
    back = Mission(stored(takeoff(5.0), waypoint(30, 0, 5), waypoint(60, 0, 5)), current=2, valid=True)
    points, end = mission_route(back, Parameters({"RTL_TYPE": 2}), HOME, SIH_FRAME) or ([], (9.0, 9.0, 9.0))
    assert [point[0] for point in points] == pytest.approx([30.0, 0.0], abs=0.02)
    assert end == HOME
    assert mission_route(back, Parameters(), HOME, SIH_FRAME) is None


@pytest.fixture
def make(make_harness: type[SimHarness]) -> Callable[..., SimHarness]:
    """Makes vehicles that are ready at once and return low."""
    return lambda **values: make_harness(
        ready_after_s=0.0, parameters={"RTL_RETURN_ALT": 5.0, "RTL_DESCEND_ALT": 5.0, **values}
    )


def lands_at(harness: SimHarness, north: float, east: float) -> None:
    harness.until(lambda: not harness.armed, 90.0)
    assert math.dist(harness.vehicle.airframe.position[:2], (north, east)) < 1.0


def test_rtl_lands_at_the_nearer_rally_point(make: Callable[..., SimHarness]) -> None:
    harness = make()
    listen(harness)
    upload(harness, [rally(14, 0)], 2)
    harness.take_off(4.0)
    harness.vehicle.airframe.position = (12.0, 3.0, -4.0)
    harness.fly(0.01)  # until the estimate knows
    assert harness.command(20) == [0]
    lands_at(harness, 14, 0)
    assert any("m above destination)" in text for text in harness.texts())


def test_rally_point_return_with_start_offset(
    make_harness: type[SimHarness],
) -> None:
    harness = make_harness(
        ready_after_s=0.0,
        start_ned_m=(10.0, 20.0),
        parameters={"RTL_RETURN_ALT": 5.0, "RTL_DESCEND_ALT": 5.0},
    )
    listen(harness)
    upload(harness, [rally(24, 20)], 2)  # from SIH's home
    harness.take_off(4.0)
    harness.vehicle.airframe.position = (12.0, 3.0, -4.0)
    harness.fly(0.01)
    harness.vehicle.faults.begin("pilot_takeover RTL")  # by a component outside the vehicle
    lands_at(harness, 14, 0)


def test_rtl_follows_mission_to_landing(make: Callable[..., SimHarness]) -> None:
    harness = make(RTL_TYPE=2)
    plan = [takeoff(4.0), waypoint(6, 0, 4, 60.0), waypoint(6, 8, 4), item(189), land(0, 12)]
    upload(harness, plan)
    harness.command(300)
    harness.until(lambda: harness.vehicle.airframe.position[0] > 4.5, 30.0)
    harness.command(20)
    passed = harness.until(lambda: math.dist(harness.vehicle.airframe.position[:2], (6, 8)) < 2.5, 30.0)
    assert passed < 20.0  # it does not wait the minute at the first
    lands_at(harness, 0, 12)


def test_rtl_flies_to_missions_landing_pattern_where_that_nearer(
    make: Callable[..., SimHarness],
) -> None:
    harness = make(RTL_TYPE=3)
    upload(harness, [takeoff(4.0), waypoint(30, 0, 4), item(189), waypoint(20, 5, 4), land(20, 12)])
    harness.take_off(4.0)
    harness.vehicle.airframe.position = (16.0, 8.0, -4.0)
    harness.fly(0.01)  # until the estimate knows
    harness.command(20)
    lands_at(harness, 20, 12)


@pytest.mark.parametrize("before", [True, False])
def test_rtl_leads_to_commanded_home(make: Callable[..., SimHarness], before: bool) -> None:
    harness = make()
    if not before:
        harness.take_off(4.0)
    harness.wait_ready()
    latitude, longitude, altitude = SIH_FRAME.geographic((0.0, 8.0, 0.0))
    assert harness.command(179, 0, 0, 0, 0, latitude, longitude, altitude) == [0]
    if before:
        harness.take_off(4.0)
    harness.fly(2.1)
    home = harness.received("HOME_POSITION")[-1]
    assert home.longitude == pytest.approx(longitude * 1e7, abs=200)  # COMMAND_LONG carries floats
    harness.command(20)
    lands_at(harness, 0, 8)
