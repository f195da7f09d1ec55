"""What both drivers put on the wire and make of what comes, against a real socket."""

from __future__ import annotations

import asyncio
import logging
import math
import struct
import time

import pytest
from fake_autopilot import MISSION, OFFBOARD, FakeAutopilot, free_port, state_shows, wait_until
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle import flight_commands, stream_requests
from companion.vehicle.driver import CommandRefusedError, LinkError, SystemStatus
from companion.vehicle.drivers import open_driver
from companion.vehicle.framing import CURRENT_MODE_ID, pack_frame
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState


@pytest.fixture(autouse=True)
def short_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    """How long the rates of the streams are measured before any is asked for."""
    monkeypatch.setattr(stream_requests, "_MEASURE_S", 0.3)


SETPOINT = "SET_POSITION_TARGET_LOCAL_NED"


async def test_a_velocity_setpoint_is_one_message_with_px4s_type_mask(driver, autopilot) -> None:
    now_ns = time.monotonic_ns()
    driver.send_setpoint(Setpoint.velocity((1.5, -2.0, 0.25), now_ns, yaw_rate_radps=0.5))
    (message,) = await autopilot.hears(SETPOINT)
    assert (message.vx, message.vy, message.vz, message.yaw_rate) == (1.5, -2.0, 0.25, 0.5)
    assert message.type_mask == 0b0101_1100_0111
    assert message.coordinate_frame == mavlink.MAV_FRAME_LOCAL_NED
    assert (message.target_system, message.target_component) == (1, 1)
    assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)


async def test_a_position_setpoint_keeps_its_yaw_and_ignores_velocity(driver, autopilot) -> None:
    driver.send_setpoint(Setpoint.position((10.0, 20.0, -5.0), time.monotonic_ns(), yaw_rad=1.25))
    (message,) = await autopilot.hears(SETPOINT)
    assert (message.x, message.y, message.z, message.yaw) == (10.0, 20.0, -5.0, 1.25)
    assert message.type_mask == 0b1001_1111_1000


async def test_every_setpoint_leaves_exactly_once_and_nothing_is_repeated(driver, autopilot) -> None:
    for north in range(5):
        driver.send_setpoint(Setpoint.velocity((float(north), 0.0, 0.0), time.monotonic_ns()))
    await autopilot.hears(SETPOINT, 5)
    # A repeating sender (MAVSDK's runs at 20 Hz) would have put 20 more before these heartbeats pass.
    for count in range(1, 11):
        driver.send_heartbeat(SystemStatus.ACTIVE)
        await autopilot.hears("HEARTBEAT", count)
        await asyncio.sleep(0.1)
    assert [message.vx for message in autopilot.heard_named(SETPOINT)] == [0.0, 1.0, 2.0, 3.0, 4.0]


async def test_the_only_heartbeats_on_the_wire_are_ours_and_no_sequence_number_is_missing(
    driver, autopilot
) -> None:
    driver.send_heartbeat(SystemStatus.CRITICAL)
    # Long enough for MAVSDK's own heartbeat, which comes every second, to have come.
    await autopilot.hears("COMMAND_LONG", 3)
    await asyncio.sleep(1.2)
    driver.send_heartbeat(SystemStatus.ACTIVE)
    beats = await autopilot.hears("HEARTBEAT", 2)
    assert [(beat.type, beat.autopilot, beat.system_status) for beat in beats] == [(18, 8, 5), (18, 8, 4)]
    sequences = [message.get_seq() for message, _ in autopilot.heard]
    assert sequences == [number % 256 for number in range(len(sequences))]


async def test_a_loop_that_hangs_sends_nothing(driver, autopilot) -> None:
    driver.send_setpoint(Setpoint.velocity((1.0, 0.0, 0.0), time.monotonic_ns()))
    driver.send_heartbeat(SystemStatus.ACTIVE)
    await autopilot.hears(SETPOINT)
    await autopilot.hears("HEARTBEAT")
    before = len(autopilot.heard)
    time.sleep(1.5)  # noqa: ASYNC251 the hang is what is tested
    autopilot.listen()
    assert len(autopilot.heard) == before


async def test_what_waited_for_a_hung_loop_does_not_arrive_late(port, autopilot, caplog) -> None:
    """MAVSDK hands its messages over from a thread of its own, which goes on while the loop hangs."""
    driver = open_driver("mavsdk", f"udpin://127.0.0.1:{port}")
    await driver.connect(10.0)
    try:
        driver.send_setpoint(Setpoint.velocity((1.0, 0.0, 0.0), time.monotonic_ns()))
        time.sleep(0.6)  # noqa: ASYNC251 the hang is what is tested
        driver.send_setpoint(Setpoint.velocity((2.0, 0.0, 0.0), time.monotonic_ns()))
        (message,) = await autopilot.hears(SETPOINT)
        assert message.vx == 2.0
        assert "the loop hung" in caplog.text
    finally:
        await driver.close()


async def test_the_state_follows_every_kind_of_message(driver, autopilot) -> None:
    snapshots = []
    unsubscribe = driver.subscribe(snapshots.append)
    half = math.sqrt(0.5)
    autopilot.say(mavlink.MAVLink_local_position_ned_message(5, 1.0, 2.0, -3.0, 0.5, 0.25, -0.125))
    autopilot.say(mavlink.MAVLink_attitude_quaternion_message(5, half, 0.0, 0.0, half, 0.1, 0.2, 0.3))
    autopilot.say(mavlink.MAVLink_extended_sys_state_message(0, 2))
    autopilot.say(
        mavlink.MAVLink_global_position_int_message(5, 473977500, 85455940, 491500, 3000, 0, 0, 0, 9000)
    )
    autopilot.say(mavlink.MAVLink_sys_status_message(0, 0, 0x1000_0000, 0, 0, 0, 80, 0, 0, 0, 0, 0, 0))
    autopilot.home()
    autopilot.base_mode = 157
    state = await state_shows(driver, lambda s: s.armed and s.home_altitude_amsl_m is not None)
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
    await state_shows(driver, lambda s: s.mode is FlightMode.OFFBOARD)
    assert len(snapshots) == count


async def test_a_subscriber_that_fails_harms_nobody_else(driver, autopilot, caplog) -> None:
    def fails(_state: object) -> None:
        raise ZeroDivisionError

    seen = []
    driver.subscribe(fails)
    driver.subscribe(seen.append)
    autopilot.custom_mode = OFFBOARD
    await state_shows(driver, lambda s: s.mode is FlightMode.OFFBOARD)
    await wait_until(lambda: bool(seen), 5.0)
    assert "a subscriber of the state failed" in caplog.text


async def test_current_mode_shows_a_mode_before_the_heartbeat_does(driver, autopilot) -> None:
    autopilot.beating = False
    payload = struct.pack("<IIB", OFFBOARD, OFFBOARD, 0)
    autopilot.say_bytes(pack_frame(CURRENT_MODE_ID, payload, system_id=1, component_id=1, sequence=9))
    await state_shows(driver, lambda s: s.mode is FlightMode.OFFBOARD)


async def test_messages_of_other_systems_and_components_change_nothing(driver, autopilot, port) -> None:
    stranger = FakeAutopilot(port, system_id=2)
    gimbal = FakeAutopilot(port, component_id=154)
    try:
        for other in (stranger, gimbal):
            other.custom_mode = MISSION
            other.heartbeat()
            other.say(mavlink.MAVLink_local_position_ned_message(5, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0))
        autopilot.say(mavlink.MAVLink_local_position_ned_message(5, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
        state = await state_shows(driver, lambda s: s.position_ned_m is not None)
        assert state.position_ned_m == (1.0, 1.0, 1.0)
        assert state.mode is FlightMode.HOLD
    finally:
        await stranger.stop()
        await gimbal.stop()


async def test_a_second_autopilot_of_the_same_id_is_ignored_and_named(
    driver, autopilot, port, caplog
) -> None:
    caplog.set_level(logging.INFO)
    double = FakeAutopilot(port)
    try:
        double.custom_mode = MISSION
        double.heartbeat()
        double.say(mavlink.MAVLink_local_position_ned_message(5, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0))
        await wait_until(lambda: "a second autopilot 1/1" in caplog.text, 5.0)
        autopilot.say(mavlink.MAVLink_local_position_ned_message(5, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
        state = await state_shows(driver, lambda s: s.position_ned_m is not None)
        assert state.position_ned_m == (1.0, 1.0, 1.0)
        assert state.mode is FlightMode.HOLD
        driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
        await autopilot.hears(SETPOINT)
    finally:
        await double.stop()


async def test_an_estimate_that_is_not_a_number_is_no_estimate(driver, autopilot) -> None:
    nan = math.nan
    autopilot.say(mavlink.MAVLink_local_position_ned_message(5, nan, nan, nan, nan, nan, nan))
    autopilot.say(mavlink.MAVLink_attitude_quaternion_message(5, nan, nan, nan, nan, 0.0, 0.0, 0.0))
    autopilot.say(mavlink.MAVLink_home_position_message(0, 0, 488000, nan, nan, nan, [nan] * 4, 0, 0, 0))
    state = await state_shows(driver, lambda s: s.home_altitude_amsl_m == 488.0)
    assert state.position_ned_m is None
    assert state.attitude is None
    assert state.home_position_ned_m is None


async def test_noise_between_the_messages_costs_no_message(driver, autopilot) -> None:
    autopilot.say_bytes(b"\xfd\xff\x00 no frame at all \xfe\x09")
    autopilot.say_bytes(bytes(range(256)) * 8)
    autopilot.say_bytes(b"")
    autopilot.say(mavlink.MAVLink_local_position_ned_message(5, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0))
    await state_shows(driver, lambda s: s.position_ned_m == (1.0, 2.0, 3.0))


# --- commands ---------------------------------------------------------------------------------------


async def test_arming_returns_when_the_vehicle_shows_it(driver, autopilot) -> None:
    asyncio.get_running_loop().call_later(0.5, setattr, autopilot, "base_mode", 157)
    await driver.arm()
    assert driver.state.armed
    arm = next(m for m in autopilot.heard_named("COMMAND_LONG") if m.command == 400)
    assert (arm.param1, arm.param2) == (1.0, 0.0)


async def test_a_refused_arming_says_why(driver, autopilot) -> None:
    autopilot.answers["COMMAND_LONG"] = lambda m: autopilot.acknowledge(m.command, 1)
    with pytest.raises(
        CommandRefusedError, match=r"refused to arm \(temporarily rejected\): its pre-arm checks fail"
    ):
        await driver.arm()


async def test_a_mode_is_believed_when_shown_and_not_when_acknowledged(driver, autopilot) -> None:
    with pytest.raises(CommandRefusedError, match=r"did not enter mode mission within 0\.5 s: it shows hold"):
        await driver.set_mode(FlightMode.MISSION, timeout_s=0.5)


async def test_the_second_acknowledgement_refuses_at_once(driver, autopilot) -> None:
    def twice(message) -> None:
        autopilot.acknowledge(message.command, 0)
        if message.command == 176:
            autopilot.acknowledge(176, 1)

    autopilot.answers["COMMAND_LONG"] = twice
    with pytest.raises(CommandRefusedError, match=r"refused mode offboard .*setpoint stream.*shows hold"):
        await driver.set_mode(FlightMode.OFFBOARD, timeout_s=60.0)


async def test_a_mode_asked_for_goes_out_as_main_and_sub_mode(driver, autopilot) -> None:
    def obey(message) -> None:
        autopilot.acknowledge(message.command)
        if message.command == 176:
            autopilot.custom_mode = int(message.param2) << 16 | int(message.param3) << 24

    autopilot.answers["COMMAND_LONG"] = obey
    for mode in (FlightMode.OFFBOARD, FlightMode.LAND, FlightMode.RETURN, FlightMode.HOLD):
        await driver.set_mode(mode)
        assert driver.state.mode is mode
    asked = [
        (m.param1, m.param2, m.param3) for m in autopilot.heard_named("COMMAND_LONG") if m.command == 176
    ]
    assert asked == [(1, 6, 0), (1, 4, 6), (1, 4, 5), (1, 4, 3)]
    with pytest.raises(ValueError, match="unknown is not a mode"):
        await driver.set_mode(FlightMode.UNKNOWN)


async def test_takeoff_goes_to_a_height_above_home(driver, autopilot) -> None:
    asyncio.get_running_loop().call_later(0.3, autopilot.home, 488.5)
    await driver.takeoff(4.0)
    (message,) = [m for m in autopilot.heard_named("COMMAND_LONG") if m.command == 22]
    assert message.param7 == 492.5
    assert all(math.isnan(getattr(message, f"param{number}")) for number in range(1, 7))


async def test_takeoff_without_a_known_home_is_refused_here(driver, autopilot, monkeypatch) -> None:
    monkeypatch.setattr(flight_commands, "_SHOWN_TIMEOUT_S", 0.2)
    with pytest.raises(CommandRefusedError, match="needs home's altitude"):
        await driver.takeoff(4.0)
    with pytest.raises(CommandRefusedError, match="above 0 m"):
        await driver.takeoff(-1.0)
    assert not [m for m in autopilot.heard_named("COMMAND_LONG") if m.command == 22]


async def test_an_unanswered_command_is_sent_again_and_then_given_up(driver, autopilot) -> None:
    autopilot.answers.clear()
    with pytest.raises(CommandRefusedError, match="does not answer command 400"):
        await driver.arm()
    attempts = [m.confirmation for m in autopilot.heard_named("COMMAND_LONG") if m.command == 400]
    assert len(attempts) >= 3


async def test_a_command_in_progress_is_waited_for(driver, autopilot) -> None:
    def slowly(message) -> None:
        autopilot.acknowledge(message.command, 5)
        asyncio.get_running_loop().call_later(1.1, autopilot.acknowledge, message.command, 0)

    autopilot.answers["COMMAND_LONG"] = slowly
    autopilot.base_mode = 157
    await driver.arm()
    assert len([m for m in autopilot.heard_named("COMMAND_LONG") if m.command == 400]) == 1


async def test_acknowledgements_for_another_component_are_not_ours(driver, autopilot) -> None:
    def to_another(message) -> None:
        autopilot.say(mavlink.MAVLink_command_ack_message(message.command, 2, 0, 0, 255, 190))
        autopilot.acknowledge(message.command, 0)

    autopilot.answers["COMMAND_LONG"] = to_another
    autopilot.base_mode = 157
    await driver.arm()


async def test_streams_that_come_too_slowly_are_asked_for(driver, autopilot) -> None:
    def intervals() -> dict[float, float]:
        return {m.param1: m.param2 for m in autopilot.heard_named("COMMAND_LONG") if m.command == 511}

    await wait_until(lambda: len(intervals()) >= 6, 10.0, intervals)
    assert intervals()[31] == 20000
    assert intervals()[CURRENT_MODE_ID] == 100000


async def test_commands_under_way_fail_when_the_driver_is_closed(driver, autopilot) -> None:
    autopilot.answers.clear()
    arming = asyncio.create_task(driver.arm())
    await wait_until(lambda: any(m.command == 400 for m in autopilot.heard_named("COMMAND_LONG")), 5.0)
    await driver.close()
    with pytest.raises(CommandRefusedError):
        await arming


# --- parameters -------------------------------------------------------------------------------------


@pytest.fixture
def parameters(autopilot) -> dict[str, tuple[int, bytes]]:
    """name → (MAV_PARAM_TYPE, the four bytes): PX4's bytewise encoding."""
    stored = {"COM_OF_LOSS_T": (9, struct.pack("<f", 1.0)), "COM_OBL_RC_ACT": (6, struct.pack("<i", 0))}

    def tell(name: str) -> None:
        if name not in stored:
            autopilot.say(mavlink.MAVLink_param_error_message(1, 191, name.encode(), -1, 1))
            return
        kind, value = stored[name]
        payload = value + struct.pack("<HH16sB", len(stored), 0, name.encode(), kind)
        autopilot.say_bytes(pack_frame(22, payload, system_id=1, component_id=1, sequence=0))

    def take(message) -> None:
        frame = next(raw for heard, raw in reversed(autopilot.heard) if heard is message)
        stored[message.param_id] = (message.param_type, frame[10:14].ljust(4, b"\0"))
        tell(message.param_id)

    autopilot.answers["PARAM_REQUEST_READ"] = lambda m: tell(m.param_id)
    autopilot.answers["PARAM_SET"] = take
    return stored


async def test_parameters_keep_their_type(driver, parameters) -> None:
    assert await driver.get_parameter("COM_OF_LOSS_T") == 1.0
    await driver.set_parameter("COM_OF_LOSS_T", 0.5)
    await driver.set_parameter("COM_OBL_RC_ACT", 4.0)
    assert parameters["COM_OF_LOSS_T"] == (9, struct.pack("<f", 0.5))
    assert parameters["COM_OBL_RC_ACT"] == (6, struct.pack("<i", 4))
    assert await driver.get_parameter("COM_OBL_RC_ACT") == 4.0


@pytest.mark.parametrize("value", [-1, -5_000_000, 2**31 - 1])
async def test_integers_travel_as_bytes_whatever_float_they_look_like(driver, parameters, value) -> None:
    await driver.set_parameter("COM_OBL_RC_ACT", value)
    assert parameters["COM_OBL_RC_ACT"] == (6, struct.pack("<i", value))
    assert await driver.get_parameter("COM_OBL_RC_ACT") == value


async def test_a_parameter_that_is_not_there_is_refused_by_name(driver, parameters) -> None:
    with pytest.raises(CommandRefusedError, match="COM_NOT_THERE: there is no such parameter"):
        await driver.get_parameter("COM_NOT_THERE")
    with pytest.raises(CommandRefusedError, match="16 characters"):
        await driver.get_parameter("A_NAME_LONGER_THAN_16")
    with pytest.raises(CommandRefusedError, match=r"is an integer and cannot take 0\.5"):
        await driver.set_parameter("COM_OBL_RC_ACT", 0.5)


# --- connecting and losing --------------------------------------------------------------------------


async def test_no_autopilot_is_said_in_one_line(kind, port) -> None:
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    with pytest.raises(LinkError) as caught:
        await driver.connect(0.3)
    text = str(caught.value)
    assert text.startswith(f"no autopilot answered on udpin://127.0.0.1:{port} within 0.3 s")
    assert "\n" not in text
    await driver.close()


async def test_heartbeats_of_others_are_no_autopilot_but_are_named(kind, port) -> None:
    station = FakeAutopilot(port, system_id=255, component_id=190, autopilot=8)
    station.start()
    try:
        with pytest.raises(LinkError, match="heard only system/component 255/190"):
            await open_driver(kind, f"udpin://127.0.0.1:{port}").connect(0.5)
    finally:
        await station.stop()


async def test_the_wanted_system_is_waited_for(kind, port, autopilot) -> None:
    second = FakeAutopilot(port, system_id=7)
    second.start()
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}", system_id=7)
    try:
        await driver.connect(10.0)
        driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
        (message,) = await second.hears(SETPOINT)
        assert message.target_system == 7
    finally:
        await driver.close()
        await second.stop()
    with pytest.raises(LinkError, match="no autopilot of system 9 answered"):
        await open_driver(kind, f"udpin://127.0.0.1:{port}", system_id=9).connect(0.5)


@pytest.mark.parametrize(
    ("kind", "autopilot_kind", "reason"),
    [
        (
            "mavsdk",
            3,
            'the mavsdk driver flies PX4 alone, and system 1 is ArduPilot; set vehicle.driver = "py',
        ),
        ("pymavlink", 0, "only PX4 and ArduPilot are flown, and system 1 is a generic autopilot"),
    ],
)
async def test_an_autopilot_that_a_driver_cannot_fly_is_refused_in_one_line(
    kind, autopilot_kind, reason, port
) -> None:
    other = FakeAutopilot(port, autopilot=autopilot_kind)
    other.start()
    try:
        with pytest.raises(LinkError, match=reason):
            await open_driver(kind, f"udpin://127.0.0.1:{port}").connect(5.0)
    finally:
        await other.stop()


async def test_a_busy_port_is_named_with_its_likely_holder(kind, driver, port) -> None:
    with pytest.raises(LinkError, match=rf"UDP port {port} is in use: another program .*QGroundControl"):
        await open_driver(kind, f"udpin://127.0.0.1:{port}").connect(5.0)


async def test_closing_twice_frees_the_port_and_the_driver_can_connect_again(kind, port, autopilot) -> None:
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    await driver.close()
    for _ in range(3):
        await driver.connect(10.0)
        assert driver.state.mode is FlightMode.HOLD
        await driver.close()
        await driver.close()
    driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
    driver.send_heartbeat(SystemStatus.ACTIVE)
    with pytest.raises(CommandRefusedError, match="not connected"):
        await driver.arm()
    with pytest.raises(CommandRefusedError, match="not connected"):
        await driver.get_parameter("COM_OF_LOSS_T")


async def test_connecting_can_be_cancelled(kind, port) -> None:
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    connecting = asyncio.create_task(driver.connect(60.0))
    await asyncio.sleep(0)
    connecting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await connecting
    await driver.close()


async def test_an_autopilot_that_restarted_is_asked_for_its_streams_anew(driver, autopilot) -> None:
    def asked() -> int:
        return sum(
            m.command == 511 and m.param1 == CURRENT_MODE_ID for m in autopilot.heard_named("COMMAND_LONG")
        )

    autopilot.say(mavlink.MAVLink_local_position_ned_message(60_000, 0, 0, 0, 0, 0, 0))
    await wait_until(lambda: asked() == 1, 10.0)
    autopilot.say(mavlink.MAVLink_local_position_ned_message(500, 0, 0, 0, 0, 0, 0))
    await wait_until(lambda: asked() == 2, 10.0)


async def test_two_drivers_fly_two_vehicles_at_once(kind, driver, autopilot) -> None:
    port = free_port()
    other = FakeAutopilot(port, system_id=2)
    other.start()
    second = open_driver(kind, f"udpin://127.0.0.1:{port}", own_component_id=192)
    try:
        await second.connect(10.0)
        driver.send_setpoint(Setpoint.velocity((1.0, 0.0, 0.0), time.monotonic_ns()))
        second.send_setpoint(Setpoint.velocity((2.0, 0.0, 0.0), time.monotonic_ns()))
        (first_heard,) = await autopilot.hears(SETPOINT)
        (second_heard,) = await other.hears(SETPOINT)
        assert (first_heard.vx, first_heard.get_srcComponent()) == (1.0, 191)
        assert (second_heard.vx, second_heard.get_srcComponent()) == (2.0, 192)
    finally:
        await second.close()
        await other.stop()


async def test_a_vehicle_that_waits_to_be_spoken_to_is_spoken_to(kind, port) -> None:
    """udpout: the vehicle listens, and answers whoever sent to it."""
    vehicle = FakeAutopilot(port)
    vehicle.beating = False
    vehicle.answers["HEARTBEAT"] = lambda _: setattr(vehicle, "beating", True)
    vehicle.start()
    driver = open_driver(kind, f"udpout://127.0.0.1:{vehicle.socket.getsockname()[1]}")
    try:
        await driver.connect(10.0)
        driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
        await vehicle.hears(SETPOINT)
    finally:
        await driver.close()
        await vehicle.stop()


def test_a_driver_that_does_not_exist_and_bad_urls_and_ids_are_refused_when_opened() -> None:
    with pytest.raises(ValueError, match="there is no driver 'dronekit'; there are: mavsdk, pymavlink"):
        open_driver("dronekit", "udpin://0.0.0.0:14540")
    with pytest.raises(ValueError, match="is not a link url"):
        open_driver("mavsdk", "14540")
    with pytest.raises(ValueError, match=r"system_id must be 1\.\.255, got 0"):
        open_driver("mavsdk", "udpin://0.0.0.0:14540", system_id=0)
    with pytest.raises(ValueError, match=r"own_component_id must be 1\.\.255"):
        open_driver("pymavlink", "udpin://0.0.0.0:14540", own_component_id=256)
