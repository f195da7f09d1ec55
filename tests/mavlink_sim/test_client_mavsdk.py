"""MAVSDK 4 as a client: its plugins, also joystick, gimbal, battery and remote control."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

import pytest
from mavsdk.asyncio import ComponentType
from mavsdk.asyncio.plugins.action import ActionAsync, ActionError
from mavsdk.asyncio.plugins.events import EventsAsync
from mavsdk.asyncio.plugins.gimbal import ControlMode, GimbalAsync, GimbalMode, SendMode
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.manual_control import ManualControlAsync
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync, MavlinkMessage
from mavsdk.asyncio.plugins.offboard import (
    OffboardAsync,
    OffboardError,
    PositionNedYaw,
    VelocityBodyYawspeed,
    VelocityNedYaw,
)
from mavsdk.asyncio.plugins.param import ParamAsync, ParamError
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

from mavlink_sim.testing import QUICK_FLIGHT, RunningSimulator, vehicle
from tests.mavlink_sim.conftest import CALIBRATION
from tests.mavlink_sim.mavsdk_client import MavsdkClient, mavsdk_client, meanwhile, wait_for

pytestmark = pytest.mark.realtime

SPEED = 4.0
# As PX4 words the arming checks.
ARMING_PROBLEMS = {"No valid mission available", "No offboard signal", "No manual control input"}


@pytest.fixture
async def simulator() -> AsyncIterator[RunningSimulator]:
    async with vehicle(speed=SPEED, gimbal=True, parameters=QUICK_FLIGHT) as running:
        yield running


@pytest.fixture
async def system(simulator: RunningSimulator) -> AsyncIterator[MavsdkClient]:
    async with mavsdk_client(simulator.mavsdk_url) as client:
        yield client


async def test_mavsdk_reads_state_and_turns_the_gimbal(system: MavsdkClient) -> None:
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

    reports = system.plugin(EventsAsync).subscribe_health_and_arming_checks()
    # As soon as it has the events' metadata it requests the checks; later reports come by themselves.
    report = await wait_for(reports, lambda report: report.current_mode_intention.can_arm_or_run)
    assert report.current_mode_intention.mode_name == "Hold"
    assert report.current_mode_intention.problems == []
    problems = {problem.message for problem in report.all_problems}
    assert problems == ARMING_PROBLEMS
    present = {part.label for part in report.health_components if part.is_present}
    assert {"GPS", "Battery"} <= present
    faulty = {part.label for part in report.health_components if part.has_error}
    assert faulty == {"System", "Remote Control (RC or Joystick)"}

    gimbal = system.plugin(GimbalAsync)
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


async def test_it_flies_by_action_and_by_offboard(simulator: RunningSimulator, system: MavsdkClient) -> None:
    action = system.plugin(ActionAsync)
    telemetry = system.plugin(TelemetryAsync)
    offboard = system.plugin(OffboardAsync)
    await wait_for(telemetry.subscribe_health(), lambda health: health.is_armable)
    await action.disarm()  # it is disarmed: no error
    with pytest.raises(OffboardError, match="NO_SETPOINT_SET"):
        await offboard.start()
    await action.set_takeoff_altitude(4.0)
    assert await action.get_takeoff_altitude() == pytest.approx(4.0)
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
    await asyncio.to_thread(simulator.wait_for_event, "disarmed (after landing)")
    assert "landed" in simulator.events


async def test_denied_command_raises_mavsdk_error() -> None:
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


@asynccontextmanager
async def connected(**options: Any) -> AsyncIterator[tuple[RunningSimulator, MavsdkClient]]:
    """A simulator, and MAVSDK as its ground station."""
    async with (
        vehicle(**options) as simulator,
        mavsdk_client(f"udpin://127.0.0.1:{simulator.gcs_port}") as system,
    ):
        yield simulator, system


def streaming(send: Callable[[], Any], period_s: float) -> AbstractAsyncContextManager[None]:
    async def stream() -> None:
        while True:
            await send()
            await asyncio.sleep(period_s)

    return meanwhile(stream())


async def test_a_joystick_flies_the_vehicle_in_position_mode() -> None:
    # lenient about the stream's gaps: the machine may be busy
    parameters = {**QUICK_FLIGHT, "COM_RC_IN_MODE": 1, "COM_RC_LOSS_T": 10}
    async with connected(speed=2.0, parameters=parameters) as (simulator, system):
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
        values = dict.fromkeys((f"param{number}" for number in range(1, 8)), 0)
        request = {"target_system": 1, "target_component": 1, "confirmation": 0, "command": 512, **values}
        command = MavlinkMessage("COMMAND_LONG", 245, 190, 1, 1, json.dumps({**request, "param1": 148}))
        assert json.loads((await direct.send_command(command)).fields_json)["result"] == 0
