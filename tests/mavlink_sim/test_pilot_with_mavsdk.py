"""MAVSDK: joystick, gimbal, battery and remote control."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

import pytest
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.gimbal import ControlMode, GimbalAsync, GimbalMode, SendMode
from mavsdk.asyncio.plugins.manual_control import ManualControlAsync
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync, MavlinkMessage
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

from mavlink_sim.flight.transmitter import CALIBRATION
from mavlink_sim.testing import RunningSimulator, running_simulator
from tests.mavlink_sim.mavsdk_client import MavsdkClient, mavsdk_client, meanwhile, wait_for

pytestmark = pytest.mark.realtime


@asynccontextmanager
async def connected(**options: Any) -> AsyncIterator[tuple[RunningSimulator, MavsdkClient]]:
    """A simulator, and MAVSDK as its ground station."""
    with running_simulator(**options) as simulator:
        async with mavsdk_client(f"udpin://127.0.0.1:{simulator.gcs_port}") as system:
            yield simulator, system


def streaming(send: Callable[[], Any], period_s: float) -> AbstractAsyncContextManager[None]:
    async def stream() -> None:
        while True:
            await send()
            await asyncio.sleep(period_s)

    return meanwhile(stream())


async def test_a_joystick_flies_the_vehicle_in_position_mode() -> None:
    # lenient about the stream's gaps: the machine may be busy
    async with connected(speed=1.0, parameters={"COM_RC_IN_MODE": 1, "COM_RC_LOSS_T": 5}) as (
        simulator,
        system,
    ):
        action = system.plugin(ActionAsync)
        telemetry = system.plugin(TelemetryAsync)
        manual = system.plugin(ManualControlAsync)
        sticks = [0.0, 0.0, 0.5, 0.0]
        await wait_for(telemetry.subscribe_health(), lambda health: health.is_armable)
        async with streaming(lambda: manual.set_manual_control_input(*sticks), 0.05):
            await asyncio.to_thread(simulator.wait_for_event, "mode POSCTL")
            await action.arm()
            await manual.start_position_control()
            sticks[2] = 1.0
            await wait_for(
                telemetry.subscribe_position(), lambda position: position.relative_altitude_m > 2.0
            )
            sticks[:] = [0.8, 0.0, 0.5, 0.0]
            await wait_for(telemetry.subscribe_position_velocity_ned(), lambda p: p.position.north_m > 3.0)
            sticks[:] = [0.0, 0.0, 0.0, 0.0]
            await wait_for(telemetry.subscribe_armed(), lambda armed: not armed)
        await asyncio.to_thread(simulator.wait_for_event, "disarmed (after landing)")


async def test_gimbal_and_battery_are_read_and_gimbal_is_turned() -> None:
    async with connected(speed=4.0, gimbal=True) as (_, system):
        gimbal, telemetry = system.plugin(GimbalAsync), system.plugin(TelemetryAsync)
        listed = await wait_for(gimbal.subscribe_gimbal_list(), lambda update: bool(update.gimbals))
        found = listed.gimbals[0]
        assert found.gimbal_device_id == 1
        await gimbal.take_control(found.gimbal_id, ControlMode.PRIMARY)
        await gimbal.set_angles(found.gimbal_id, 0.0, -40.0, 25.0, GimbalMode.YAW_FOLLOW, SendMode.ONCE)
        looking = await wait_for(
            gimbal.subscribe_attitude(), lambda update: abs(update.euler_angle_forward.pitch_deg + 40.0) < 0.5
        )
        assert looking.gimbal_id == found.gimbal_id
        await wait_for(
            gimbal.subscribe_attitude(), lambda update: abs(update.euler_angle_forward.yaw_deg - 25.0) < 0.5
        )
        await gimbal.release_control(found.gimbal_id)
        battery = await wait_for(telemetry.subscribe_battery(), lambda update: update.voltage_v > 0.0)
        assert battery.voltage_v == pytest.approx(16.2, abs=0.1)
        assert battery.remaining_percent == pytest.approx(100.0, abs=2.0)


async def test_a_remote_control_is_read() -> None:
    parameters = {**CALIBRATION, "COM_RC_IN_MODE": 0, "COM_RC_LOSS_T": 5}
    async with connected(speed=1.0, parameters=parameters) as (_, system):
        direct, telemetry = system.plugin(MavlinkDirectAsync), system.plugin(TelemetryAsync)
        channels = {f"chan{number}_raw": 1500 for number in range(1, 9)}
        fields = {"target_system": 1, "target_component": 1, **channels}
        override = MavlinkMessage("RC_CHANNELS_OVERRIDE", 245, 190, 1, 1, json.dumps(fields))
        async with streaming(lambda: direct.send_message(override), 0.1):
            status = await wait_for(telemetry.subscribe_rc_status(), lambda update: update.is_available)
        assert status.signal_strength_percent == pytest.approx(100.0, abs=61.0)
