"""Missions flown from the ground, item by item, and the destination of RTL."""

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
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SIH_FRAME, SimHarness
from tests.mavlink_sim.plan_client import (
    NAN,
    RETURN,
    circle,
    item,
    land,
    listen,
    message,
    polygon,
    rally,
    reached,
    takeoff,
    upload,
    waypoint,
)

SHORT = [takeoff(4.0), waypoint(8, 0, 4), land(8, 0)]

# STATUSTEXTs of PX4.
SHORT_FLOWN = [
    "Executing Mission\t",
    "Climb to 4.0 meters above home\t",
    "Takeoff detected\t",
    "Landing detected\t",
    "Mission finished, landed\t",
    "Disarmed by landing\t",
]
START_DENIED = "Mission start denied! No valid mission\t"
FIRST_WAYPOINT_FAR = "First waypoint far away from home: 150m. Correct mission loaded?\t"
RALLY_FRAME_UNKNOWN = "RTL: unsupported MAV_FRAME\t"


@pytest.fixture
def harness() -> SimHarness:
    """A vehicle that is ready at once."""
    return SimHarness(ready_after_s=0.0)


def away(harness: SimHarness, north: float, east: float) -> float:
    return math.dist(harness.vehicle.airframe.position[:2], (north, east))


def current(harness: SimHarness) -> int:
    return int(harness.vehicle.autopilot.navigator.mission.current)


def status(harness: SimHarness) -> tuple[int, int, int, int]:
    """The newest MISSION_CURRENT: sequence, total, state, mode."""
    harness.fly(1.1)
    texts = harness.received("MISSION_CURRENT")[-1]
    return texts.seq, texts.total, texts.mission_state, texts.mission_mode


def test_a_mission_takes_off_flies_lands_and_disarms(harness: SimHarness) -> None:
    listen(harness)
    assert status(harness) == (0, 65535, 1, 2)
    assert upload(harness, SHORT) == 0
    assert status(harness) == (0, 3, 2, 2)
    assert harness.set_mode(4, 4) == [0, 0]
    assert harness.vehicle.autopilot.can_arm
    assert harness.command(400, 1) == [0]
    harness.until(lambda: harness.height_m > 1.0, 20.0)
    assert harness.vehicle.autopilot.landed_state == 3
    harness.until(lambda: current(harness) == 1, 20.0)
    assert harness.height_m == pytest.approx(4.0, abs=0.9)
    assert status(harness)[2:] == (3, 1)
    harness.until(lambda: not harness.armed, 60.0)
    assert away(harness, 8, 0) < 1.0
    assert reached(harness) == [0, 1, 2]
    assert status(harness)[:3] == (2, 3, 5)
    assert harness.texts()[-6:] == SHORT_FLOWN


def test_mission_start_arms_and_begins_at_given_item(harness: SimHarness) -> None:
    assert harness.command(300, 0, 0) == [2]
    upload(harness, [takeoff(4.0), waypoint(30, 0, 4), waypoint(0, 6, 4)])
    assert harness.command(300, 3, 0) == [2]
    assert harness.command(300, 2, 0) == [0]
    assert harness.armed
    assert harness.mode == "MISSION"
    harness.until(lambda: harness.mode == "HOLD", 40.0)  # after the last item it holds there
    assert reached(harness) == [2]
    harness.fly(4.0)
    assert away(harness, 0, 6) < 1.0
    assert status(harness)[2] == 5


def test_reached_items_are_repeated_ten_times(harness: SimHarness) -> None:
    upload(harness, [takeoff(4.0), item(17, (0, 0, 4), 0, 0, 0, NAN)])
    harness.command(300)
    harness.until(lambda: current(harness) == 1, 30.0)
    harness.fly(13.0)
    assert [m.seq for m in harness.received("MISSION_ITEM_REACHED")] == [0] * 11
    assert harness.mode == "MISSION"  # loiter without end


def test_a_waypoint_is_held_for_its_time_and_heading(harness: SimHarness) -> None:
    upload(harness, [takeoff(3.0), waypoint(5, 0, 3, 3.0, 1.0, 0.0, 90.0), waypoint(5, 5, 3)])
    harness.command(300)
    harness.until(lambda: away(harness, 5, 0) < 1.0, 30.0)
    waited = harness.until(lambda: current(harness) == 2, 20.0)
    assert waited >= 3.0
    assert math.degrees(harness.vehicle.airframe.yaw_rad) == pytest.approx(90.0, abs=12.0)


def test_delay_speed_and_jump_items_work(harness: SimHarness) -> None:
    upload(
        harness,
        [
            takeoff(3.0),
            item(93, None, 2.0),
            item(178, None, 1, 1.0, -1),
            waypoint(6, 0, 3),
            waypoint(0, 0, 3),
            item(177, None, 3, 1),
            item(178, None, 1, -1, -1),
            RETURN,
        ],
    )
    harness.command(300)
    harness.until(lambda: current(harness) == 1, 30.0)
    assert 1.9 <= harness.until(lambda: current(harness) == 3, 10.0) <= 2.4
    fastest = 0.0

    def returning() -> bool:
        nonlocal fastest
        fastest = max(fastest, math.hypot(*harness.vehicle.airframe.velocity[:2]))
        return bool(harness.mode == "RTL")

    harness.until(returning, 60.0)
    assert 0.7 < fastest < 1.4
    assert reached(harness) == [0, 1, 2, 3, 4, 3, 4, 6, 7]
    assert status(harness)[2:] == (5, 2)  # complete, though the vehicle is still on its way


def test_mission_ending_in_return_holds_briefly(harness: SimHarness) -> None:
    upload(harness, [takeoff(3.0), waypoint(4, 0, 3), RETURN])
    harness.command(300)
    harness.until(lambda: harness.mode == "HOLD", 30.0)
    assert 0.03 <= harness.until(lambda: harness.mode == "RTL", 1.0) <= 0.07
    harness.until(lambda: not harness.armed, 60.0)
    assert harness.mode == "HOLD"
    changes = [line for line in harness.events if line.startswith("mode ")]
    assert changes == ["mode MISSION", "mode HOLD", "mode RTL", "mode HOLD"]


def test_pause_keeps_current_item(harness: SimHarness) -> None:
    upload(harness, [takeoff(4.0), waypoint(12, 0, 4), waypoint(12, 8, 4)])
    harness.command(300)
    harness.until(lambda: harness.vehicle.airframe.position[0] > 4.0, 30.0)
    assert harness.set_mode(4, 3) == [0, 0]
    harness.fly(4.0)
    assert status(harness) == (1, 3, 4, 2)  # paused
    stayed = harness.vehicle.airframe.position[0]
    harness.fly(2.0)
    assert harness.vehicle.airframe.position[0] == pytest.approx(stayed, abs=0.5)
    harness.forget()
    assert harness.set_mode(4, 4) == [0, 0]
    assert status(harness) == (1, 3, 3, 1)
    harness.until(lambda: harness.mode == "HOLD", 40.0)
    assert reached(harness) == [1, 2]


def test_intermediate_waypoint_passed_without_stop(harness: SimHarness) -> None:
    upload(harness, [takeoff(4.0), waypoint(15, 0, 4), waypoint(30, 0, 4)])
    harness.command(300)
    harness.until(lambda: current(harness) == 2, 40.0)
    assert harness.vehicle.airframe.velocity[0] > 2.0
    slowest = math.inf

    def beyond() -> bool:
        nonlocal slowest
        slowest = min(slowest, harness.vehicle.airframe.velocity[0])
        return bool(harness.vehicle.airframe.position[0] > 20.0)

    harness.until(beyond, 20.0)
    assert slowest > 2.0


def test_camera_commands_are_sent_to_the_camera(harness: SimHarness) -> None:
    upload(
        harness,
        [
            takeoff(3.0),
            item(2000, None, 0, 1.0, 0),
            item(2000, None, 0, 0, 1),
            item(2001, None, 101),
            item(203, None, 0, 0, 0, 0, 1),
            waypoint(0, 0, 3),
        ],
    )
    harness.command(300)
    harness.until(lambda: harness.mode == "HOLD", 40.0)
    sent = [(m.command, m.target_component) for m in harness.received("COMMAND_LONG")]
    # one single shot goes to the vehicle's own trigger, as DO_DIGICAM_CONTROL
    assert sent == [(2000, 100), (203, 100), (2001, 101), (203, 0)]


def test_a_mission_uploaded_while_flying_one_is_flown_at_once(harness: SimHarness) -> None:
    upload(harness, [takeoff(4.0), waypoint(60, 0, 4)])
    harness.command(300)
    harness.until(lambda: harness.vehicle.airframe.position[0] > 3.0, 30.0)
    upload(harness, [waypoint(3, 8, 4), waypoint(0, 8, 4)])
    harness.until(lambda: harness.mode == "HOLD", 40.0)
    assert away(harness, 0, 8) < 3.0


def test_clearing_the_mission_in_flight_ends_in_hold(harness: SimHarness) -> None:
    upload(harness, [takeoff(4.0), waypoint(60, 0, 4)])
    harness.command(300)
    harness.until(lambda: harness.vehicle.airframe.position[0] > 3.0, 30.0)
    harness.send(dialect.MAVLink_mission_clear_all_message(1, 1, 0))
    harness.fly(1.0)
    assert harness.mode == "HOLD"
    assert harness.set_mode(4, 4) == [0, 1]


def test_a_finished_mission_begins_again_after_disarming(harness: SimHarness) -> None:
    upload(harness, [takeoff(2.5), land()])
    harness.command(300)
    harness.until(lambda: not harness.armed, 60.0)
    assert current(harness) == 1
    harness.forget()
    harness.set_mode(4, 4)
    assert harness.command(400, 1) == [0]
    harness.until(lambda: not harness.armed, 60.0)
    assert reached(harness)[-2:] == [0, 1]


def test_nan_items_do_not_raise(harness: SimHarness) -> None:
    nothing = [NAN] * 7
    strange = [
        takeoff(3.0),
        item(201, None, NAN),
        item(178, None, NAN, NAN),
        item(177, None, NAN, NAN),
        item(1000, None, *nothing[:4]),
        {**waypoint(2, 0, 3, NAN, NAN, NAN, NAN), "z": NAN},
        item(31, (2, 0, 3), NAN, NAN, NAN, NAN),
        item(19, (0, 0, 3), math.inf, NAN, NAN, NAN),
        waypoint(0, 2, 3),
    ]
    assert upload(harness, strange) == 0
    harness.command(300)
    harness.until(lambda: harness.mode == "HOLD", 60.0)
    assert all(map(math.isfinite, harness.vehicle.airframe.position))


def test_an_empty_mission_cannot_be_flown_or_armed_in(harness: SimHarness) -> None:
    assert harness.set_mode(4, 4) == [0, 0]  # on the ground any mode may be chosen
    assert not harness.vehicle.autopilot.can_arm
    assert harness.command(400, 1) == [1]


@pytest.mark.parametrize(
    ("parameters", "plan", "words"),
    [
        ({}, [takeoff(5.0), item(112, None, 3)], "Mission rejected: item 2: unsupported cmd: 112\t"),
        ({}, [land()], "Mission rejected: starts with landing\t"),
        ({}, [takeoff(-1.0)], "Mission rejected: Takeoff altitude below home altitude!\t"),
        ({}, [waypoint(5, 0, 5), takeoff(5.0)], "Mission rejected: takeoff not first waypoint item\t"),
        ({}, [takeoff(5.0), item(84, (0, 0, 5))], "Mission rejected: takeoff not first waypoint item\t"),
        (
            {},
            [takeoff(5.0), item(85, (0, 0, 5))],
            "Mission rejected: Mission contains VTOL items but vehicle is not a VTOL\t",
        ),
        ({"MIS_TKO_LAND_REQ": 1}, [waypoint(5, 0, 5)], "Mission rejected: Takeoff waypoint required.\t"),
        ({"MIS_TKO_LAND_REQ": 2}, [takeoff(5.0)], "Mission rejected: Landing waypoint/pattern required.\t"),
        ({"MIS_TKO_LAND_REQ": 3}, [takeoff(5.0)], "Mission rejected: Takeoff or Landing item missing.\t"),
        ({"MIS_TKO_LAND_REQ": 4}, [takeoff(5.0)], "Mission rejected: Add Landing item or remove Takeoff.\t"),
        (
            {"MIS_TKO_LAND_REQ": 5},
            [waypoint(5, 0, 5), land()],
            "Mission rejected: Add Takeoff item or remove Landing.\t",
        ),
        (
            {"GF_MAX_HOR_DIST": 30.0},
            [waypoint(5, 0, 5), waypoint(31, 0, 5)],
            "Geofence violation for waypoint 2\t",
        ),
    ],
)
def test_infeasible_mission_stored_but_refused(
    parameters: dict[str, float], plan: list[Any], words: str
) -> None:
    harness = SimHarness(ready_after_s=0.0, parameters=parameters)
    listen(harness)
    assert upload(harness, plan) == 0
    harness.fly(0.1)
    assert words in harness.texts()
    assert harness.command(300) == [2]
    assert harness.texts()[-1] == START_DENIED
    assert status(harness)[2] == 1


def test_a_far_first_waypoint_is_only_warned_of() -> None:
    harness = SimHarness(ready_after_s=0.0, parameters={"MIS_DIST_1WP": 100.0})
    listen(harness)
    upload(harness, [waypoint(150.5, 0, 5)])
    harness.fly(0.1)
    assert FIRST_WAYPOINT_FAR in harness.texts()
    assert harness.vehicle.autopilot.navigator.mission.valid


def test_later_fence_invalidates_mission(harness: SimHarness) -> None:
    upload(harness, [takeoff(5.0), waypoint(30, 0, 5)])
    assert harness.vehicle.autopilot.navigator.mission.valid
    upload(harness, [circle(0, 0, 20.0)], 1)
    harness.fly(0.3)
    assert not harness.vehicle.autopilot.navigator.mission.valid
    upload(harness, polygon([(-60, -60), (60, -60), (60, 60), (-60, 60)]), 1)
    harness.fly(0.3)
    assert harness.vehicle.autopilot.navigator.mission.valid


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
    assert words == [RALLY_FRAME_UNKNOWN]


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
def make() -> Callable[..., SimHarness]:
    """Makes vehicles that are ready at once and return low."""
    return lambda **values: SimHarness(
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


def test_rally_point_return_with_start_offset() -> None:
    harness = SimHarness(
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


def test_rtl_flies_to_missions_landing_pattern_where_that_nearer(make: Callable[..., SimHarness]) -> None:
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
