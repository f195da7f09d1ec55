"""Another commander of the autopilot at COMPANION_SITL_URL, without a change of mode: our command ends."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator

import pytest

from mavlink_sim.wire.messages import dialect
from tests.sitl.sitl_harness import (
    ARDUPILOT,
    PX4,
    AutopilotLink,
    Flight,
    Pose,
    repeated,
    set_for_test,
)

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(300), pytest.mark.realtime]
FOREIGN_HZ = 100.0
# The slowest accepted rule of companion/guidance/limits/setpoint_monitor.py takes 6 s.
ENDED_WITHIN_S = 12.0
ONLY_VELOCITY, ONLY_POSITION = 0b0000_1101_1100_0111, 0b0000_1101_1111_1000


def setpoints(link: AutopilotLink, kind: str, start: Pose) -> Iterator[None]:
    """Of another program: 3 m/s to the north, or the point 20 m north of `start`."""
    north, east, down = start.position_ned_m
    for _ in itertools.count():
        mask, place = (
            (ONLY_VELOCITY, (0.0, 0.0, 0.0))
            if kind == "velocity"
            else (
                ONLY_POSITION,
                (north + 20.0, east, down),
            )
        )
        link.send(
            dialect.MAVLink_set_position_target_local_ned_message(
                *(0, link.system_id, 1, dialect.MAV_FRAME_LOCAL_NED, mask),
                *place,
                *(3.0, 0.0, 0.0),
                *(0.0, 0.0, 0.0, 0.0, 0.0),
            )
        )
        yield


@pytest.mark.parametrize("ours", ["hold", "orbit radius=10 speed=2"])
@pytest.mark.parametrize("kind", ["velocity", "position"])
def test_setpoints_of_another_program_end_the_command(flight: Flight, kind: str, ours: str) -> None:
    link = flight.link
    flight.take_off(5.0)
    flight.fly(ours)
    link.after(8.0)
    ended = flight.said("does not follow")
    start, since_s = link.poses[-1], time.monotonic()
    with repeated(1.0 / FOREIGN_HZ, setpoints(link, kind, start)):
        ended_s = link.until(ended, ENDED_WITHIN_S, "reported as not following")
        moved_m = math.dist(link.poses[-1].position_ned_m, start.position_ned_m)
    silent_from_s = since_s + ended_s + 0.3
    link.after(2.0)
    assert not [at for at in link.setpoints_s if at > silent_from_s]
    flight.note(
        f"{kind} setpoints of another program, {ours.partition(' ')[0]}",
        ended_after_s=ended_s,
        moved_m=moved_m,
    )


# Until a setpoint of another program was in three reports; of one that sends 2 a second every 80th report.
# Longer while each comes just before one of ours, which then replaces it before it is followed.
NOTICED_WITHIN_S = {2.0: 240.0, 10.0: 120.0, 50.0: 12.0}
BESIDE = "setpoints beside ours"


@pytest.mark.parametrize("rate_hz", NOTICED_WITHIN_S)
def test_setpoints_beside_ours_are_noticed(flight: Flight, rate_hz: float) -> None:
    link = flight.link
    if rate_hz == 2.0 and link.autopilot == ARDUPILOT:
        pytest.skip("Copter reports a setpoint that it follows for 20 ms too seldom")
    flight.take_off(5.0)
    flight.fly("hold")
    link.after(4.0)
    named = flight.said(BESIDE)
    start = link.poses[-1]
    north, east, down = start.position_ned_m
    with repeated(
        1.0 / rate_hz, setpoints(link, "position", Pose(0.0, (north - 20.0, east, down), (0, 0, 0), 0.0))
    ):
        noticed_s = link.until(named, NOTICED_WITHIN_S[rate_hz], "named as another commander")
        link.until(
            lambda: any(one["identity"] == BESIDE for one in flight.status["vehicle"]["other_commanders"]),
            3.0,
            "in the status",
        )
    flight.note(f"setpoints of another program at {rate_hz:g} Hz", noticed_after_s=noticed_s)
    flight.command("stop")
    link.until(lambda: not flight.status["vehicle"]["other_commanders"], 8.0, "alone again")


def test_a_flight_alone_names_no_other_commander(flight: Flight) -> None:
    link = flight.link
    named = flight.said("another service commands this vehicle")
    since_s = time.monotonic()
    flight.take_off(5.0)
    for command in (
        "hold duration=5",
        "goto forward=10 right=5 altitude=6 speed=4",
        "orbit radius=6 speed=2 laps=1",
        "follow-path 0,0 10,0,8 10,10,4 speed=3",
        "figure-eight radius=5",
        "goto forward=0 right=0 altitude=4",
    ):
        flight.fly(command, 180.0)
        assert not named(), flight.events
    flight.fly("hold")
    link.after(5.0)
    flight.fly("land", 90.0)
    flight.fly("takeoff 1.5")  # PX4: by setpoints
    flight.fly("land", 90.0)
    assert not named(), flight.events
    flight.note("a flight alone", seconds=time.monotonic() - since_s)


def test_a_pause_in_a_path_ends_the_command(flight: Flight) -> None:
    link = flight.link
    if link.autopilot != ARDUPILOT:
        pytest.skip("PX4 takes no DO_PAUSE_CONTINUE in OFFBOARD")
    flight.take_off(5.0)
    home = link.poses[-1].position_ned_m
    paused_s: list[float] = []

    def pause() -> Iterator[None]:
        while True:
            if not paused_s and math.dist(link.poses[-1].position_ned_m, home) > 5.0:
                link.command(dialect.MAV_CMD_DO_PAUSE_CONTINUE, 0)
                paused_s.append(time.monotonic())
            yield

    with repeated(0.1, pause()):
        reply = flight.command("follow-path 0,0 30,0 30,30 speed=3")
    assert not reply["success"]
    assert "not follow setpoints" in reply["reason"], reply
    flight.note("paused by another in a path", ended_after_s=time.monotonic() - paused_s[0])


def test_an_orbit_across_the_autopilots_fence_ends(flight: Flight, parameters: dict[str, float]) -> None:
    """Copter stops before its fence by itself, in GUIDED; PX4 calls its failsafe."""
    link = flight.link
    if link.autopilot == PX4:
        pytest.skip("PX4's fence is test_the_autopilots_geofence_is_named")
    flight.take_off(5.0)
    values = {"FENCE_TYPE": 2.0, "FENCE_RADIUS": 15.0, "FENCE_ACTION": 4.0, "FENCE_ENABLE": 1.0}
    parameters |= set_for_test(link, {**values, "AVOID_ENABLE": 3.0})
    home = link.poses[-1].position_ned_m
    since_s = time.monotonic()
    reply = flight.command("orbit radius=10 speed=2 laps=1")
    assert not reply["success"]
    assert "not follow setpoints" in reply["reason"] or "fence" in reply["reason"].lower(), reply
    flight.note(
        "orbit across the fence of 15 m",
        ended_after_s=time.monotonic() - since_s,
        at_m=math.dist(link.poses[-1].position_ned_m[:2], home[:2]),
    )
