"""Landing on a target: seen, lost and never there."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import Cockpit
from tests.mavlink_sim.plan_client import land, listen, takeoff, upload

TARGET = (2.0, -1.5)


@pytest.fixture
def cockpit(make_cockpit: type[Cockpit]) -> Cockpit:
    """A vehicle that is ready at once."""
    return make_cockpit(ready_after_s=0.0)


def target(north: float, east: float, down: float = 0.0, frame: int = 1, valid: int = 1) -> Any:
    return dialect.MAVLink_landing_target_message(
        0, 0, frame, 0.0, 0.0, 0.0, 0.0, 0.0, north, east, down, [1, 0, 0, 0], 2, valid
    )


def off(cockpit: Cockpit) -> float:
    return math.dist(cockpit.vehicle.airframe.position[:2], TARGET)


def phases(cockpit: Cockpit) -> list[str]:
    prefix = "precision landing: "
    return [event.removeprefix(prefix) for event in cockpit.events if event.startswith(prefix)]


def test_the_vehicle_approaches_descends_and_lands_on_the_target(cockpit: Cockpit) -> None:
    cockpit.take_off(4.0)
    seen = target(*TARGET)
    cockpit.fly(0.2, seen)
    assert cockpit.set_mode(4, 9) == [0, 0]
    assert cockpit.heartbeat().custom_mode == 0x09040000
    height = cockpit.height_m
    cockpit.until(lambda: "descend" in phases(cockpit), 30.0, seen)
    assert cockpit.height_m == pytest.approx(height, abs=0.3)  # first across, then down
    assert off(cockpit) < 0.3
    cockpit.until(lambda: not cockpit.armed, 40.0, seen)
    assert off(cockpit) < 0.25
    assert phases(cockpit)[:2] == ["horizontal approach", "descend"]
    assert cockpit.mode == "HOLD"


def test_a_moving_target_is_followed_down(cockpit: Cockpit) -> None:
    cockpit.take_off(4.0)
    cockpit.set_mode(4, 9)
    cockpit.until(lambda: "descend" in phases(cockpit), 30.0, target(0.0, 0.0))
    cockpit.until(lambda: not cockpit.armed, 40.0, target(0.6, 0.0))
    assert cockpit.vehicle.airframe.position[0] == pytest.approx(0.6, abs=0.2)


def test_a_target_lost_high_up_is_searched_for_and_then_given_up(make_cockpit: type[Cockpit]) -> None:
    cockpit = make_cockpit(
        ready_after_s=0.0,
        parameters={"PLD_BTOUT": 1.0, "PLD_MAX_SRCH": 1, "PLD_SRCH_ALT": 7.0, "PLD_SRCH_TOUT": 4.0},
    )
    cockpit.take_off(5.0)
    cockpit.set_mode(4, 9)
    cockpit.until(lambda: "descend" in phases(cockpit), 30.0, target(0.0, 0.0))
    cockpit.until(lambda: "search" in phases(cockpit), 10.0)
    highest = 0.0

    def given_up() -> bool:
        nonlocal highest
        highest = max(highest, cockpit.height_m)
        return "fallback" in phases(cockpit)

    cockpit.until(given_up, 10.0)
    assert highest > 6.0
    cockpit.until(lambda: not cockpit.armed, 60.0)
    assert phases(cockpit) == ["horizontal approach", "descend", "start", "search", "fallback"]


def test_a_target_found_while_searching_is_landed_on(make_cockpit: type[Cockpit]) -> None:
    cockpit = make_cockpit(ready_after_s=0.0, parameters={"PLD_SRCH_ALT": 6.0})
    cockpit.take_off(4.0)
    cockpit.set_mode(4, 9)
    cockpit.until(lambda: "search" in phases(cockpit), 10.0)
    cockpit.until(lambda: not cockpit.armed, 60.0, target(*TARGET))
    assert off(cockpit) < 0.25
    assert phases(cockpit)[:3] == ["search", "horizontal approach", "descend"]


def test_a_target_lost_low_down_is_landed_on_blindly(make_cockpit: type[Cockpit]) -> None:
    cockpit = make_cockpit(ready_after_s=0.0, parameters={"PLD_FAPPR_ALT": 1.0})
    cockpit.take_off(3.0)
    cockpit.set_mode(4, 9)
    cockpit.until(lambda: cockpit.height_m < 0.8, 40.0, target(0.5, 0.5))
    cockpit.until(lambda: not cockpit.armed, 20.0)
    assert phases(cockpit) == ["horizontal approach", "descend", "final approach"]


@pytest.mark.parametrize("precision", [1, 2], ids=["opportunistic", "required"])
def test_a_mission_lands_on_the_target_it_sees(cockpit: Cockpit, precision: int) -> None:
    upload(cockpit, [takeoff(3.0), land(1.0, 0.0, precision)])
    cockpit.command(300)
    cockpit.until(lambda: not cockpit.armed, 90.0, target(*TARGET))
    assert off(cockpit) < 0.25
    assert cockpit.vehicle.autopilot.navigator.mission.finished


def test_an_opportunistic_landing_without_a_target_lands_at_once(cockpit: Cockpit) -> None:
    upload(cockpit, [takeoff(3.0), land(1.0, 0.0, 1)])
    cockpit.command(300)
    cockpit.until(lambda: not cockpit.armed, 60.0)
    assert phases(cockpit) == ["fallback"]


def test_rtl_lands_on_the_target_if_told_so(make_cockpit: type[Cockpit]) -> None:
    cockpit = make_cockpit(ready_after_s=0.0, parameters={"RTL_PLD_MD": 1})
    cockpit.take_off(4.0)
    seen = target(1.0, 1.0)
    cockpit.fly(0.2, seen)
    cockpit.command(20)
    cockpit.until(lambda: not cockpit.armed, 60.0, seen)
    assert math.dist(cockpit.vehicle.airframe.position[:2], (1.0, 1.0)) < 0.25


def test_a_target_in_another_frame_is_refused_and_one_given_as_angles_passed_over(cockpit: Cockpit) -> None:
    listen(cockpit)
    cockpit.send(target(1, 1, frame=12))
    cockpit.send(target(1, 1, valid=0))
    cockpit.send(target(math.nan, 1))
    cockpit.fly(0.1)
    assert cockpit.texts()[-1] == "Landing target: coordinate frame 12 unsupported\t"
    assert cockpit.vehicle.autopilot.navigator.target is None
