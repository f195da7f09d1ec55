"""The autopilot's own failsafes, at COMPANION_SITL_URL: each is named, and none is called a pilot's."""

from __future__ import annotations

import contextlib
import itertools
import signal
import time
from collections.abc import Iterator

import pytest

from mavlink_sim.wire.messages import dialect
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import (
    ARDUPILOT,
    GROUNDED_S,
    HOLD,
    NAMED_BY,
    PILOT,
    PX4,
    AutopilotLink,
    Flight,
    bring_down,
    needs_px4,
    orbiting,
    repeated,
    set_for_test,
)

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
RETURN_MODE = 4 << 16 | 5 << 24
JOYSTICK_HZ = 20.0
COPTER_RTL = 6
# FS_GCS_TIMEOUT is 5 s by default, heartbeats come once a second.
HEARTBEAT_LOST_S, NEUTRAL_US, PUSHED_US = 6.5, 1500, 1700


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
    needs_px4(link, (1, 15), NAMED_BY)
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
    needs_px4(link, (1, 15), NAMED_BY)
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


def test_a_return_at_the_geofence_is_named(flight: Flight, parameters: dict[str, float]) -> None:
    """With GF_ACTION 2 it holds: test_the_autopilots_geofence_is_named."""
    link = flight.link
    if link.autopilot != PX4:
        pytest.skip("GF_ACTION is PX4's")
    needs_px4(link, (1, 15), NAMED_BY)
    flight.take_off(5.0)
    flight.fly("hold")
    parameters |= set_for_test(link, {"GF_MAX_HOR_DIST": 15.0, "GF_ACTION": 3.0})
    since_s = time.monotonic()
    reply = flight.command("goto 40 0")
    assert not reply["success"]
    assert reply["reason"].startswith("autopilot failsafe: "), reply
    assert "fence" in reply["reason"].lower()
    named_s = time.monotonic()
    assert_not_the_pilots(flight, since_s)
    # PX4 holds for COM_FAIL_ACT_T (5 s) before it returns.
    link.until(lambda: link.modes[-1][1] == RETURN_MODE, 10.0, "returning")
    flight.note("return at the geofence", returns_after_s=link.modes[-1][0] - named_s)


def set_ground_station_id(link: AutopilotLink, system_id: int) -> dict[str, float]:
    """Set the system id whose heartbeat and sticks Copter takes; what was set."""
    name = "MAV_GCS_SYSID" if link.parameter("MAV_GCS_SYSID") is not None else "SYSID_MYGCS"
    return set_for_test(link, {name: system_id})


@pytest.mark.parametrize("gimbal", [False, True])
def test_copter_returns_when_heartbeats_of_our_system_end(
    flight: Flight, services: Services, parameters: dict[str, float], gimbal: bool
) -> None:
    """Of every component: one that goes on keeps the vehicle in GUIDED."""
    link = flight.link
    if link.autopilot != ARDUPILOT:
        pytest.skip("FS_GCS_ENABLE is ArduPilot's")
    orbiting(flight)
    parameters |= set_ground_station_id(link, link.system_id)
    link.after(2.0)  # until our heartbeat counts: the last one that did may be of an earlier test
    parameters |= set_for_test(link, {"FS_GCS_ENABLE": 1.0})
    link.after(2.0)
    assert link.offboard

    def heartbeats() -> Iterator[None]:
        kind, none = dialect.MAV_TYPE_GIMBAL, dialect.MAV_AUTOPILOT_INVALID
        heartbeat = dialect.MAVLink_heartbeat_message(kind, none, 0, 0, dialect.MAV_STATE_ACTIVE, 3)
        while True:
            if gimbal:
                link.send(heartbeat, dialect.MAV_COMP_ID_GIMBAL)
            yield

    already = len(link.texts)
    with repeated(0.5, heartbeats()):
        flight.service.signal(signal.SIGKILL)
        ended_s = time.monotonic()
        if gimbal:
            link.after(HEARTBEAT_LOST_S + 2.0)
            assert link.offboard
            ended_s = time.monotonic()
    link.until(lambda: link.modes[-1][1] == COPTER_RTL, HEARTBEAT_LOST_S, "returning")
    returned_s = link.modes[-1][0] - ended_s
    link.until(lambda: link.grounded, GROUNDED_S, "landed and disarmed")
    landed_s = time.monotonic() - ended_s
    bring_down(link)  # RTL allows no arming
    # Without a heartbeat the failsafe stays, and Copter does not arm; the simulated vehicle's ends earlier.
    services.flight(flight.driver)
    link.ready = False  # that may be of the flight; in its failsafe Copter reports that it is not ready
    link.until(
        lambda: link.ready or "GCS Failsafe Cleared" in link.texts[already:], 10.0, "without a failsafe"
    )
    of = "a gimbal beside us" if gimbal else "kill -9"
    flight.note(f"FS_GCS_ENABLE 1, {of}", returns_after_s=returned_s, disarmed_after_s=landed_s)


@pytest.mark.parametrize("ours", [False, True])
def test_copter_takes_sticks_of_the_ground_stations_id_alone(
    flight: Flight, parameters: dict[str, float], ours: bool
) -> None:
    """With our system id there, a pilot at a ground station has no sticks."""
    link = flight.link
    if link.autopilot != ARDUPILOT:
        pytest.skip("RC_CHANNELS_OVERRIDE is ArduPilot's")
    parameters |= set_ground_station_id(link, link.system_id if ours else PILOT[0])
    channels = dialect.MAVLINK_MSG_ID_RC_CHANNELS
    link.command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, channels, 100_000)
    with contextlib.suppress(TimeoutError):
        link.until(lambda: link.sticks, 3.0, "sending RC_CHANNELS")
    if not link.sticks:
        pytest.skip("this autopilot sends RC_CHANNELS with a remote control alone")
    link.until(lambda: link.sticks[0] == NEUTRAL_US, 10.0, "neutral")

    def pushed() -> Iterator[None]:
        while True:
            rest = [0] * 7
            link.send(dialect.MAVLink_rc_channels_override_message(link.system_id, 1, PUSHED_US, *rest))
            yield

    with repeated(0.1, pushed()):
        if ours:
            link.after(3.0)
        else:
            link.until(lambda: link.sticks[0] == PUSHED_US, 5.0, "pushed")
        assert link.sticks[0] == (NEUTRAL_US if ours else PUSHED_US)
    link.until(lambda: link.sticks[0] == NEUTRAL_US, 10.0, "neutral again")
