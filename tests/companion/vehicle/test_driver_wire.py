"""Messages sent and received by both drivers, on a real socket."""

from __future__ import annotations

import asyncio
import logging
import math
import struct
import time
from itertools import groupby

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.driver import Driver, SystemStatus
from companion.vehicle.drivers import DriverKind, open_driver
from companion.vehicle.framing import CURRENT_MODE_ID, pack_frame
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from tests.companion.vehicle.fake_autopilot import (
    MISSION,
    OFFBOARD,
    SETPOINT,
    TAKEOFF,
    FakeAutopilot,
    wait_for_state,
    wait_until,
)
from tests.companion.vehicle.scripted_link import ScriptedDriver

pytestmark = [pytest.mark.usefixtures("short_measurement"), pytest.mark.realtime]


async def test_velocity_setpoint_has_px4s_type_mask(driver: Driver, autopilot: FakeAutopilot) -> None:
    now_ns = time.monotonic_ns()
    driver.send_setpoint(Setpoint.velocity((1.5, -2.0, 0.25), now_ns, yaw_rate_radps=0.5))
    (message,) = await autopilot.wait_for(SETPOINT)
    assert (message.vx, message.vy, message.vz, message.yaw_rate) == (1.5, -2.0, 0.25, 0.5)
    assert message.type_mask == 0b0101_1100_0111
    assert message.coordinate_frame == mavlink.MAV_FRAME_LOCAL_NED
    assert (message.target_system, message.target_component) == (1, 1)
    assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)


async def test_velocity_setpoint_has_its_acceleration(driver: Driver, autopilot: FakeAutopilot) -> None:
    now_ns = time.monotonic_ns()
    driver.send_setpoint(
        Setpoint.velocity((1.5, -2.0, 0.25), now_ns, yaw_rad=0.5, acceleration_ned_mps2=(0.5, -0.25, 0.0))
    )
    (message,) = await autopilot.wait_for(SETPOINT)
    assert (message.vx, message.vy, message.vz, message.yaw) == (1.5, -2.0, 0.25, 0.5)
    assert (message.afx, message.afy, message.afz) == (0.5, -0.25, 0.0)
    assert message.type_mask == 0b1000_0000_0111


async def test_position_setpoint_ignores_velocity(driver: Driver, autopilot: FakeAutopilot) -> None:
    driver.send_setpoint(Setpoint.position((10.0, 20.0, -5.0), time.monotonic_ns(), yaw_rad=1.25))
    (message,) = await autopilot.wait_for(SETPOINT)
    assert (message.x, message.y, message.z, message.yaw) == (10.0, 20.0, -5.0, 1.25)
    assert message.type_mask == 0b1001_1111_1000


async def test_landing_target_has_the_autopilots_coordinates(
    driver: Driver, autopilot: FakeAutopilot
) -> None:
    for boot_ms, (north, east) in ((1000, (0.0, 0.0)), (1020, (7.0, -2.0))):  # a reset of the estimate
        autopilot.send(mavlink.MAVLink_local_position_ned_message(boot_ms, north, east, -4.0, 0.0, 0.0, 0.0))
    await wait_for_state(driver, lambda state: state.reset_offset_ned_m == (7.0, -2.0, 0.0))
    driver.send_landing_target(LandingTarget(5_000_123_000, 7, (3.0, -1.5, 0.25), (0.5, -0.25, 4.0), 0.5))
    (message,) = await autopilot.wait_for("LANDING_TARGET")
    distance = math.hypot(0.5, -0.25, 4.0)
    size = 2 * math.atan(0.25 / distance)
    values = message.to_dict()
    assert values.pop("mavpackettype") == "LANDING_TARGET"
    quaternion = values.pop("q")
    assert values == pytest.approx(
        {
            "time_usec": 5_000_123,
            "target_num": 7,
            "frame": mavlink.MAV_FRAME_LOCAL_NED,
            "angle_x": math.atan2(-0.25, 4.0),
            "angle_y": math.atan2(-0.5, 4.0),
            "distance": distance,
            "size_x": size,
            "size_y": size,
            "x": 10.0,
            "y": -3.5,
            "z": 0.25,
            "type": mavlink.LANDING_TARGET_TYPE_VISION_FIDUCIAL,
            "position_valid": 1,
        }
    )
    assert quaternion == [1.0, 0.0, 0.0, 0.0]
    assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)


async def test_every_setpoint_is_sent_once(driver: Driver, autopilot: FakeAutopilot) -> None:
    for north in range(5):
        driver.send_setpoint(Setpoint.velocity((float(north), 0.0, 0.0), time.monotonic_ns()))
    await autopilot.wait_for(SETPOINT, 5)
    # What must not come has no event: a repeating sender (MAVSDK's runs at 20 Hz) would have sent 20 more
    # before the heartbeat, one of 1 Hz one more.
    await asyncio.sleep(1.1)
    driver.send_heartbeat(SystemStatus.ACTIVE)
    await autopilot.wait_for("HEARTBEAT")
    assert [message.vx for message in autopilot.received_named(SETPOINT)] == [0.0, 1.0, 2.0, 3.0, 4.0]


async def test_only_our_heartbeats_are_sent_in_sequence(driver: Driver, autopilot: FakeAutopilot) -> None:
    driver.send_heartbeat(SystemStatus.CRITICAL)
    await autopilot.wait_for("COMMAND_LONG", 3)
    # What must not come has no event: MAVSDK's own heartbeat is due every second.
    await asyncio.sleep(1.1)
    driver.send_heartbeat(SystemStatus.ACTIVE)
    beats = await autopilot.wait_for("HEARTBEAT", 2)
    assert [(beat.type, beat.autopilot, beat.system_status) for beat in beats] == [(18, 8, 5), (18, 8, 4)]
    sequences = [message.get_seq() for message, _ in autopilot.received]
    assert sequences == [number % 256 for number in range(len(sequences))]


async def test_hung_loop_sends_nothing(driver: Driver, autopilot: FakeAutopilot) -> None:
    driver.send_setpoint(Setpoint.velocity((1.0, 0.0, 0.0), time.monotonic_ns()))
    driver.send_heartbeat(SystemStatus.ACTIVE)
    await autopilot.wait_for(SETPOINT)
    await autopilot.wait_for("HEARTBEAT")
    autopilot.drain()  # what was sent before the hang
    before = len(autopilot.received)
    time.sleep(1.1)  # noqa: ASYNC251 the hang is what is tested; a sender's own heartbeat is due every second
    autopilot.drain()
    assert len(autopilot.received) == before


async def received_speeds(driver: Driver, autopilot: FakeAutopilot, speed_mps: float) -> set[float]:
    """Send fresh setpoints until one is received; return all received speeds (delayed ones are dropped)."""

    def received() -> bool:
        driver.send_setpoint(Setpoint.velocity((speed_mps, 0.0, 0.0), time.monotonic_ns()))
        return bool(autopilot.received_named(SETPOINT))

    await wait_until(received, 10.0, lambda: SETPOINT)
    return {message.vx for message in autopilot.received_named(SETPOINT)}


async def test_messages_queued_during_a_hang_are_dropped(
    port: int, autopilot: FakeAutopilot, caplog: pytest.LogCaptureFixture
) -> None:
    """MAVSDK passes its messages from its own thread, which continues while the loop hangs."""
    driver = open_driver("mavsdk", f"udpin://127.0.0.1:{port}")
    await driver.connect(10.0)
    try:
        driver.send_setpoint(Setpoint.velocity((1.0, 0.0, 0.0), time.monotonic_ns()))
        time.sleep(0.6)  # noqa: ASYNC251 the hang is what is tested
        assert await received_speeds(driver, autopilot, 2.0) == {2.0}
        assert "loop hung; " in caplog.text
    finally:
        await driver.close()


async def test_expired_setpoint_is_not_sent(
    driver: Driver, autopilot: FakeAutopilot, caplog: pytest.LogCaptureFixture
) -> None:
    """As after SIGCONT: the process was stopped after the streamer's freshness check."""
    now_ns = time.monotonic_ns()
    driver.send_setpoint(Setpoint.velocity((1.0, 0.0, 0.0), now_ns - 1_000_000_000))
    await wait_until(lambda: "setpoint dropped" in caplog.text, 10.0, lambda: caplog.text)
    assert await received_speeds(driver, autopilot, 2.0) == {2.0}


async def test_setpoint_delayed_before_sending_is_dropped(
    driver: Driver,
    autopilot: FakeAutopilot,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_ms = iter([1000, 1400, 2000, 2010])
    monkeypatch.setattr(driver, "_boot_ms", lambda: next(now_ms))
    driver.send_setpoint(Setpoint.velocity((1.0, 0.0, 0.0), time.monotonic_ns(), lifetime_s=2.0))
    await wait_until(lambda: "setpoint dropped" in caplog.text, 10.0, lambda: caplog.text)
    driver.send_setpoint(Setpoint.velocity((2.0, 0.0, 0.0), time.monotonic_ns()))
    (message,) = await autopilot.wait_for(SETPOINT)
    assert message.vx == 2.0


async def test_every_message_updates_the_state(driver: Driver, autopilot: FakeAutopilot) -> None:
    snapshots: list[VehicleState] = []
    unsubscribe = driver.subscribe(snapshots.append)
    half = math.sqrt(0.5)
    autopilot.send(mavlink.MAVLink_local_position_ned_message(5, 1.0, 2.0, -3.0, 0.5, 0.25, -0.125))
    autopilot.send(mavlink.MAVLink_attitude_quaternion_message(5, half, 0.0, 0.0, half, 0.1, 0.2, 0.3))
    autopilot.send(mavlink.MAVLink_extended_sys_state_message(0, 2))
    autopilot.send(
        mavlink.MAVLink_global_position_int_message(5, 473977500, 85455940, 491500, 3000, 0, 0, 0, 9000)
    )
    autopilot.send(mavlink.MAVLink_sys_status_message(0, 0, 0x1000_0000, 0, 0, 0, 80, 0, 0, 0, 0, 0, 0))
    autopilot.home()
    autopilot.base_mode = 157
    state = await wait_for_state(driver, lambda s: s.armed and s.home_altitude_amsl_m is not None)
    assert state.position_ned_m == (1.0, 2.0, -3.0)
    assert state.velocity_ned_mps == (0.5, 0.25, -0.125)
    assert state.yaw_rad == pytest.approx(math.pi / 2)
    assert state.angular_velocity_frd_radps == pytest.approx((0.1, 0.2, 0.3))
    assert state.landed is LandedState.IN_AIR
    assert state.ready_to_arm
    assert (state.latitude_deg, state.longitude_deg) == pytest.approx((47.39775, 8.545594))
    assert (state.altitude_amsl_m, state.home_altitude_amsl_m) == pytest.approx((491.5, 488.0))
    assert state.home_position_ned_m == (0.0, 0.0, 0.0)
    assert state.battery_fraction == pytest.approx(0.8)
    assert state.altitude_m == 3.0
    assert snapshots[-1] is driver.state
    unsubscribe()
    unsubscribe()
    count = len(snapshots)
    autopilot.custom_mode = OFFBOARD
    await wait_for_state(driver, lambda s: s.mode is FlightMode.OFFBOARD)
    assert len(snapshots) == count


async def test_failing_subscriber_does_not_affect_others(
    driver: Driver, autopilot: FakeAutopilot, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(_state: object) -> None:
        raise ZeroDivisionError

    seen: list[VehicleState] = []
    driver.subscribe(fails)
    driver.subscribe(seen.append)
    autopilot.custom_mode = OFFBOARD
    await wait_for_state(driver, lambda s: s.mode is FlightMode.OFFBOARD)
    await wait_until(lambda: bool(seen), 5.0)
    assert "subscriber" in caplog.text


async def test_current_mode_updates_before_the_heartbeat(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.sends_heartbeats = False
    payload = struct.pack("<IIB", OFFBOARD, OFFBOARD, 0)
    autopilot.send_bytes(pack_frame(CURRENT_MODE_ID, payload, system_id=1, component_id=1, sequence=9))
    await wait_for_state(driver, lambda s: s.mode is FlightMode.OFFBOARD)


async def test_modes_are_applied_in_their_order_of_arrival(driver: Driver, autopilot: FakeAutopilot) -> None:
    """Also by a library whose threads deliver one of the two messages later than the other."""
    autopilot.sends_heartbeats = False
    await wait_for_state(driver, lambda s: s.mode is FlightMode.HOLD)
    modes: list[FlightMode] = []
    driver.subscribe(lambda state: modes.append(state.mode))
    payload = struct.pack("<IIB", TAKEOFF, 0, 0)
    autopilot.send_bytes(pack_frame(CURRENT_MODE_ID, payload, system_id=1, component_id=1, sequence=9))
    autopilot.heartbeat()  # in hold
    autopilot.send(mavlink.MAVLink_local_position_ned_message(5, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
    await wait_for_state(driver, lambda s: s.position_ned_m is not None)
    assert [mode for mode, _ in groupby(modes)] == [FlightMode.TAKEOFF, FlightMode.HOLD]


async def test_messages_of_other_components_are_ignored(
    driver: Driver, autopilot: FakeAutopilot, port: int
) -> None:
    other_vehicle = FakeAutopilot(port, system_id=2)
    gimbal = FakeAutopilot(port, component_id=154)
    try:
        for other in (other_vehicle, gimbal):
            other.custom_mode = MISSION
            other.heartbeat()
            other.send(mavlink.MAVLink_local_position_ned_message(5, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0))
        autopilot.send(mavlink.MAVLink_local_position_ned_message(5, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
        state = await wait_for_state(driver, lambda s: s.position_ned_m is not None)
        assert state.position_ned_m == (1.0, 1.0, 1.0)
        assert state.mode is FlightMode.HOLD
    finally:
        await other_vehicle.stop()
        await gimbal.stop()


async def test_second_autopilot_at_another_address_is_ignored(
    driver: Driver, autopilot: FakeAutopilot, port: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    double = FakeAutopilot(port)
    try:
        double.custom_mode = MISSION
        double.heartbeat()
        double.send(mavlink.MAVLink_local_position_ned_message(5, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0))
        await wait_until(lambda: "a second autopilot 1/1" in caplog.text, 5.0)
        autopilot.send(mavlink.MAVLink_local_position_ned_message(5, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
        state = await wait_for_state(driver, lambda s: s.position_ned_m is not None)
        assert state.position_ned_m == (1.0, 1.0, 1.0)
        assert state.mode is FlightMode.HOLD
        driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
        await autopilot.wait_for(SETPOINT)
    finally:
        await double.stop()


async def test_nan_estimates_are_ignored(driver: Driver, autopilot: FakeAutopilot) -> None:
    nan = math.nan
    autopilot.send(mavlink.MAVLink_local_position_ned_message(5, nan, nan, nan, nan, nan, nan))
    autopilot.send(mavlink.MAVLink_attitude_quaternion_message(5, nan, nan, nan, nan, 0.0, 0.0, 0.0))
    autopilot.send(mavlink.MAVLink_home_position_message(0, 0, 488000, nan, nan, nan, [nan] * 4, 0, 0, 0))
    state = await wait_for_state(driver, lambda s: s.home_altitude_amsl_m == 488.0)
    assert state.position_ned_m is None
    assert state.attitude is None
    assert state.home_position_ned_m is None


async def test_noise_between_messages_loses_none(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.send_bytes(b"\xfd\xff\x00 no frame at all \xfe\x09")
    autopilot.send_bytes(bytes(range(256)) * 8)
    autopilot.send_bytes(b"")
    autopilot.send(mavlink.MAVLink_local_position_ned_message(5, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0))
    await wait_for_state(driver, lambda s: s.position_ned_m == (1.0, 2.0, 3.0))


def test_mode_command_is_on_the_link_at_once_and_in_order(kind: DriverKind) -> None:
    """So an answered TIMESYNC request that was sent after it shows that it has arrived or is lost."""
    scripted = ScriptedDriver(kind)
    scripted.heartbeat()
    for confirmation in (0, 1):
        scripted.driver._send_once(mavlink.MAV_CMD_NAV_TAKEOFF, (math.nan, 2.5), confirmation)
        scripted.driver._transmit_payload(mavlink.MAVLINK_MSG_ID_TIMESYNC, bytes(18))
    frames = scripted.taken()
    assert [frame.message_id for frame in frames] == 2 * [
        mavlink.MAVLINK_MSG_ID_COMMAND_LONG,
        mavlink.MAVLINK_MSG_ID_TIMESYNC,
    ]
    commands = [mavlink.MAVLink(None).decode(bytearray(frame.raw)) for frame in frames[::2]]
    for confirmation, command in enumerate(commands):
        assert (command.get_srcSystem(), command.get_srcComponent()) == scripted.driver.own_address
        assert (command.target_system, command.target_component) == (1, 1)
        assert (command.command, command.confirmation) == (mavlink.MAV_CMD_NAV_TAKEOFF, confirmation)
        assert math.isnan(command.param1)
        assert (command.param2, command.param3, command.param7) == (2.5, 0.0, 0.0)
