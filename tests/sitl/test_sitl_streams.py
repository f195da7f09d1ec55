"""What others do to the autopilot at COMPANION_SITL_URL: they stop streams, pause the vehicle, reboot it."""

from __future__ import annotations

import math
import os
import subprocess
import time

import pytest

from mavlink_sim.wire.messages import dialect
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import ARDUPILOT, READY_S, RESTART, AutopilotLink, Flight, bring_down

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
REBOOT_S, DEAF_S, SLOW_HZ = 60.0, 6.0, 2


def missing(flight: Flight) -> list[str]:
    streams: list[str] = flight.status["vehicle"]["missing_streams"]
    return streams


def stop_streams(link: AutopilotLink) -> None:
    """As another client may: all of ArduPilot's, LOCAL_POSITION_NED of PX4's."""
    if link.autopilot == ARDUPILOT:
        link.send(dialect.MAVLink_request_data_stream_message(link.system_id, 1, 0, 0, 0))
    else:
        link.command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 32, -1)


def test_streams_come_after_an_uplink_that_was_deaf_at_the_start(
    link: AutopilotLink, driver: str, services: Services
) -> None:
    bring_down(link)
    services.close()
    stop_streams(link)
    link.until(lambda: not link.trajectory(time.monotonic() - 1.0), 10.0, "without positions")
    link.uplink_deaf, started_s = True, time.monotonic()
    try:
        flight = services.flight(driver)
        process = flight.service.process
        link.until(lambda: flight.status and "LOCAL_POSITION_NED" in missing(flight), DEAF_S, "missing")
        link.after(started_s + DEAF_S - time.monotonic())
        assert any(at >= started_s for at, _ in link.commands)
        assert not link.trajectory(started_s)
    finally:
        link.uplink_deaf = False
    took_s = link.until(lambda: not missing(flight), 30.0, "complete")
    assert flight.service.process is process
    assert process.poll() is None
    flight.note("uplink deaf at the start", complete_after_s=took_s)


def test_streams_that_somebody_stops_are_asked_for_again(flight: Flight) -> None:
    link = flight.link
    link.until(lambda: flight.status and not missing(flight), 30.0, "all streams")
    stop_streams(link)
    link.until(lambda: "LOCAL_POSITION_NED" in missing(flight), 15.0, "reported as missing")
    took_s = link.until(lambda: not missing(flight), 30.0, "complete again")
    flight.note("streams stopped by another", complete_after_s=took_s)


def test_streams_that_another_station_slows_are_asked_for_again(flight: Flight) -> None:
    link = flight.link
    if link.autopilot != ARDUPILOT:
        pytest.skip("PX4 takes no REQUEST_DATA_STREAM")
    link.until(lambda: flight.status and not missing(flight), 30.0, "all streams")
    link.send(dialect.MAVLink_request_data_stream_message(link.system_id, 1, 0, SLOW_HZ, 1))
    link.until(lambda: "LOCAL_POSITION_NED" in missing(flight), 15.0, "reported as missing")
    took_s = link.until(lambda: not missing(flight), 30.0, "complete again")
    since_s = time.monotonic()
    link.after(3.0)
    rate_hz = len(link.trajectory(since_s)) / 3.0
    assert rate_hz > 0.8 * 30.0  # what the service asks for
    flight.note("streams slowed by another", complete_after_s=took_s, positions_hz=rate_hz)


def test_a_vehicle_that_is_paused_ends_the_command(flight: Flight) -> None:
    link = flight.link
    if link.autopilot != ARDUPILOT:
        pytest.skip("PX4 takes no DO_PAUSE_CONTINUE in OFFBOARD")
    flight.take_off(5.0)
    flight.fly("orbit radius=10 speed=2.5")
    link.until(lambda: link.poses[-1].speed_mps > 2.0, 20.0, "at speed")
    ended = flight.said("does not follow")
    link.command(dialect.MAV_CMD_DO_PAUSE_CONTINUE, 0)
    ended_s = link.until(ended, 10.0, "reported as not following")
    since_s = time.monotonic()
    link.command(dialect.MAV_CMD_DO_PAUSE_CONTINUE, 1)
    link.after(3.0)
    assert not [at for at in link.setpoints_s if at > since_s]
    flight.note("paused by another", ended_after_s=ended_s)


def test_a_reboot_on_the_ground_needs_no_new_service(flight: Flight) -> None:
    link = flight.link
    flight.take_off(2.0)
    flight.fly("land")
    boots, since_s = link.boots, time.monotonic()
    reboot = dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
    if restart := os.environ.get(RESTART):
        subprocess.run(restart, shell=True, check=True)
    else:
        link.results.pop(reboot, None)
        link.command(reboot, 1)
        link.until(lambda: reboot in link.results or link.boots > boots, 5.0, "answered")
        if link.results.get(reboot, 0) != dialect.MAV_RESULT_ACCEPTED:
            pytest.skip(f"this autopilot refuses to reboot, and {RESTART} has no command for it")
    link.until(lambda: link.boots > boots, REBOOT_S, "restarted")
    back_s = time.monotonic() - since_s
    link.until(lambda: link.ready, READY_S, "ready to be armed")
    flight.take_off(2.0)
    assert math.isclose(link.height_m, 2.0, abs_tol=0.6)
    flight.fly("land")
    flight.note("reboot", positions_after_s=back_s)
