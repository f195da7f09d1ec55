"""MAVSDK 4 as a client: its action, telemetry, info, param and offboard plugins against the vehicle."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator

import pytest
from mavsdk.asyncio import ComponentType
from mavsdk.asyncio.plugins.action import ActionAsync, ActionError
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.offboard import (
    OffboardAsync,
    OffboardError,
    PositionNedYaw,
    VelocityBodyYawspeed,
    VelocityNedYaw,
)
from mavsdk.asyncio.plugins.param import ParamAsync, ParamError
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

from mavlink_sim.testing import RunningSimulator, vehicle
from tests.mavlink_sim.mavsdk_client import MavsdkClient, mavsdk_client, wait_for

pytestmark = pytest.mark.realtime

SPEED = 4.0


@pytest.fixture
async def simulator() -> AsyncIterator[RunningSimulator]:
    async with vehicle(speed=SPEED) as running:
        yield running


@pytest.fixture
async def system(simulator: RunningSimulator) -> AsyncIterator[MavsdkClient]:
    async with mavsdk_client(simulator.mavsdk_url) as client:
        yield client


async def test_mavsdk_reads_info_parameters_and_state(system: MavsdkClient) -> None:
    information = system.plugin(InfoAsync)
    telemetry = system.plugin(TelemetryAsync)
    parameters = system.plugin(ParamAsync)
    version = await information.get_version()
    assert (version.flight_sw_major, version.flight_sw_minor) == (1, 17)
    assert (await information.get_identification()).legacy_uid == 5283920058631409231

    health = await wait_for(telemetry.subscribe_health(), lambda health: health.is_armable)
    assert health.is_global_position_ok
    assert health.is_home_position_ok
    assert await wait_for(telemetry.subscribe_health_all_ok(), lambda ok: ok)
    assert (await wait_for(telemetry.subscribe_gps_info())).num_satellites == 10
    assert (await wait_for(telemetry.subscribe_home())).absolute_altitude_m == pytest.approx(489.4, abs=0.1)
    assert (await wait_for(telemetry.subscribe_battery())).remaining_percent == pytest.approx(99.0, abs=1.0)
    assert not (await wait_for(telemetry.subscribe_rc_status())).is_available
    down = (await wait_for(telemetry.subscribe_imu())).acceleration_frd.down_m_s2
    assert down == pytest.approx(-9.81, abs=0.5)
    await telemetry.set_rate_position(10.0)
    assert (await telemetry.get_gps_global_origin()).altitude_m == pytest.approx(489.4, abs=0.1)

    everything = await parameters.get_all_params()
    assert len(everything.int_params) + len(everything.float_params) > 250
    await parameters.set_param_int("NAV_RCL_ACT", 3)
    await parameters.set_param_float("MIS_TAKEOFF_ALT", 3.0)
    assert await parameters.get_param_int("NAV_RCL_ACT") == 3
    assert await parameters.get_param_float("MIS_TAKEOFF_ALT") == 3.0
    for request, result in (
        (parameters.get_param_int("NO_SUCH"), "DOES_NOT_EXIST"),
        # Not one of those above: a late answer to them, and MAVSDK refuses by itself, in other words.
        (parameters.set_param_float("COM_OBL_RC_ACT", 3.0), "TYPE_MISMATCH"),
    ):
        with pytest.raises(ParamError, match=result):
            await request


async def test_it_flies_by_action_and_by_offboard(simulator: RunningSimulator, system: MavsdkClient) -> None:
    action = system.plugin(ActionAsync)
    telemetry = system.plugin(TelemetryAsync)
    offboard = system.plugin(OffboardAsync)
    await wait_for(telemetry.subscribe_health(), lambda health: health.is_armable)
    await action.disarm()  # it is disarmed: no error
    with pytest.raises(OffboardError, match="NO_SETPOINT_SET"):
        await offboard.start()
    await action.set_takeoff_altitude(4.0)
    await action.set_return_to_launch_altitude(12.0)
    assert await action.get_return_to_launch_altitude() == 12.0
    await action.arm()
    await action.takeoff()
    await wait_for(telemetry.subscribe_landed_state(), lambda state: int(state) == 2)  # in the air
    with pytest.raises(ActionError, match="COMMAND_DENIED"):
        await action.disarm()

    await offboard.set_velocity_body(VelocityBodyYawspeed(2.0, 0.0, 0.0, 0.0))
    await offboard.start()
    await wait_for(telemetry.subscribe_position_velocity_ned(), lambda p: p.velocity.north_m_s > 1.0)
    await offboard.set_velocity_ned(VelocityNedYaw(0.0, 2.0, 0.0, 90.0))
    await wait_for(telemetry.subscribe_heading(), lambda heading: abs(heading.heading_deg - 90.0) < 8.0)
    await offboard.set_position_ned(PositionNedYaw(0.0, 0.0, -5.0, 0.0))
    await wait_for(
        telemetry.subscribe_position_velocity_ned(),
        lambda p: math.dist((p.position.north_m, p.position.east_m, p.position.down_m), (0, 0, -5)) < 1.0,
    )
    await offboard.stop()
    await asyncio.to_thread(
        simulator.wait_for_event, "mode HOLD", since=simulator.events.index("mode OFFBOARD")
    )

    await action.goto_location(47.3978, 8.5455942, 494.4, 0.0)
    await wait_for(telemetry.subscribe_position(), lambda position: position.latitude_deg > 47.39777)
    await action.return_to_launch()
    await asyncio.to_thread(simulator.wait_for_event, "mode RTL")
    await action.land()
    await wait_for(telemetry.subscribe_armed(), lambda armed: not armed)


async def test_refusal_raises_mavsdk_error() -> None:
    async with (
        vehicle(speed=SPEED, ready_after=600.0) as simulator,
        mavsdk_client(simulator.mavsdk_url, ComponentType.COMPANION_COMPUTER) as system,
    ):
        action = system.plugin(ActionAsync)
        with pytest.raises(ActionError, match="COMMAND_DENIED"):
            await action.arm()  # not ready
        with pytest.raises(ActionError, match="UNSUPPORTED"):
            await action.reboot()
        with pytest.raises(ActionError, match="VTOL"):
            await action.transition_to_fixedwing()
