"""Landing on a target: in sight, lost and missing."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SimHarness
from tests.mavlink_sim.plan_client import land, listen, takeoff, upload

TARGET = (2.0, -1.5)
FRAME_REFUSED = "Landing target: coordinate frame 12 unsupported\t"  # STATUSTEXT of PX4


@pytest.fixture
def harness() -> SimHarness:
    """A vehicle that is ready at once."""
    return SimHarness(ready_after_s=0.0)


def target(north: float, east: float, down: float = 0.0, frame: int = 1, valid: int = 1) -> Any:
    return dialect.MAVLink_landing_target_message(
        0, 0, frame, 0.0, 0.0, 0.0, 0.0, 0.0, north, east, down, [1, 0, 0, 0], 2, valid
    )


def off(harness: SimHarness) -> float:
    return math.dist(harness.vehicle.airframe.position[:2], TARGET)


def phases(harness: SimHarness) -> list[str]:
    prefix = "precision landing: "
    return [event.removeprefix(prefix) for event in harness.events if event.startswith(prefix)]


def test_the_vehicle_approaches_descends_and_lands_on_the_target(harness: SimHarness) -> None:
    harness.take_off(4.0)
    seen = target(*TARGET)
    harness.fly(0.2, seen)
    assert harness.set_mode(4, 9) == [0, 0]
    assert harness.heartbeat().custom_mode == 0x09040000
    height = harness.height_m
    harness.until(lambda: "descend" in phases(harness), 30.0, seen)
    assert harness.height_m == pytest.approx(height, abs=0.3)  # first across, then down
    assert off(harness) < 0.3
    harness.until(lambda: not harness.armed, 40.0, seen)
    assert off(harness) < 0.25
    assert phases(harness)[:2] == ["horizontal approach", "descend"]
    assert harness.mode == "HOLD"


def test_a_moving_target_is_followed_down(harness: SimHarness) -> None:
    harness.take_off(4.0)
    harness.set_mode(4, 9)
    harness.until(lambda: "descend" in phases(harness), 30.0, target(0.0, 0.0))
    harness.until(lambda: not harness.armed, 40.0, target(0.6, 0.0))
    assert harness.vehicle.airframe.position[0] == pytest.approx(0.6, abs=0.2)


def test_target_lost_high_is_searched_then_abandoned() -> None:
    harness = SimHarness(
        ready_after_s=0.0,
        parameters={"PLD_BTOUT": 1.0, "PLD_MAX_SRCH": 1, "PLD_SRCH_ALT": 7.0, "PLD_SRCH_TOUT": 4.0},
    )
    harness.take_off(5.0)
    harness.set_mode(4, 9)
    harness.until(lambda: "descend" in phases(harness), 30.0, target(0.0, 0.0))
    harness.until(lambda: "search" in phases(harness), 10.0)
    highest = 0.0

    def given_up() -> bool:
        nonlocal highest
        highest = max(highest, harness.height_m)
        return "fallback" in phases(harness)

    harness.until(given_up, 10.0)
    assert highest > 6.0
    harness.until(lambda: not harness.armed, 60.0)
    assert phases(harness) == ["horizontal approach", "descend", "start", "search", "fallback"]


def test_a_target_found_while_searching_is_landed_on() -> None:
    harness = SimHarness(ready_after_s=0.0, parameters={"PLD_SRCH_ALT": 6.0})
    harness.take_off(4.0)
    harness.set_mode(4, 9)
    harness.until(lambda: "search" in phases(harness), 10.0)
    harness.until(lambda: not harness.armed, 60.0, target(*TARGET))
    assert off(harness) < 0.25
    assert phases(harness)[:3] == ["search", "horizontal approach", "descend"]


def test_target_lost_low_lands_without_it() -> None:
    harness = SimHarness(ready_after_s=0.0, parameters={"PLD_FAPPR_ALT": 1.0})
    harness.take_off(3.0)
    harness.set_mode(4, 9)
    harness.until(lambda: harness.height_m < 0.8, 40.0, target(0.5, 0.5))
    harness.until(lambda: not harness.armed, 20.0)
    assert phases(harness) == ["horizontal approach", "descend", "final approach"]


@pytest.mark.parametrize("precision", [1, 2], ids=["opportunistic", "required"])
def test_a_mission_lands_on_the_target_it_sees(harness: SimHarness, precision: int) -> None:
    upload(harness, [takeoff(3.0), land(1.0, 0.0, precision)])
    harness.command(300)
    harness.until(lambda: not harness.armed, 90.0, target(*TARGET))
    assert off(harness) < 0.25
    assert harness.vehicle.autopilot.navigator.mission.finished


def test_an_opportunistic_landing_without_a_target_lands_at_once(harness: SimHarness) -> None:
    upload(harness, [takeoff(3.0), land(1.0, 0.0, 1)])
    harness.command(300)
    harness.until(lambda: not harness.armed, 60.0)
    assert phases(harness) == ["fallback"]


def test_rtl_lands_on_target_if_enabled() -> None:
    harness = SimHarness(ready_after_s=0.0, parameters={"RTL_PLD_MD": 1})
    harness.take_off(4.0)
    seen = target(1.0, 1.0)
    harness.fly(0.2, seen)
    harness.command(20)
    harness.until(lambda: not harness.armed, 60.0, seen)
    assert math.dist(harness.vehicle.airframe.position[:2], (1.0, 1.0)) < 0.25


def test_target_frame_refused_and_angles_ignored(harness: SimHarness) -> None:
    listen(harness)
    harness.send(target(1, 1, frame=12))
    harness.send(target(1, 1, valid=0))
    harness.send(target(math.nan, 1))
    harness.fly(0.1)
    assert harness.texts()[-1] == FRAME_REFUSED
    assert harness.vehicle.autopilot.navigator.target is None
