"""PX4's own failsafes, at COMPANION_SITL_URL: each is named, and none is called a pilot's."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

import pytest

from mavlink_sim.wire.messages import dialect
from tests.sitl.sitl_harness import HOLD, PX4, AutopilotLink, Flight, orbiting, repeated, set_for_test

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
RETURN_MODE = 4 << 16 | 5 << 24
JOYSTICK_HZ = 20.0


def centred_sticks(link: AutopilotLink) -> Iterator[None]:
    """Of a pilot's joystick."""
    for _ in itertools.count():
        link.send(dialect.MAVLink_manual_control_message(link.system_id, 0, 0, 500, 0, 0))
        yield


def assert_not_the_pilots(flight: Flight, since_s: float) -> None:
    """After the change of mode nothing is sent, and nothing is called a pilot's."""
    link = flight.link
    shown_s = next(at for at, _ in link.modes if at > since_s)
    link.after(3.0)
    assert not [at for at in link.setpoints_s if at > shown_s + 0.3]
    assert not [event for event in flight.events[-6:] if "pilot took" in event]


def test_a_critical_battery_is_named(flight: Flight, parameters: dict[str, float]) -> None:
    """PX4's simulated battery is full again after each landing."""
    link = flight.link
    if link.autopilot != PX4:
        pytest.skip("the simulated battery is PX4's")
    orbiting(flight)
    named, since_s = flight.said("autopilot failsafe"), time.monotonic()
    values = {"COM_LOW_BAT_ACT": 3.0, "SIM_BAT_MIN_PCT": 6.0, "SIM_BAT_DRAIN": 10.0}
    parameters |= set_for_test(link, {**values, "CBRK_SUPPLY_CHK": 0.0})  # a breaker of all battery checks
    link.until(named, 60.0, "a failsafe reported")
    ended = next(event for event in reversed(flight.events) if "autopilot failsafe" in event)
    assert "battery" in ended.lower(), ended
    link.until(lambda: link.modes[-1][1] == RETURN_MODE, 15.0, "returning")
    assert_not_the_pilots(flight, since_s)


def test_lost_sticks_are_named(flight: Flight, parameters: dict[str, float]) -> None:
    link = flight.link
    if link.autopilot != PX4:
        pytest.skip("Copter in GUIDED needs no sticks")
    with repeated(1.0 / JOYSTICK_HZ, centred_sticks(link)):
        parameters |= set_for_test(link, {"COM_RC_IN_MODE": 1.0, "COM_RCL_EXCEPT": 0.0, "NAV_RCL_ACT": 1.0})
        link.after(2.0)
        orbiting(flight)
        named = flight.said("autopilot failsafe")
    since_s = time.monotonic()
    named_s = link.until(named, 10.0, "a failsafe reported")
    ended = next(event for event in reversed(flight.events) if "autopilot failsafe" in event)
    assert "manual control" in ended.lower(), ended
    assert_not_the_pilots(flight, since_s)
    assert link.modes[-1][1] == HOLD[PX4]  # NAV_RCL_ACT 1, and our request keeps it
    flight.note("sticks lost", named_after_s=named_s)
