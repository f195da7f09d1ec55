"""Only listed types of vehicles are flown: by the table, by both drivers, and by guidance."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.drivers import DriverKind, open_driver
from companion.vehicle.framing import Frame
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.mavsdk_driver import MavsdkDriver
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, VehicleState
from companion.vehicle.vehicle_type import (
    MULTICOPTERS,
    PROGRAM_MISSING,
    VTOL_STATE_MISSING,
    VTOLS,
    VtolState,
    type_text,
    why_not_flown,
)
from companion.vehicle.vision_position import VisionPosition
from tests.companion.vehicle.fake_autopilot import SETPOINT, FakeAutopilot, wait_for_state
from tests.companion.vehicle.scripted_link import ARDUPILOT, PX4, QUADROTOR, ScriptedDriver

FIXED_WING, ROVER, TAILSITTER, TILTROTOR = 1, 10, 20, 21
# MAVLink common, from its own definitions; the table of the package has its own numbers.
COPTERS = {
    mavlink.MAV_TYPE_QUADROTOR,
    mavlink.MAV_TYPE_COAXIAL,
    mavlink.MAV_TYPE_HELICOPTER,
    mavlink.MAV_TYPE_HEXAROTOR,
    mavlink.MAV_TYPE_OCTOROTOR,
    mavlink.MAV_TYPE_TRICOPTER,
    mavlink.MAV_TYPE_DODECAROTOR,
    mavlink.MAV_TYPE_DECAROTOR,
}
HOVERING_TYPES = set(range(mavlink.MAV_TYPE_VTOL_DUOROTOR, mavlink.MAV_TYPE_VTOL_RESERVED5 + 1))
UNDEFINED, MC, FW = VtolState.UNDEFINED, VtolState.MC, VtolState.FW
VTOL_STATES = (None, *VtolState)
PROGRAMS = (None, False, True)  # is_plane
# What moves a vehicle, arms it or changes how it flies.
FORBIDDEN_MESSAGES = {
    mavlink.MAVLINK_MSG_ID_SET_MODE,
    mavlink.MAVLINK_MSG_ID_PARAM_SET,
    mavlink.MAVLINK_MSG_ID_MANUAL_CONTROL,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS_OVERRIDE,
    mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET,
    mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
    mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT,
    mavlink.MAVLINK_MSG_ID_LANDING_TARGET,
    mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE,
    mavlink.MAVLINK_MSG_ID_OBSTACLE_DISTANCE,
    mavlink.MAVLINK_MSG_ID_MISSION_ITEM_INT,
}
ALLOWED_COMMANDS = {
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
    mavlink.MAV_CMD_REQUEST_MESSAGE,
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
    mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
    mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE,
}


COMMANDS = (
    *ALLOWED_COMMANDS,
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH,
    mavlink.MAV_CMD_NAV_LAND,
    mavlink.MAV_CMD_NAV_TAKEOFF,
    mavlink.MAV_CMD_NAV_VTOL_TAKEOFF,
    mavlink.MAV_CMD_DO_SET_MODE,
    mavlink.MAV_CMD_DO_SET_HOME,
    mavlink.MAV_CMD_DO_SET_SERVO,
    mavlink.MAV_CMD_DO_REPOSITION,
    mavlink.MAV_CMD_DO_PAUSE_CONTINUE,
    mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN,
    mavlink.MAV_CMD_MISSION_START,
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
    mavlink.MAV_CMD_RUN_PREARM_CHECKS,
    mavlink.MAV_CMD_DO_VTOL_TRANSITION,
)


def flown(mav_type: int, autopilot: int, vtol_state: VtolState | None, is_plane: bool | None = False) -> bool:
    """The promise, in other words than the table's."""
    if autopilot == ARDUPILOT:
        return is_plane is False and mav_type in COPTERS and vtol_state in (UNDEFINED, MC)
    hovers = vtol_state in ((None, UNDEFINED, MC) if mav_type in COPTERS else (MC,))
    return autopilot == PX4 and mav_type in COPTERS | HOVERING_TYPES and hovers


def moves(frame: Frame) -> bool:
    """Whether a frame may move or arm the vehicle."""
    if frame.message_id in (mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT):
        return int.from_bytes(frame.padded(30)[28:], "little") not in ALLOWED_COMMANDS
    return frame.message_id in FORBIDDEN_MESSAGES


def test_table_has_the_types_of_mavlink() -> None:
    assert set(MULTICOPTERS) == COPTERS
    assert set(VTOLS) == HOVERING_TYPES
    assert len({type_text(number) for number in range(256)}) == 256


@pytest.mark.parametrize("autopilot", range(21))
def test_table_of_types_autopilots_and_vtol_states(autopilot: int) -> None:
    for mav_type in range(256):
        for vtol_state, is_plane in itertools.product(VTOL_STATES, PROGRAMS):
            why = why_not_flown(mav_type, autopilot, vtol_state, is_plane=is_plane)
            expected = flown(mav_type, autopilot, vtol_state, is_plane)
            assert (why is None) is expected, (mav_type, vtol_state, is_plane)


@pytest.mark.parametrize("vtol_state", VTOL_STATES)
@pytest.mark.parametrize("mav_type", [FIXED_WING, *sorted(HOVERING_TYPES)])
def test_quadplane_of_ardupilot_is_never_flown(mav_type: int, vtol_state: VtolState | None) -> None:
    for is_plane in PROGRAMS:
        assert why_not_flown(mav_type, ARDUPILOT, vtol_state, is_plane=is_plane) is not None


def test_quadplane_that_claims_to_be_a_quadrotor_is_never_flown() -> None:
    assert why_not_flown(QUADROTOR, ARDUPILOT, None, is_plane=False) == VTOL_STATE_MISSING
    assert why_not_flown(QUADROTOR, ARDUPILOT, MC) == PROGRAM_MISSING
    for vtol_state in VtolState:
        assert why_not_flown(QUADROTOR, ARDUPILOT, vtol_state, is_plane=True) is not None


def test_unknown_vtol_state_is_none(kind: DriverKind) -> None:
    scripted = ScriptedDriver(kind)
    scripted.heartbeat(TAILSITTER)
    scripted.vtol_state(MC)
    assert scripted.driver.state.not_flown is None
    scripted.vtol_state(9)
    assert scripted.driver.state.vtol_state is None
    assert scripted.driver.state.not_flown == VTOL_STATE_MISSING


@pytest.mark.parametrize("what", ["restart", "silence", "standstill"])
def test_hover_of_before_does_not_count(kind: DriverKind, what: str) -> None:
    scripted = ScriptedDriver(kind)
    scripted.heartbeat(TAILSITTER)
    scripted.vtol_state(MC)
    FORGET[what](scripted)
    if what == "silence":  # it ends with a heartbeat
        scripted.heartbeat(TAILSITTER)
    assert scripted.driver.state.not_flown == VTOL_STATE_MISSING
    every_message(scripted)
    assert not any(map(moves, scripted.taken()))
    scripted.heartbeat(TAILSITTER)
    scripted.vtol_state(MC)
    assert scripted.driver.state.not_flown is None


# --- both drivers -------------------------------------------------------------------------------------------


def landing_target() -> LandingTarget:
    now_ns = time.monotonic_ns()
    return LandingTarget(now_ns, 7, (0.0, 0.0, 3.0), (0.0, 0.0, 3.0), 0.2)


def packed() -> list[bytes]:
    codec, values = mavlink.MAVLink(None, 1, 191), [0.0] * 7
    commands = [mavlink.MAVLink_command_long_message(1, 1, number, 0, *values) for number in COMMANDS]
    others = [
        mavlink.MAVLink_command_int_message(
            1, 1, 0, mavlink.MAV_CMD_DO_REPOSITION, 0, 0, 0, 0, 0, 0, 0, 0, 0
        ),
        mavlink.MAVLink_set_mode_message(1, 1, 4),
        mavlink.MAVLink_param_set_message(1, 1, b"GUID_TIMEOUT", 1.0, 9),
        mavlink.MAVLink_manual_control_message(1, 0, 0, 0, 0, 0),
        mavlink.MAVLink_rc_channels_override_message(1, 1, *[1500] * 8),
        mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 0, [1, 0, 0, 0], 0, 0, 0, 0),
        mavlink.MAVLink_set_position_target_global_int_message(0, 1, 1, 6, 0, *[0] * 11),
        mavlink.MAVLink_mission_item_int_message(1, 1, 0, 0, 16, 0, 0, 0, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_set_home_position_message(1, 0, 0, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0),
    ]
    return [bytes(message.pack(codec)) for message in (*commands, *others)]


PACKED = packed()


def every_message(scripted: ScriptedDriver) -> None:
    """Pass every kind of message, as MAVSDK's library or our own code sends it."""
    for data in PACKED:
        if isinstance(scripted.driver, MavsdkDriver):
            scripted.driver._transmit_for_library(data, time.monotonic_ns())
        else:
            scripted.driver._transmit(data)
    for send in OWN_MESSAGES:
        send(scripted)


OWN_MESSAGES: tuple[Callable[[ScriptedDriver], None], ...] = (
    lambda s: s.driver._transmit_payload(mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED, fresh(s)),
    lambda s: s.driver.send_setpoint(Setpoint.brake(time.monotonic_ns())),
    lambda s: s.driver.send_landing_target(landing_target()),
    lambda s: s.driver.send_vision_position(VisionPosition(1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.1,) * 21)),
)


def fresh(scripted: ScriptedDriver) -> bytes:
    return scripted.driver._boot_ms().to_bytes(4, "little") + bytes(49)


@pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT])
def test_driver_sends_no_motion_to_an_unlisted_type(kind: DriverKind, autopilot: int) -> None:
    scripted = ScriptedDriver(kind)
    supported = autopilot in scripted.driver.supported_autopilots
    for mav_type in range(49):
        for vtol_state, is_plane in itertools.product(VTOL_STATES, PROGRAMS):
            scripted.heartbeat(mav_type, autopilot)
            scripted.driver._telemetry._invalidate()  # the autopilot has restarted
            if vtol_state is not None:
                scripted.vtol_state(vtol_state)
            scripted.program(is_plane=is_plane)
            every_message(scripted)
            frames = scripted.taken()
            expected = supported and flown(mav_type, autopilot, vtol_state, is_plane)
            assert any(moves(frame) for frame in frames) is expected, (mav_type, vtol_state, is_plane)
            assert {frame.message_id for frame in frames} >= {mavlink.MAVLINK_MSG_ID_COMMAND_LONG}


HARMLESS, MODE = PACKED[COMMANDS.index(mavlink.MAV_CMD_REQUEST_MESSAGE)], PACKED[-8]
WRONG_CHECKSUM = bytes((*MODE[:-1], MODE[-1] ^ 1))
NO_HARMLESS = {
    "wrong checksum": WRONG_CHECKSUM,
    "cut": MODE[:-1],
    "no frame": b"mode",
    "second frame": HARMLESS + MODE,
    "second with a wrong checksum": HARMLESS + WRONG_CHECKSUM,
}


@pytest.mark.parametrize("data", NO_HARMLESS.values(), ids=NO_HARMLESS)
def test_what_is_no_harmless_frame_is_withheld(kind: DriverKind, data: bytes) -> None:
    scripted = ScriptedDriver(kind)
    scripted.heartbeat(FIXED_WING)
    scripted.driver._transmit(data)
    assert scripted.link.sent == []
    scripted.driver._transmit(HARMLESS + HARMLESS)
    assert scripted.link.sent == [HARMLESS + HARMLESS]


@pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT])
async def test_driver_refuses_commands_with_the_reason(kind: DriverKind, autopilot: int) -> None:
    scripted = ScriptedDriver(kind)
    scripted.heartbeat(FIXED_WING, autopilot)
    driver = scripted.driver
    for request in (
        driver.arm(),
        driver.disarm(),
        driver.set_mode(FlightMode.HOLD),
        driver.takeoff(5.0),
        driver.set_parameter("GUID_TIMEOUT", 1.0),
    ):
        with pytest.raises(CommandRefusedError, match=r"MAV_TYPE 1\)"):
            await request
    assert scripted.taken() == []


@pytest.mark.parametrize(("first", "second"), [(PX4, ARDUPILOT), (ARDUPILOT, PX4), (PX4, 0), (PX4, 4)])
def test_another_autopilot_on_the_link_is_not_flown(kind: DriverKind, first: int, second: int) -> None:
    scripted = ScriptedDriver(kind)
    for autopilot, expected in ((first, True), (second, False), (first, True)):
        scripted.heartbeat(autopilot=autopilot)
        scripted.vtol_state(UNDEFINED)
        scripted.program()
        every_message(scripted)
        may_move = expected and first in scripted.driver.supported_autopilots
        assert any(moves(frame) for frame in scripted.taken()) is may_move


def test_heartbeat_that_is_no_autopilots_changes_nothing(kind: DriverKind) -> None:
    scripted = ScriptedDriver(kind)
    scripted.heartbeat()
    scripted.heartbeat(ROVER, mavlink.MAV_AUTOPILOT_INVALID)
    assert scripted.driver.state.not_flown is None


@pytest.mark.parametrize("mav_type", [FIXED_WING, ROVER, TILTROTOR, QUADROTOR])
def test_modes_of_another_ardupilot_are_unknown(mav_type: int) -> None:
    scripted = ScriptedDriver("pymavlink")
    scripted.heartbeat(mav_type, ARDUPILOT, mode=17)
    scripted.vtol_state(FW if mav_type == QUADROTOR else UNDEFINED)
    scripted.heartbeat(mav_type, ARDUPILOT, mode=17)  # QSTABILIZE in Plane
    assert scripted.driver.state.mode is FlightMode.UNKNOWN


STEPS = st.one_of(
    st.tuples(
        st.just("heartbeat"),
        st.sampled_from([QUADROTOR, FIXED_WING, ROVER, TAILSITTER, TILTROTOR, 0]),
        st.sampled_from([PX4, PX4, ARDUPILOT, 0, mavlink.MAV_AUTOPILOT_INVALID]),
    ),
    st.tuples(st.just("vtol_state"), st.sampled_from(VtolState), st.just(0)),
    st.tuples(st.just("program"), st.booleans(), st.just(0)),
    st.tuples(st.just("forget"), st.sampled_from(["restart", "silence", "standstill"]), st.just(0)),
    st.tuples(st.just("request"), st.integers(0, 7), st.just(0)),
)


@pytest.mark.parametrize("first", [PX4, ARDUPILOT])
@given(steps=st.lists(STEPS, max_size=12))
def test_nothing_moves_while_the_newest_type_is_unlisted(
    first: int, steps: list[tuple[str, Any, int]]
) -> None:
    asyncio.run(play(first, steps))


async def play(first: int, steps: list[tuple[str, Any, int]]) -> None:
    scripted = ScriptedDriver("pymavlink")
    driver, newest, vtol_state, is_plane = scripted.driver, (QUADROTOR, first), None, None
    scripted.heartbeat(*newest)
    driver._telemetry.handle("HOME_POSITION", {"altitude": 0, "latitude": 0, "longitude": 0, **NOWHERE})
    requests = (
        driver.arm,
        driver.disarm,
        lambda: driver.set_mode(FlightMode.OFFBOARD),
        lambda: driver.set_mode(FlightMode.HOLD),
        lambda: driver.takeoff(5.0),
    )
    tasks: list[asyncio.Task[None]] = []
    for step, value, autopilot in steps:
        if step == "heartbeat":
            scripted.heartbeat(value, autopilot)
            if autopilot != mavlink.MAV_AUTOPILOT_INVALID:
                newest = (value, autopilot)
        elif step == "vtol_state":
            vtol_state = VtolState(value)
            scripted.vtol_state(value)
        elif step == "program":
            is_plane = bool(value)
            scripted.program(is_plane=is_plane)
        elif step == "forget":
            vtol_state = is_plane = None
            FORGET[value](scripted)
            scripted.heartbeat(*newest)
        elif value < len(requests):
            tasks.append(asyncio.create_task(suppressed(requests[value])))
        else:
            OWN_MESSAGES[value - len(requests)](scripted)
        for _ in range(4):
            await asyncio.sleep(0)
        may_move = newest[1] == first and flown(*newest, vtol_state, is_plane)
        assert may_move or not any(map(moves, scripted.taken()))
        scripted.taken()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def silence(scripted: ScriptedDriver) -> None:
    telemetry = scripted.driver._telemetry
    telemetry.state = replace(telemetry.state, heartbeat_ns=time.monotonic_ns() - 4_000_000_000)


FORGET: dict[str, Callable[[ScriptedDriver], None]] = {
    "restart": lambda scripted: scripted.driver._telemetry._invalidate(),
    "silence": silence,
    "standstill": lambda scripted: scripted.driver.discard_received(),
}
NOWHERE = {"x": 0.0, "y": 0.0, "z": 0.0}


async def suppressed(request: Callable[[], object]) -> None:
    with contextlib.suppress(CommandRefusedError):
        await request()  # type: ignore[misc]  # a coroutine


@pytest.mark.realtime
async def test_repeated_command_ends_with_a_change_of_type(kind: DriverKind, port: int) -> None:
    autopilot = FakeAutopilot(port)
    autopilot.answers.clear()
    autopilot.start()
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    try:
        await driver.connect(10.0)
        request = asyncio.create_task(driver.set_mode(FlightMode.LAND))
        await autopilot.wait_for_command(mavlink.MAV_CMD_DO_SET_MODE)
        autopilot.mav_type = FIXED_WING
        await wait_for_state(driver, lambda state: state.not_flown is not None)
        before = commands(autopilot)
        driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
        with pytest.raises(CommandRefusedError):
            await request
        assert commands(autopilot) == before
        assert not autopilot.received_named(SETPOINT)
    finally:
        await driver.close()
        await autopilot.stop()


def commands(autopilot: FakeAutopilot) -> int:
    autopilot.drain()
    return sum(
        message.command == mavlink.MAV_CMD_DO_SET_MODE for message in autopilot.received_named("COMMAND_LONG")
    )


@pytest.mark.realtime
async def test_vtol_state_is_received_by_both_drivers(kind: DriverKind, port: int) -> None:
    autopilot = FakeAutopilot(port)
    autopilot.mav_type, autopilot.vtol_state = TAILSITTER, int(MC)
    autopilot.start()
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    try:
        await driver.connect(10.0)
        assert driver.state.not_flown == VTOL_STATE_MISSING
        autopilot.landed()
        await wait_for_state(driver, lambda state: state.not_flown is None)
        autopilot.vtol_state = int(FW)
        autopilot.landed()
        state: VehicleState = await wait_for_state(driver, lambda state: state.not_flown is not None)
        assert state.vtol_state is FW
    finally:
        await driver.close()
        await autopilot.stop()
