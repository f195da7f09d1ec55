"""How the autopilot at COMPANION_SITL_URL moves: what `docs/simulator-differences.md` compares."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Iterator

import pytest

from companion.client.drone import connect
from mavlink_sim.wire.messages import dialect
from tests.sitl.sitl_harness import STANDING_MPS, Flight, repeated

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(300), pytest.mark.realtime]
STEP_MPS, STEP_S = 3.0, 8.0


async def step_forward(endpoint: str) -> float:
    """STEP_MPS forward for STEP_S; when it began, CLOCK_MONOTONIC."""
    async with connect(endpoint) as drone, drone.steer() as steering:
        begun_s = time.monotonic()
        while time.monotonic() < begun_s + STEP_S:
            steering.send(forward=STEP_MPS)
            await asyncio.sleep(0.05)
    return begun_s


def test_a_velocity_step_and_the_stop_after_it(flight: Flight) -> None:
    link = flight.link
    flight.take_off(5.0)
    flight.fly("hold duration=3")
    begun_s = asyncio.run(step_forward(flight.service.endpoint))
    stop_s = begun_s + STEP_S
    link.until(
        lambda: link.poses[-1].time_s > stop_s and link.poses[-1].speed_mps < STANDING_MPS, 20.0, "standing"
    )
    ended = link.poses[-1]
    step = link.trajectory(begun_s, stop_s)
    highest_mps = max(pose.speed_mps for pose in step)
    assert highest_mps == pytest.approx(STEP_MPS, rel=0.25)
    places = [pose.position_ned_m for pose in link.trajectory(stop_s, ended.time_s)]
    flight.note(
        "velocity step to 3 m/s",
        after_1_s_mps=next(pose.speed_mps for pose in step if pose.time_s > begun_s + 1.0),
        after_6_s_mps=next(pose.speed_mps for pose in step if pose.time_s > begun_s + 6.0),
        highest_mps=highest_mps,
        stops_in_s=ended.time_s - stop_s,
        stops_in_m=max(math.dist(places[0], place) for place in places),
    )


def test_a_return_says_when_it_lands(flight: Flight) -> None:
    link = flight.link
    flight.take_off(6.0)
    flight.fly("goto forward=32 right=0")
    since_s = time.monotonic()
    landing_s: list[float] = []

    def watch() -> Iterator[None]:
        while True:
            if not landing_s and link.landed == dialect.MAV_LANDED_STATE_LANDING:
                landing_s.append(time.monotonic() - since_s)
            yield

    with repeated(0.05, watch()):
        flight.fly("rtl", timeout_s=200.0)
    assert link.grounded
    flight.note("return from 32 m", landing_after_s=landing_s[0], disarmed_after_s=time.monotonic() - since_s)
