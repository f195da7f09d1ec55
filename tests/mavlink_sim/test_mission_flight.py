"""Missions flown from the ground, item by item."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import Cockpit
from tests.mavlink_sim.plan_client import (
    NAN,
    RETURN,
    circle,
    item,
    land,
    listen,
    polygon,
    reached,
    takeoff,
    upload,
    waypoint,
)

SHORT = [takeoff(4.0), waypoint(8, 0, 4), land(8, 0)]


@pytest.fixture
def cockpit(make_cockpit: type[Cockpit]) -> Cockpit:
    """A vehicle that is ready at once."""
    return make_cockpit(ready_after_s=0.0)


def away(cockpit: Cockpit, north: float, east: float) -> float:
    return math.dist(cockpit.vehicle.airframe.position[:2], (north, east))


def current(cockpit: Cockpit) -> int:
    return int(cockpit.vehicle.autopilot.navigator.mission.current)


def status(cockpit: Cockpit) -> tuple[int, int, int, int]:
    """The newest MISSION_CURRENT: sequence, total, state, mode."""
    cockpit.fly(1.1)
    told = cockpit.received("MISSION_CURRENT")[-1]
    return told.seq, told.total, told.mission_state, told.mission_mode


def test_a_mission_takes_off_flies_lands_and_disarms(cockpit: Cockpit) -> None:
    listen(cockpit)
    assert status(cockpit) == (0, 65535, 1, 2)
    assert upload(cockpit, SHORT) == 0
    assert status(cockpit) == (0, 3, 2, 2)
    assert cockpit.set_mode(4, 4) == [0, 0]
    assert cockpit.vehicle.autopilot.can_arm
    assert cockpit.command(400, 1) == [0]
    cockpit.until(lambda: cockpit.height_m > 1.0, 20.0)
    assert cockpit.vehicle.autopilot.landed_state == 3
    cockpit.until(lambda: current(cockpit) == 1, 20.0)
    assert cockpit.height_m == pytest.approx(4.0, abs=0.9)
    assert status(cockpit)[2:] == (3, 1)
    cockpit.until(lambda: not cockpit.armed, 60.0)
    assert away(cockpit, 8, 0) < 1.0
    assert reached(cockpit) == [0, 1, 2]
    assert status(cockpit)[:3] == (2, 3, 5)
    said = cockpit.texts()
    assert said[-6:] == [
        "Executing Mission\t",
        "Climb to 4.0 meters above home\t",
        "Takeoff detected\t",
        "Landing detected\t",
        "Mission finished, landed\t",
        "Disarmed by landing\t",
    ]


def test_mission_start_arms_and_begins_where_it_is_told(cockpit: Cockpit) -> None:
    assert cockpit.command(300, 0, 0) == [2]
    upload(cockpit, [takeoff(4.0), waypoint(30, 0, 4), waypoint(0, 6, 4)])
    assert cockpit.command(300, 3, 0) == [2]
    assert cockpit.command(300, 2, 0) == [0]
    assert cockpit.armed
    assert cockpit.mode == "MISSION"
    cockpit.until(lambda: cockpit.mode == "HOLD", 40.0)  # after the last item it holds there
    assert reached(cockpit) == [2]
    cockpit.fly(4.0)
    assert away(cockpit, 0, 6) < 1.0
    assert status(cockpit)[2] == 5


def test_reached_items_are_told_again_ten_times(cockpit: Cockpit) -> None:
    upload(cockpit, [takeoff(4.0), item(17, (0, 0, 4), 0, 0, 0, NAN)])
    cockpit.command(300)
    cockpit.until(lambda: current(cockpit) == 1, 30.0)
    cockpit.fly(13.0)
    assert [m.seq for m in cockpit.received("MISSION_ITEM_REACHED")] == [0] * 11
    assert cockpit.mode == "MISSION"  # loiter without end


def test_a_waypoint_is_held_for_its_time_and_heading(cockpit: Cockpit) -> None:
    upload(cockpit, [takeoff(3.0), waypoint(5, 0, 3, 3.0, 1.0, 0.0, 90.0), waypoint(5, 5, 3)])
    cockpit.command(300)
    cockpit.until(lambda: away(cockpit, 5, 0) < 1.0, 30.0)
    waited = cockpit.until(lambda: current(cockpit) == 2, 20.0)
    assert waited >= 3.0
    assert math.degrees(cockpit.vehicle.airframe.yaw_rad) == pytest.approx(90.0, abs=12.0)


def test_delay_and_speed_and_jump_items_do_what_they_say(cockpit: Cockpit) -> None:
    upload(
        cockpit,
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
    cockpit.command(300)
    cockpit.until(lambda: current(cockpit) == 1, 30.0)
    assert 1.9 <= cockpit.until(lambda: current(cockpit) == 3, 10.0) <= 2.4
    fastest = 0.0

    def returning() -> bool:
        nonlocal fastest
        fastest = max(fastest, math.hypot(*cockpit.vehicle.airframe.velocity[:2]))
        return bool(cockpit.mode == "RTL")

    cockpit.until(returning, 60.0)
    assert 0.7 < fastest < 1.4
    assert reached(cockpit) == [0, 1, 2, 3, 4, 3, 4, 6, 7]
    assert status(cockpit)[2:] == (5, 2)  # complete, though the vehicle is still on its way


def test_a_mission_that_ends_in_a_return_holds_for_a_moment(cockpit: Cockpit) -> None:
    upload(cockpit, [takeoff(3.0), waypoint(4, 0, 3), RETURN])
    cockpit.command(300)
    cockpit.until(lambda: cockpit.mode == "HOLD", 30.0)
    assert 0.03 <= cockpit.until(lambda: cockpit.mode == "RTL", 1.0) <= 0.07
    cockpit.until(lambda: not cockpit.armed, 60.0)
    assert cockpit.mode == "HOLD"
    changes = [line for line in cockpit.events if line.startswith("mode ")]
    assert changes == ["mode MISSION", "mode HOLD", "mode RTL", "mode HOLD"]


def test_a_pause_keeps_the_place_in_the_mission(cockpit: Cockpit) -> None:
    upload(cockpit, [takeoff(4.0), waypoint(12, 0, 4), waypoint(12, 8, 4)])
    cockpit.command(300)
    cockpit.until(lambda: cockpit.vehicle.airframe.position[0] > 4.0, 30.0)
    assert cockpit.set_mode(4, 3) == [0, 0]
    cockpit.fly(4.0)
    assert status(cockpit) == (1, 3, 4, 2)  # paused
    stayed = cockpit.vehicle.airframe.position[0]
    cockpit.fly(2.0)
    assert cockpit.vehicle.airframe.position[0] == pytest.approx(stayed, abs=0.5)
    cockpit.forget()
    assert cockpit.set_mode(4, 4) == [0, 0]
    assert status(cockpit) == (1, 3, 3, 1)
    cockpit.until(lambda: cockpit.mode == "HOLD", 40.0)
    assert reached(cockpit) == [1, 2]


def test_a_waypoint_on_the_way_is_passed_without_stopping(cockpit: Cockpit) -> None:
    upload(cockpit, [takeoff(4.0), waypoint(15, 0, 4), waypoint(30, 0, 4)])
    cockpit.command(300)
    cockpit.until(lambda: current(cockpit) == 2, 40.0)
    assert cockpit.vehicle.airframe.velocity[0] > 2.0
    slowest = math.inf

    def beyond() -> bool:
        nonlocal slowest
        slowest = min(slowest, cockpit.vehicle.airframe.velocity[0])
        return bool(cockpit.vehicle.airframe.position[0] > 20.0)

    cockpit.until(beyond, 20.0)
    assert slowest > 2.0


def test_camera_commands_are_sent_to_the_camera(cockpit: Cockpit) -> None:
    upload(
        cockpit,
        [
            takeoff(3.0),
            item(2000, None, 0, 1.0, 0),
            item(2000, None, 0, 0, 1),
            item(2001, None, 101),
            item(203, None, 0, 0, 0, 0, 1),
            waypoint(0, 0, 3),
        ],
    )
    cockpit.command(300)
    cockpit.until(lambda: cockpit.mode == "HOLD", 40.0)
    sent = [(m.command, m.target_component) for m in cockpit.received("COMMAND_LONG")]
    # one single shot goes to the vehicle's own trigger, as DO_DIGICAM_CONTROL
    assert sent == [(2000, 100), (203, 100), (2001, 101), (203, 0)]


def test_a_mission_uploaded_while_flying_one_is_flown_at_once(cockpit: Cockpit) -> None:
    upload(cockpit, [takeoff(4.0), waypoint(60, 0, 4)])
    cockpit.command(300)
    cockpit.until(lambda: cockpit.vehicle.airframe.position[0] > 3.0, 30.0)
    upload(cockpit, [waypoint(3, 8, 4), waypoint(0, 8, 4)])
    cockpit.until(lambda: cockpit.mode == "HOLD", 40.0)
    assert away(cockpit, 0, 8) < 3.0


def test_clearing_the_mission_in_flight_ends_in_hold(cockpit: Cockpit) -> None:
    upload(cockpit, [takeoff(4.0), waypoint(60, 0, 4)])
    cockpit.command(300)
    cockpit.until(lambda: cockpit.vehicle.airframe.position[0] > 3.0, 30.0)
    cockpit.send(dialect.MAVLink_mission_clear_all_message(1, 1, 0))
    cockpit.fly(1.0)
    assert cockpit.mode == "HOLD"
    assert cockpit.set_mode(4, 4) == [0, 1]


def test_a_finished_mission_begins_again_after_disarming(cockpit: Cockpit) -> None:
    upload(cockpit, [takeoff(2.5), land()])
    cockpit.command(300)
    cockpit.until(lambda: not cockpit.armed, 60.0)
    assert current(cockpit) == 1
    cockpit.forget()
    cockpit.set_mode(4, 4)
    assert cockpit.command(400, 1) == [0]
    cockpit.until(lambda: not cockpit.armed, 60.0)
    assert reached(cockpit)[-2:] == [0, 1]


def test_numbers_that_are_none_do_not_stop_the_vehicle(cockpit: Cockpit) -> None:
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
    assert upload(cockpit, strange) == 0
    cockpit.command(300)
    cockpit.until(lambda: cockpit.mode == "HOLD", 60.0)
    assert all(map(math.isfinite, cockpit.vehicle.airframe.position))


def test_an_empty_mission_cannot_be_flown_or_armed_in(cockpit: Cockpit) -> None:
    assert cockpit.set_mode(4, 4) == [0, 0]  # on the ground any mode may be chosen
    assert not cockpit.vehicle.autopilot.can_arm
    assert cockpit.command(400, 1) == [1]


@pytest.mark.parametrize(
    ("parameters", "plan", "words"),
    [
        ({}, [takeoff(5.0), item(112, None, 3)], "Mission rejected: item 2: unsupported cmd: 112\t"),
        ({}, [land()], "Mission rejected: starts with landing\t"),
        ({}, [takeoff(-1.0)], "Mission rejected: Takeoff altitude below home altitude!\t"),
        ({}, [waypoint(5, 0, 5), takeoff(5.0)], "Mission rejected: takeoff not first waypoint item\t"),
        (
            {},
            [takeoff(5.0), item(84, (0, 0, 5))],
            "Mission rejected: takeoff not first waypoint item\t",
        ),
        (
            {},
            [takeoff(5.0), item(85, (0, 0, 5))],
            "Mission rejected: Mission contains VTOL items but vehicle is not a VTOL\t",
        ),
        (
            {"MIS_TKO_LAND_REQ": 1},
            [waypoint(5, 0, 5)],
            "Mission rejected: Takeoff waypoint required.\t",
        ),
        (
            {"MIS_TKO_LAND_REQ": 2},
            [takeoff(5.0)],
            "Mission rejected: Landing waypoint/pattern required.\t",
        ),
        ({"MIS_TKO_LAND_REQ": 3}, [takeoff(5.0)], "Mission rejected: Takeoff or Landing item missing.\t"),
        (
            {"MIS_TKO_LAND_REQ": 4},
            [takeoff(5.0)],
            "Mission rejected: Add Landing item or remove Takeoff.\t",
        ),
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
def test_a_mission_that_cannot_be_flown_is_stored_but_refused(
    make_cockpit: type[Cockpit], parameters: dict[str, float], plan: list[Any], words: str
) -> None:
    cockpit = make_cockpit(ready_after_s=0.0, parameters=parameters)
    listen(cockpit)
    assert upload(cockpit, plan) == 0
    cockpit.fly(0.1)
    assert words in cockpit.texts()
    assert cockpit.command(300) == [2]
    assert cockpit.texts()[-1] == "Mission start denied! No valid mission\t"
    assert status(cockpit)[2] == 1


def test_a_far_first_waypoint_is_only_warned_of(make_cockpit: type[Cockpit]) -> None:
    cockpit = make_cockpit(ready_after_s=0.0, parameters={"MIS_DIST_1WP": 100.0})
    listen(cockpit)
    upload(cockpit, [waypoint(150.5, 0, 5)])
    cockpit.fly(0.1)
    assert "First waypoint far away from home: 150m. Correct mission loaded?\t" in cockpit.texts()
    assert cockpit.vehicle.autopilot.navigator.mission.valid


def test_a_fence_that_comes_later_makes_the_mission_invalid(cockpit: Cockpit) -> None:
    upload(cockpit, [takeoff(5.0), waypoint(30, 0, 5)])
    assert cockpit.vehicle.autopilot.navigator.mission.valid
    upload(cockpit, [circle(0, 0, 20.0)], 1)
    cockpit.fly(0.3)
    assert not cockpit.vehicle.autopilot.navigator.mission.valid
    upload(cockpit, polygon([(-60, -60), (60, -60), (60, 60), (-60, 60)]), 1)
    cockpit.fly(0.3)
    assert cockpit.vehicle.autopilot.navigator.mission.valid
