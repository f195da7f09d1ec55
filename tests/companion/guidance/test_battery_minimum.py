"""The minimum of the battery: what it refuses, and what it ends in flight."""

from typing import Any

import pytest

from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.core import GuidanceOptions
from companion.guidance.interface import EventKind
from companion.guidance.limits.battery import BATTERY_MAX_AGE_S, BatteryAction, BatteryMinimum
from companion.vehicle.state import FlightMode, LandedState
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    Pending,
    assert_failed,
    engaged,
    hovering,
)

MINIMUM = BatteryMinimum(0.15)


def in_flight(battery: BatteryMinimum = MINIMUM, **options: Any) -> GuidanceHarness:
    return hovering(options=GuidanceOptions(battery=battery), **options)


def orbiting(battery: BatteryMinimum = MINIMUM) -> tuple[GuidanceHarness, Pending]:
    harness = in_flight(battery)
    pending = engaged(harness, "orbit")
    harness.run(0.5)
    return harness, pending


def battery_events(harness: GuidanceHarness) -> list[str]:
    return [event.message for event in harness.events if event.kind is EventKind.BATTERY]


LOW = "14%; guidance.min_battery_percent"


@pytest.mark.parametrize(
    ("command", "minimum", "charge", "reason"),
    [
        *((command, 0.15, 0.14, LOW) for command in ("hold", "orbit", "takeoff")),
        ("hold", 0.15, None, "not received"),
        # Commands that end a flight need none.
        *((command, 0.15, 0.01, "") for command in ("land", "rtl", "stop")),
        ("hold", 0.0, None, ""),
    ],
)
def test_command_that_flies_needs_the_minimum(
    command: str, minimum: float, charge: float | None, reason: str
) -> None:
    harness = in_flight(BatteryMinimum(minimum))
    if command == "takeoff":
        harness.vehicle.landed = LandedState.ON_GROUND
    harness.autopilot.battery_fraction = charge
    harness.run(0.1)
    pending = harness.command(command)
    assert pending.done() is bool(reason)
    if reason:
        assert_failed(pending.result(), reason)
        assert not harness.guidance.in_command


def test_stale_battery_state_is_refused_with_its_age() -> None:
    harness = in_flight()
    harness.autopilot.battery_alive = False
    harness.run(BATTERY_MAX_AGE_S + 1.0)
    assert_failed(harness.command("hold").result(), "stale (7 s)")


@pytest.mark.parametrize(("action", "mode"), [("rtl", FlightMode.RETURN), ("land", FlightMode.LAND)])
def test_low_battery_in_flight_brakes_and_starts_the_action(action: BatteryAction, mode: FlightMode) -> None:
    harness, future = orbiting(BatteryMinimum(0.15, action))
    harness.autopilot.battery_fraction = 0.14
    before = len(harness.autopilot.setpoints)
    harness.until(future.done, 3.0)
    assert_failed(future.result(), "guidance.min_battery_percent = 15")
    harness.until(lambda: harness.autopilot.state.mode is mode, 3.0)
    last = harness.autopilot.setpoints[before:][-1]
    assert last.velocity_ned_mps == (0.0, 0.0, 0.0)
    harness.until(lambda: not harness.guidance.in_command, 60.0)
    assert not harness.autopilot.state.armed
    harness.run()  # so that its end is logged
    low, ended = battery_events(harness)
    assert "battery at 14%" in low
    assert ended.startswith(f"{action} after ")
    assert "low battery: " in ended


def test_hold_after_low_battery_keeps_command() -> None:
    harness, future = orbiting(BatteryMinimum(0.15, "hold"))
    harness.autopilot.battery_fraction = 0.14
    harness.until(future.done, 3.0)
    harness.run(5.0)
    assert harness.guidance.phase == "offboard"
    assert isinstance(harness.guidance.behaviour, HoldBehaviour)
    assert len(battery_events(harness)) == 1


@pytest.mark.parametrize(
    ("command", "lag_s"), [("hold 0.5", 0.0), ("orbit", 1.5)], ids=["in the hold after it", "while engaging"]
)
def test_low_battery_returns_before_and_after_a_command_flies(command: str, lag_s: float) -> None:
    harness = in_flight(lag_s=lag_s)
    pending = harness.command(command)
    if lag_s:
        harness.run(0.06)
    else:
        harness.until(pending.done, 5.0)
    harness.autopilot.battery_fraction = 0.1
    harness.until(pending.done, 4.0)
    harness.until(lambda: harness.autopilot.state.mode is FlightMode.RETURN, 5.0)


def test_short_dip_of_the_charge_is_ignored() -> None:
    harness, future = orbiting()
    for _ in range(3):
        harness.autopilot.battery_fraction = 0.1
        harness.run(0.6)
        harness.autopilot.battery_fraction = 0.2
        harness.run(0.2)
    assert not future.done()


def test_stale_battery_in_flight_is_logged_once() -> None:
    harness, future = orbiting()
    harness.autopilot.battery_alive = False
    harness.run(15.0)
    assert not future.done()
    assert len(battery_events(harness)) == 1
    assert "stale" in battery_events(harness)[0]
