"""The geofence: inside and outside, rejected requests, breaches."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mavlink_sim.missions.geofence import Area, inside_polygon
from mavlink_sim.wire.announcements import event_identifier
from tests.mavlink_sim.conftest import SIH_FRAME, SimHarness, velocity_setpoint
from tests.mavlink_sim.plan_client import circle, listen, polygon, upload

FENCE = [(-20.0, -20.0), (-20.0, 20.0), (20.0, 20.0), (20.0, -20.0)]

# STATUSTEXTs of PX4.
WITHOUT_HOME = "Geofence invalid, doesn't contain Home position\t"
WITHOUT_VEHICLE = "Geofence invalid, doesn't contain current vehicle position\t"
BREACHED = "Geofence: approaching or outside geofence"
HOLD_FIRST = "Failsafe activated: entering Hold for 5 seconds\t"
REPOSITION_OUTSIDE = "Reposition is outside geofence\t"

metres = st.floats(-100.0, 100.0)
centimetres = st.integers(-10_000, 10_000)


@pytest.fixture
def harness() -> SimHarness:
    """A vehicle that is ready at once."""
    return SimHarness(ready_after_s=0.0)


# ---- geometry


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 35), st.floats(1.0, 100.0)),
        min_size=3,
        max_size=12,
        unique_by=lambda v: v[0],
    ),
    metres,
    metres,
)
def test_point_in_star_polygon_matches_opencv(
    spokes: list[tuple[int, float]], north: float, east: float
) -> None:
    corners = [
        (length * math.cos(math.radians(10 * spoke)), length * math.sin(math.radians(10 * spoke)))
        for spoke, length in sorted(spokes)
    ]
    contour = np.array(corners, dtype=np.float32)
    distance = cv2.pointPolygonTest(contour, (north, east), True)
    assume(abs(distance) > 0.01)  # on the edge both results are valid
    assert inside_polygon(corners, (north, east)) == (distance > 0)


@given(centimetres, centimetres, centimetres, centimetres, metres, metres, st.booleans())
def test_inclusion_and_exclusion_are_opposites(
    a: int, b: int, c: int, d: int, north: float, east: float, is_circle: bool
) -> None:
    corners = ((a / 100, b / 100), (c / 100, d / 100), (b / 100, d / 100))
    radius = abs(a) / 100 if is_circle else None
    inside, outside = Area(corners, True, radius), Area(corners, False, radius)
    assert inside.allows((north, east)) != outside.allows((north, east))


def test_empty_polygon_contains_no_point() -> None:
    assert not inside_polygon([], (0.0, 0.0))
    assert not inside_polygon([(0.0, 0.0), (1.0, 1.0)], (0.5, 0.5))


# ---- upload


def test_fence_without_home_is_dropped_and_reported(harness: SimHarness) -> None:
    listen(harness)
    assert upload(harness, polygon(FENCE, inclusion=False), 1) == 0
    harness.fly(0.1)
    assert harness.texts()[-1] == WITHOUT_HOME
    harness.fly(0.5)
    assert harness.vehicle.autopilot.can_arm


def test_fence_breached_at_upload_is_dropped(harness: SimHarness) -> None:
    listen(harness)
    harness.take_off(4.0)
    harness.vehicle.airframe.position = (0.0, 40.0, -4.0)
    harness.fly(0.01)  # until the estimate knows
    upload(harness, polygon(FENCE), 1)
    harness.fly(0.5)
    assert WITHOUT_VEHICLE in harness.texts()
    assert harness.mode == "HOLD"
    assert not harness.vehicle.autopilot.failsafe


# ---- arming


def test_arming_refused_outside_fence() -> None:
    harness = SimHarness(ready_after_s=0.0)
    listen(harness)
    upload(harness, [circle(0, 0, 10.0)], 1)
    harness.fly(0.3)
    assert harness.vehicle.autopilot.can_arm
    harness.vehicle.airframe.position = (15.0, 0.0, 0.0)
    harness.fly(0.3)
    assert harness.texts()[-1] == BREACHED
    assert harness.command(400, 1) == [1]
    assert harness.heartbeat().system_status == 0


def test_fence_ignored_without_action() -> None:
    harness = SimHarness(ready_after_s=0.0, parameters={"GF_ACTION": 0})
    upload(harness, [circle(0, 0, 10.0)], 1)
    harness.vehicle.airframe.position = (15.0, 0.0, 0.0)
    harness.fly(0.3)
    assert harness.vehicle.autopilot.can_arm


# ---- breaches


def fly_out(harness: SimHarness, **parameters: float) -> None:
    """Into the air, and north in OFFBOARD until the fence at 8 m is broken."""
    listen(harness)
    harness.take_off(4.0)
    upload(harness, [circle(0, 0, 8.0)], 1)
    north = velocity_setpoint(4, 0, 0)
    harness.offboard(north)
    harness.until(
        lambda: harness.vehicle.autopilot.failsafe or harness.vehicle.airframe.position[0] > 14.0, 20.0, north
    )
    harness.fly(0.3, north)


@pytest.mark.parametrize(("action", "mode"), [(1, "OFFBOARD"), (2, "HOLD"), (3, "RTL"), (5, "LAND")])
def test_breach_executes_gf_action(action: int, mode: str) -> None:
    harness = SimHarness(ready_after_s=0.0, parameters={"GF_ACTION": action, "COM_FAIL_ACT_T": 0})
    fly_out(harness)
    assert harness.mode == mode
    assert BREACHED in harness.texts()
    assert ("Failsafe activated\t" in harness.texts()) is (action != 1)
    events = [event.id for event in harness.received("EVENT")]
    assert (event_identifier("commander_failsafe_enter_generic_warn") in events) is (action == 1)
    assert event_identifier("check_gf_violation_custom_gf") in events
    assert harness.heartbeat().system_status == (4 if action == 1 else 5)
    assert any("geofence breached" in event for event in harness.events)


def test_breach_holds_before_return() -> None:
    harness = SimHarness(ready_after_s=0.0, parameters={"GF_ACTION": 3})
    fly_out(harness)
    assert harness.mode == "HOLD"
    assert HOLD_FIRST in harness.texts()
    assert harness.until(lambda: harness.mode == "RTL", 6.0) == pytest.approx(4.8, abs=0.3)


def test_offboard_does_not_resume_after_breach(harness: SimHarness) -> None:
    north = velocity_setpoint(4, 0, 0)
    fly_out(harness)
    harness.fly(3.0, north)
    assert harness.mode == "HOLD"
    assert harness.vehicle.airframe.position[0] < 16.0
    home = velocity_setpoint(-3, 0, 0)
    harness.offboard(home)  # the user may, on purpose, still outside
    harness.until(lambda: harness.vehicle.airframe.position[0] < 6.0, 10.0, home)
    assert harness.mode == "OFFBOARD"
    harness.until(lambda: harness.mode == "HOLD", 10.0, north)  # and the next breach is a new one


def test_goal_outside_fence_refused(harness: SimHarness) -> None:
    listen(harness)
    harness.take_off(4.0)
    upload(harness, [circle(0, 0, 8.0)], 1)
    latitude, longitude, altitude = SIH_FRAME.geographic((20.0, 0.0, -4.0))
    point = (round(latitude * 1e7), round(longitude * 1e7), altitude)
    assert harness.command_int(192, (-1, 1, 0, math.nan), *point) == [0]
    harness.fly(2.0)
    assert harness.texts()[-1] == REPOSITION_OUTSIDE
    assert math.hypot(*harness.vehicle.airframe.position[:2]) < 1.0


def test_termination_stops_the_motors() -> None:
    harness = SimHarness(ready_after_s=0.0, parameters={"GF_ACTION": 4})
    fly_out(harness)
    assert harness.heartbeat().system_status == 8
    harness.until(lambda: harness.vehicle.airframe.on_ground, 5.0)
    assert harness.vehicle.airframe.thrust_mps2 < 0.1
    assert harness.armed


@pytest.mark.parametrize(
    ("parameter", "setpoint", "words"),
    [
        ("GF_MAX_HOR_DIST", (4, 0, 0), "Geofence: exceeding maximum distance to Home"),
        ("GF_MAX_VER_DIST", (0, 0, -2), "Geofence: exceeding maximum altitude above Home"),
    ],
)
def test_max_distances_from_home_are_a_fence(
    parameter: str, setpoint: tuple[float, float, float], words: str
) -> None:
    harness = SimHarness(ready_after_s=0.0, parameters={parameter: 8.0})
    listen(harness)
    harness.take_off(4.0)
    away = velocity_setpoint(*setpoint)
    harness.offboard(away)
    harness.until(lambda: harness.mode == "HOLD", 20.0, away)
    harness.fly(0.1)
    assert words in harness.texts()
    assert harness.vehicle.autopilot.failsafe
