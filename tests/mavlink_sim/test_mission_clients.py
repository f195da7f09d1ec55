"""Missions, fences and rally points by MAVSDK over UDP."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import aclosing, asynccontextmanager
from typing import Any

import pytest
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.geofence import GeofenceAsync
from mavsdk.asyncio.plugins.mission import MissionAsync
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync, VelocityNedYaw
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.geofence.geofence import Circle, FenceType, GeofenceData, Point, Polygon
from mavsdk.plugins.mission.mission import MissionItem, MissionPlan
from mavsdk.plugins.mission_raw.mission_raw import MissionItem as RawItem
from mavsdk.plugins.mission_raw.mission_raw import MissionRawError, MissionRawResult

from mavlink_sim.testing import QUICK_FLIGHT, RunningSimulator, vehicle
from tests.mavlink_sim.conftest import SIH_FRAME
from tests.mavlink_sim.mavsdk_client import LIMIT_S, MavsdkClient, mavsdk_client, meanwhile, wait_for
from tests.mavlink_sim.plan_client import item, land, polygon, rally, takeoff, waypoint

pytestmark = pytest.mark.realtime

SPEED = 6.0


@asynccontextmanager
async def mavsdk_flight(
    speed: float = 1.0, of_ground_station: bool = False
) -> AsyncIterator[tuple[RunningSimulator, MavsdkClient]]:
    """A vehicle in its process and MAVSDK's view of it, ready to arm, on the onboard link or the other."""
    async with vehicle(speed=speed, parameters={**QUICK_FLIGHT, "RTL_RETURN_ALT": 5.0}) as simulator:
        port = simulator.gcs_port if of_ground_station else simulator.onboard_port
        async with mavsdk_client(f"udpin://127.0.0.1:{port}") as system:
            await wait_for(system.plugin(TelemetryAsync).subscribe_health(), lambda health: health.is_armable)
            yield simulator, system


def position(north: float, east: float) -> tuple[float, float]:
    latitude, longitude, _ = SIH_FRAME.geographic((north, east, 0.0))
    return latitude, longitude


def mission_item(north: float, east: float, **options: Any) -> MissionItem:
    latitude, longitude = position(north, east)
    return MissionItem(latitude, longitude, 4.0, is_fly_through=True, acceptance_radius_m=1.0, **options)


async def uploaded(upload: Callable[[list[RawItem]], Awaitable[None]], items: list[RawItem]) -> None:
    """Upload a plan, more than once if need be.

    On a busy machine an answer may arrive after the vehicle repeated its request (250 ms); the second answer
    then arrives during the next upload, and PX4 treats it as an error.
    """
    for attempt in range(4):
        try:
            await upload(items)
        except MissionRawError as error:
            if attempt == 3 or error.result is not MissionRawResult.PROTOCOL_ERROR:
                raise
        else:
            return


def raw(items: list[dict[str, Any]]) -> list[RawItem]:
    """Items for the plugin mission_raw."""
    return [RawItem(seq=index, current=int(index == 0), **fields) for index, fields in enumerate(items)]


async def test_mavsdk_uploads_starts_pauses_and_finishes_a_mission() -> None:
    async with mavsdk_flight(SPEED) as (simulator, system):
        mission = system.plugin(MissionAsync)
        action = system.plugin(ActionAsync)
        telemetry = system.plugin(TelemetryAsync)
        plan = MissionPlan(
            [
                mission_item(0, 0, vehicle_action=MissionItem.VehicleAction.TAKEOFF),
                mission_item(5, 0, speed_m_s=3.0),
                mission_item(5, 8, camera_action=MissionItem.CameraAction.TAKE_PHOTO),
            ]
        )
        await mission.set_return_to_launch_after_mission(True)
        await mission.upload_mission(plan)
        back = await mission.download_mission()
        assert len(back.mission_items) == 3
        assert back.mission_items[1].latitude_deg == pytest.approx(plan.mission_items[1].latitude_deg)
        assert back.mission_items[1].speed_m_s == pytest.approx(3.0)

        await action.arm()
        await mission.start_mission()
        await wait_for(mission.subscribe_mission_progress(), lambda progress: progress.current >= 2)
        await mission.pause_mission()
        await wait_for(telemetry.subscribe_flight_mode(), lambda mode: mode.name == "HOLD")
        assert not await mission.is_mission_finished()
        await mission.start_mission()
        done = await wait_for(
            mission.subscribe_mission_progress(), lambda progress: progress.current == progress.total
        )
        assert done.total == 3
        assert await mission.is_mission_finished()
        await wait_for(telemetry.subscribe_flight_mode(), lambda mode: mode.name == "RETURN_TO_LAUNCH")
        await wait_for(telemetry.subscribe_armed(), lambda armed: not armed)
        simulator.wait_for_event("disarmed (after landing)")

        await mission.clear_mission()
        assert (await mission.download_mission()).mission_items == []


async def test_mavsdk_uploads_and_downloads_raw_plans_and_a_geofence() -> None:
    async with mavsdk_flight() as (_, system):
        missions = system.plugin(MissionRawAsync)
        flight = raw([takeoff(4.0), waypoint(5, 5, 4.0), item(93, None, 2.0), land(5, 5)])
        fence = raw(polygon([(-40, -40), (40, -40), (40, 40), (-40, 40)]))
        points = raw([rally(20, 0), rally(0, 20)])
        await uploaded(missions.upload_mission, flight)
        await uploaded(missions.upload_geofence, fence)
        await uploaded(missions.upload_rally_points, points)
        for sent, got in (
            (flight, await missions.download_mission()),
            (fence, await missions.download_geofence()),
            (points, await missions.download_rallypoints()),
        ):
            assert [(i.command, i.x, i.y, i.z, i.mission_type) for i in got] == [
                (i.command, i.x, i.y, i.z, i.mission_type) for i in sent
            ]
        await missions.set_current_mission_item(2)
        seen = await wait_for(missions.subscribe_mission_progress(), lambda progress: progress.current == 2)
        assert seen.total == 4

        geofence = system.plugin(GeofenceAsync)
        corners = [Point(*position(*corner)) for corner in ((-30, -30), (30, -30), (30, 30), (-30, 30))]
        inside = Polygon(corners, FenceType.INCLUSION)
        around = Circle(Point(*position(0, 0)), 15.0, FenceType.INCLUSION)
        await geofence.upload_geofence(GeofenceData([inside], [around]))
        stored = await geofence.download_geofence()
        assert len(stored.polygons[0].points) == 4
        assert stored.circles[0].radius == pytest.approx(15.0)

        await geofence.clear_geofence()
        assert not (await geofence.download_geofence()).circles


@pytest.mark.slow
async def test_mavsdk_geofence_breach_holds_and_reports() -> None:
    # in real time: texts go to a ground station whose heartbeat comes often enough
    async with mavsdk_flight(1.0, of_ground_station=True) as (simulator, system):
        fence, telemetry = system.plugin(GeofenceAsync), system.plugin(TelemetryAsync)
        action, offboard = system.plugin(ActionAsync), system.plugin(OffboardAsync)
        texts: list[str] = []

        async def listen() -> None:
            async with aclosing(telemetry.subscribe_status_text()) as statuses:
                async for status in statuses:
                    texts.append(status.text)

        def sent_texts(words: str) -> bool:
            return any(words in text for text in texts)

        async with meanwhile(listen()):
            await fence.upload_geofence(
                GeofenceData([], [Circle(Point(*position(0, 0)), 8.0, FenceType.INCLUSION)])
            )
            await action.arm()
            await action.takeoff()
            await asyncio.to_thread(simulator.wait_for_event, "mode HOLD", LIMIT_S)
            await offboard.set_velocity_ned(VelocityNedYaw(3.0, 0.0, 0.0, 0.0))
            await offboard.start()
            await wait_for(telemetry.subscribe_flight_mode(), lambda mode: mode.name == "OFFBOARD")
            assert not sent_texts("Geofence")
            await wait_for(telemetry.subscribe_flight_mode(), lambda mode: mode.name == "HOLD")
            outside = await wait_for(telemetry.subscribe_position_velocity_ned())
            assert outside.position.north_m > 7.0
            async with asyncio.timeout(LIMIT_S):
                while not sent_texts("Geofence: approaching or outside geofence") or not sent_texts(
                    "Failsafe activated"
                ):
                    await asyncio.sleep(0.05)
            await asyncio.to_thread(simulator.wait_for_event, "failsafe: geofence breached, HOLD")
            stopped = await wait_for(
                telemetry.subscribe_position_velocity_ned(), lambda seen: abs(seen.velocity.north_m_s) < 0.3
            )
            assert stopped.position.north_m < 20.0
            assert not await offboard.is_active()
