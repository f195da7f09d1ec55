"""The pymavlink driver with the built-in ArduPilot Copter, by the driver's contract."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.ardupilot_profile import ArduPilotProfile, custom_mode_of_mode, mode_of_custom_mode
from companion.vehicle.autopilot_driver import AutopilotDriver
from companion.vehicle.driver import CommandRefusedError, Driver, SystemStatus
from companion.vehicle.drivers import open_driver
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.vehicle_type import PROGRAM_MISSING, VtolState
from mavlink_sim.testing import RunningSimulator, free_port, vehicle
from tests.companion.vehicle.fake_autopilot import SETPOINT, FakeAutopilot, wait_for_state, wait_until

pytestmark = pytest.mark.realtime


@asynccontextmanager
async def copter(speed: float = 4.0) -> AsyncIterator[tuple[Driver, RunningSimulator]]:
    """A Copter in its own process, and a connected driver with a known home."""
    quick = {"LAND_SPEED": 200}
    async with vehicle(autopilot="ardupilot", speed=speed, seed=3, parameters=quick) as simulator:
        driver = open_driver("pymavlink", f"udpin://127.0.0.1:{simulator.onboard_port}")
        await driver.connect(20.0)
        try:
            await wait_for_state(driver, lambda state: state.ready_to_arm and known(state))
            yield driver, simulator
        finally:
            await driver.close()


def known(state: VehicleState) -> bool:
    return (
        state.position_fresh(time.monotonic_ns())
        and state.landed is not LandedState.UNKNOWN
        and state.home_position_ned_m is not None
        and state.battery_fraction is not None
        and math.isfinite(state.latitude_deg)
    )


async def test_streams_parameters_and_modes_on_the_ground() -> None:
    async with copter() as (driver, _):
        assert isinstance(driver, AutopilotDriver)
        assert driver.state.mode is FlightMode.STABILIZED
        assert driver.state.altitude_m == pytest.approx(0.0, abs=0.5)
        assert await driver.get_parameter("RTL_ALT") == 1500.0  # an INT32, sent as a number
        await driver.set_parameter("RTL_ALT", 900)
        await driver.set_parameter("GUID_TIMEOUT", 1.5)
        assert await driver.get_parameter("RTL_ALT") == 900.0
        assert await driver.get_parameter("GUID_TIMEOUT") == 1.5
        with pytest.raises(CommandRefusedError, match=r"RTL_ALT .*integer .*900\.5"):
            await driver.set_parameter("RTL_ALT", 900.5)
        with pytest.raises(CommandRefusedError, match="armed"):
            await driver.takeoff(3.0)
        await driver.set_mode(FlightMode.RETURN)
        with pytest.raises(CommandRefusedError, match=r"\(failed\)"):
            await driver.arm()
        await driver.set_mode(FlightMode.HOLD)  # GUIDED: a Copter cannot be armed in BRAKE
        await driver.arm()
        await driver.disarm()

        # Streams that stop are restored.
        stop = {"req_stream_id": mavlink.MAV_DATA_STREAM_ALL, "req_message_rate": 0, "start_stop": 0}
        driver._send_message("REQUEST_DATA_STREAM", {"target_system": 1, "target_component": 1, **stop})
        await wait_for_state(driver, lambda s: not s.position_fresh(time.monotonic_ns()))
        await wait_for_state(driver, lambda s: "LOCAL_POSITION_NED" in s.missing_streams)
        await wait_for_state(driver, known)


async def test_copter_brakes_on_silence_and_stays_in_guided() -> None:
    async with copter() as (driver, simulator):
        modes: list[FlightMode] = []
        driver.subscribe(lambda s: modes.append(s.mode) if modes[-1:] != [s.mode] else None)
        await driver.set_mode(FlightMode.HOLD)
        await driver.arm()
        await driver.takeoff(4.0)
        assert driver.state.mode is FlightMode.TAKEOFF
        await wait_for_state(driver, lambda s: s.mode is FlightMode.HOLD and s.landed is LandedState.IN_AIR)
        assert driver.state.altitude_m == pytest.approx(4.0, abs=1.0)
        await driver.set_mode(FlightMode.OFFBOARD)

        async def fly() -> None:
            while True:
                driver.send_setpoint(Setpoint.velocity((2.0, 0.0, 0.0), time.monotonic_ns()))
                await asyncio.sleep(0.05)

        sending = asyncio.create_task(fly())
        await wait_for_state(driver, lambda s: (s.velocity_ned_mps or (0.0,))[0] > 1.5)
        sending.cancel()
        # GUID_TIMEOUT: 3 s of simulated time, then braking.
        state = await wait_for_state(driver, lambda s: math.hypot(*(s.velocity_ned_mps or (9.0,))) < 0.7)
        assert state.mode is FlightMode.OFFBOARD
        assert abs(driver.state.yaw_rad or 0.0) < 0.3  # without a yaw setpoint it keeps its heading

        await driver.set_mode(FlightMode.HOLD)
        assert simulator.wait_for_event("mode BRAKE")
        simulator.fault("pilot_takeover mode=POSCTL")
        await wait_for_state(driver, lambda s: s.mode is FlightMode.POSITION)  # LOITER
        simulator.fault("end all")
        await driver.set_mode(FlightMode.LAND)
        await wait_for_state(driver, lambda s: not s.armed, 30.0)
        flown = [str(mode) for mode in modes][-7:]
        assert flown == ["hold", "takeoff", "hold", "offboard", "hold", "position", "land"]


def test_guided_that_we_did_not_request_is_offboard() -> None:
    profile = ArduPilotProfile()
    state = VehicleState(armed=True, landed=LandedState.IN_AIR)
    profile.mode_request(FlightMode.HOLD, VehicleState())
    translated = [profile.translate("HEARTBEAT", {"custom_mode": mode}, state) for mode in (0, 4, 5, 4)]
    assert [fields["flight_mode"] for ((_, fields),) in translated] == [
        FlightMode.STABILIZED,  # before the requested mode
        FlightMode.HOLD,
        FlightMode.POSITION,
        FlightMode.OFFBOARD,  # not requested by us
    ]


def test_no_acceleration_is_sent_to_copter() -> None:
    """Copter would integrate it into the velocity for GUID_TIMEOUT after our setpoints end."""
    given = {"type_mask": 0b1000_0000_0111, "vx": 3.0, "afx": 1.0, "afy": -2.0, "afz": 0.0, "yaw_rate": 0.0}
    sent = ArduPilotProfile().setpoint_fields(given)
    assert sent["type_mask"] == 0b1001_1100_0111
    assert (sent["vx"], sent["afx"], sent["afy"], sent["afz"]) == (3.0, 0.0, 0.0, 0.0)


async def test_quick_reboot_is_detected_by_timesync(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with copter(2.0) as (driver, simulator):
        assert isinstance(driver, AutopilotDriver)
        # A restart is a clock that goes back by more than reordered messages do.
        await wait_until(lambda: driver._telemetry._boot_ms.get("TIMESYNC", 0) > 6_000, 10.0)
        simulator.fault("reboot 1.2")
        await wait_until(lambda: "has restarted" in caplog.text, 10.0)
        assert "LOCAL_POSITION_NED" not in driver._telemetry._boot_ms  # not received again yet
        await wait_for_state(driver, known)
        assert "no heartbeat" not in caplog.text


def test_copter_modes_map_to_px4_names() -> None:
    assert mode_of_custom_mode(4) is FlightMode.OFFBOARD
    assert mode_of_custom_mode(21) is FlightMode.RETURN
    assert mode_of_custom_mode(99) is FlightMode.UNKNOWN
    assert custom_mode_of_mode(FlightMode.POSITION) == 5
    with pytest.raises(ValueError, match=r"ArduPilot .* mode takeoff; "):
        custom_mode_of_mode(FlightMode.TAKEOFF)


async def test_messages_sent_to_ardupilot() -> None:
    port = free_port()
    autopilot = FakeAutopilot(port, autopilot=3)
    autopilot.custom_mode, autopilot.base_mode = 4, 217
    autopilot.start()
    driver = open_driver("pymavlink", f"udpin://127.0.0.1:{port}")
    try:
        await driver.connect(10.0)
        autopilot.landed()
        await wait_for_state(driver, lambda state: state.not_flown is None)
        driver.send_setpoint(Setpoint.velocity((1.0, 0.0, 0.0), time.monotonic_ns()))
        (message,) = await autopilot.wait_for(SETPOINT)
        assert message.type_mask == 0b0101_1100_0111  # a yaw rate of zero: the heading is kept
        assert message.yaw_rate == 0.0
        autopilot.send(mavlink.MAVLink_gps_global_origin_message(474000000, 85000000, 480_000))
        home = (474000900, 85000000, 485_000)
        autopilot.send(mavlink.MAVLink_home_position_message(*home, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0))
        await wait_until(lambda: driver.state.home_position_ned_m is not None, 5.0)
        assert driver.state.home_position_ned_m == pytest.approx((10.007, 0.0, -5.0), abs=0.01)
        await driver.set_mode(FlightMode.OFFBOARD)
        asked = [m for m in await autopilot.wait_for("COMMAND_LONG") if m.command == 176]
        assert (asked[-1].param1, asked[-1].param2) == (1.0, 4.0)
        driver.send_heartbeat(SystemStatus.ACTIVE, uptime_s=5.0)
        (mark,) = await autopilot.wait_for("NAMED_VALUE_INT")
        heartbeat = (await autopilot.wait_for("HEARTBEAT"))[-1]
        assert mark.name == "companion"
        assert mark.value & 0xFFFF_FFFF == heartbeat.custom_mode
    finally:
        await driver.close()
        await autopilot.stop()


async def test_quadplane_that_reports_a_quadrotor_is_not_flown() -> None:
    port = free_port()
    autopilot = FakeAutopilot(port, autopilot=3)
    autopilot.vtol_state, autopilot.parameters = mavlink.MAV_VTOL_STATE_MC, {"Q_ENABLE": 1.0}
    autopilot.start()
    driver = open_driver("pymavlink", f"udpin://127.0.0.1:{port}")
    try:
        await driver.connect(10.0)
        autopilot.landed(mavlink.MAV_LANDED_STATE_IN_AIR)
        await wait_for_state(driver, lambda state: state.vtol_state is VtolState.MC)
        assert driver.state.is_plane is True
        assert driver.state.not_flown is not None
        with pytest.raises(CommandRefusedError):
            await driver.set_mode(FlightMode.HOLD)  # 17: QSTABILIZE
        assert not [m for m in autopilot.received_named("COMMAND_LONG") if m.command == 176]
    finally:
        await driver.close()
        await autopilot.stop()


@pytest.mark.realtime
async def test_no_command_until_copter_or_plane_has_answered() -> None:
    """A link that loses the answers; then one in service, then a standstill."""
    port = free_port()
    autopilot = FakeAutopilot(port, autopilot=3)
    autopilot.vtol_state, parameters = mavlink.MAV_VTOL_STATE_MC, autopilot.parameters
    autopilot.parameters = {}
    autopilot.start()
    driver = open_driver("pymavlink", f"udpin://127.0.0.1:{port}")
    try:
        await driver.connect(10.0)
        autopilot.landed(mavlink.MAV_LANDED_STATE_IN_AIR)
        await wait_for_state(driver, lambda state: state.vtol_state is VtolState.MC)
        assert driver.state.not_flown == PROGRAM_MISSING
        with pytest.raises(CommandRefusedError, match="FRAME_CLASS"):
            await driver.set_mode(FlightMode.HOLD)
        assert not [m for m in autopilot.received_named("COMMAND_LONG") if m.command == 176]
        reported: list[bool | None] = []
        driver.subscribe(lambda state: reported.append(state.is_plane))
        autopilot.parameters = parameters
        await wait_for_state(driver, lambda state: state.not_flown is None)
        assert reported[-1] is False
        driver.discard_received()
        assert driver.state.is_plane is None
        await wait_for_state(driver, lambda state: state.is_plane is False)
    finally:
        await driver.close()
        await autopilot.stop()


@pytest.mark.realtime
async def test_streams_are_requested_again_before_the_identity(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a restart, where the answers to parameter requests are lost."""
    port = free_port()
    autopilot = FakeAutopilot(port, autopilot=3)
    autopilot.start()
    driver = open_driver("pymavlink", f"udpin://127.0.0.1:{port}")
    try:
        await driver.connect(10.0)
        await wait_until(lambda: driver.link_count == 1 and driver.state.is_plane is False, 5.0)
        assert isinstance(driver, AutopilotDriver)
        requested = asyncio.Event()
        monkeypatch.setattr(driver._streams, "restart", requested.set)
        autopilot.parameters = {}
        autopilot.send(mavlink.MAVLink_system_time_message(0, 60_000))
        autopilot.send(mavlink.MAVLink_system_time_message(0, 100))
        await wait_for_state(driver, lambda state: state.is_plane is None)
        await asyncio.wait_for(requested.wait(), 2.0)
        assert driver.state.is_plane is None
    finally:
        await driver.close()
        await autopilot.stop()
