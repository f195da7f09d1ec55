"""MAVSDK's offboard and action plugins fly global positions, orbits and go-tos over UDP."""

import asyncio
import math
from typing import Any

import pytest
from mavsdk.asyncio import ComponentType
from mavsdk.asyncio.plugins.action import ActionAsync, OrbitYawBehavior
from mavsdk.asyncio.plugins.offboard import OffboardAsync, PositionGlobalYaw
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

from mavlink_sim.physics.geography import HOME_ALTITUDE_M
from mavlink_sim.testing import QUICK_FLIGHT, RunningSimulator
from tests.mavlink_sim.conftest import SIH_FRAME
from tests.mavlink_sim.mavsdk_client import mavsdk_client, wait_for

# In `make test`, test_client_mavsdk.py flies velocities and local positions, lockstep tests every setpoint.
pytestmark = [pytest.mark.realtime, pytest.mark.slow]

SPEED = 3.0  # simulated seconds a second; MAVSDK repeats a setpoint 20 times a real second


def distance_m(update: Any, north: float, east: float) -> float:
    return math.hypot(update.position.north_m - north, update.position.east_m - east)


@pytest.mark.vehicle(speed=SPEED, px4="1.15", parameters=QUICK_FLIGHT)
async def test_mavsdk_flies_global_setpoints_orbits_and_goto(vehicle: RunningSimulator) -> None:
    async with mavsdk_client(vehicle.mavsdk_url, ComponentType.COMPANION_COMPUTER) as system:
        action, telemetry = system.plugin(ActionAsync), system.plugin(TelemetryAsync)
        offboard = system.plugin(OffboardAsync)
        await wait_for(telemetry.subscribe_health(), lambda health: health.is_armable)
        await action.set_takeoff_altitude(8.0)
        await action.arm()
        await action.takeoff()
        await wait_for(telemetry.subscribe_flight_mode(), lambda mode: mode.name == "HOLD")

        # a global position, relative to home
        latitude, longitude, _ = SIH_FRAME.geographic((-6.0, 4.0, 0.0))
        relative = PositionGlobalYaw.AltitudeType.REL_HOME
        await offboard.set_position_global(PositionGlobalYaw(latitude, longitude, 10.0, 90.0, relative))
        await offboard.start()
        await wait_for(
            telemetry.subscribe_position_velocity_ned(),
            lambda now: distance_m(now, -6.0, 4.0) < 0.6 and abs(now.position.down_m + 10.0) < 0.6,
        )
        await wait_for(telemetry.subscribe_heading(), lambda heading: abs(heading.heading_deg - 90) < 5)

        # an orbit
        centre = SIH_FRAME.geographic((4.0, 4.0, 0.0))
        await action.do_orbit(
            6.0,
            2.0,
            OrbitYawBehavior.HOLD_FRONT_TO_CIRCLE_CENTER,
            centre[0],
            centre[1],
            HOME_ALTITUDE_M + 9.0,
        )
        await asyncio.to_thread(vehicle.wait_for_event, "mode ORBIT")
        await wait_for(
            telemetry.subscribe_position_velocity_ned(),
            lambda now: now.position.north_m > 8.0 and abs(distance_m(now, 4.0, 4.0) - 6.0) < 1.0,
        )

        # and straight to another
        goal = SIH_FRAME.geographic((0.0, -8.0, 0.0))
        await action.set_current_speed(3.0)
        await action.goto_location(goal[0], goal[1], HOME_ALTITUDE_M + 7.0, 0.0)
        reached = await wait_for(
            telemetry.subscribe_position(),
            lambda position: (
                math.dist(
                    SIH_FRAME.local(
                        position.latitude_deg, position.longitude_deg, position.absolute_altitude_m
                    ),
                    (0.0, -8.0, -7.0),
                )
                < 0.7
            ),
        )
        assert reached.relative_altitude_m == pytest.approx(7.0, abs=0.8)
        await wait_for(telemetry.subscribe_flight_mode(), lambda mode: mode.name == "HOLD")
    modes = [event for event in vehicle.events if event.startswith("mode ")]
    assert modes == ["mode TAKEOFF", "mode HOLD", "mode OFFBOARD", "mode ORBIT", "mode HOLD"]
