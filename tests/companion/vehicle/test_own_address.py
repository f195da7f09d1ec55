"""Our MAVLink address: a free one is chosen, a shared one detected; only the autopilot's link counts."""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.commander import ONBOARD_CONTROLLER, commander_mode, read_commander
from companion.vehicle.driver import Driver, SystemStatus
from companion.vehicle.drivers import DriverKind, open_driver
from companion.vehicle.framing import Frame, frames_of, pack_frame
from companion.vehicle.own_address import OwnAddress
from companion.vehicle.state import FlightMode
from tests.companion.vehicle.fake_autopilot import FakeAutopilot, sender_of, wait_for_state
from tests.companion.vehicle.scripted_link import AUTOPILOT, ScriptedDriver
from tests.companion.vehicle.test_commander import heartbeat, named_value
from tests.companion.vehicle.test_driver_standstill import Suspend

S = 1_000_000_000
OTHERS = (192, 193, 194)
OTHER_SENDER = ("127.0.0.1", 4711)
LAND = 0x06040000  # PX4's custom_mode
MARK = commander_mode(100.0, True)


def frame_of(address: tuple[int, int], sequence: int = 99, custom_mode: int = MARK) -> Frame:
    (frame,) = frames_of(heartbeat(address, ONBOARD_CONTROLLER, custom_mode, sequence))
    return frame


def acknowledgement(command: int, to: tuple[int, int]) -> mavlink.MAVLink_command_ack_message:
    return mavlink.MAVLink_command_ack_message(command, 0, 0, 0, *to)


# --- choosing one -------------------------------------------------------------------------------------------


@given(
    own=st.sampled_from((191, *OTHERS)),
    received=st.lists(st.tuples(st.integers(185, 200), st.booleans(), st.integers(0, 20)), max_size=20),
    at_random=st.booleans(),
)
def test_changed_id_is_one_that_nobody_uses(
    own: int, received: list[tuple[int, bool, int]], at_random: bool
) -> None:
    others = [number for number in (191, *OTHERS) if number != own]
    address = OwnAddress(1, own, others)
    now_ns = 100 * S
    for component, from_autopilot, age_s in received:
        source = AUTOPILOT if from_autopilot else OTHER_SENDER
        address.on_heartbeat(frame_of((1, component)), source, MARK, now_ns - age_s * S)
    address.only_from(AUTOPILOT)
    last = {component: age for component, near, age in received if near}  # in the order of arrival
    used = {number for number, age_s in last.items() if age_s <= 5}
    free = set(others) - used
    assert address.change(now_ns, at_random=at_random) is bool(free)
    assert address.address[1] in (free or {own})


@asynccontextmanager
async def connected(kind: DriverKind, port: int, url: str = "") -> AsyncIterator[Driver]:
    driver = open_driver(kind, url or f"udpin://127.0.0.1:{port}", other_component_ids=OTHERS)
    await driver.connect(10.0)
    try:
        yield driver
    finally:
        await driver.close()


@asynccontextmanager
async def repeated(autopilot: FakeAutopilot, *messages: bytes) -> AsyncIterator[None]:
    """Messages of other programs, forwarded by the autopilot."""

    async def send() -> None:
        while True:
            for message in messages:
                autopilot.send_bytes(message)
            await asyncio.sleep(0.2)

    sending = asyncio.create_task(send())
    try:
        yield
    finally:
        sending.cancel()


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("used", "component"), [((), 191), ((191,), 192), ((191, 192), 193), ((192,), 191), ((191, *OTHERS), 191)]
)
async def test_id_in_use_is_not_taken(
    kind: DriverKind, port: int, autopilot: FakeAutopilot, used: tuple[int, ...], component: int
) -> None:
    messages = [heartbeat((1, number), ONBOARD_CONTROLLER, 0) for number in used]
    async with repeated(autopilot, *messages), connected(kind, port) as driver:
        assert driver.own_address == driver.state.own_address == (1, component)
        first = (await autopilot.wait_for("HEARTBEAT"))[0]
        assert sender_of(first) == (1, component)  # nothing was sent with another id before
        assert {message.get_srcComponent() for message, _ in autopilot.received} == {component}


@pytest.mark.realtime
async def test_ids_of_other_systems_and_programs_do_not_count(
    kind: DriverKind, port: int, autopilot: FakeAutopilot
) -> None:
    messages = heartbeat((2, 191), ONBOARD_CONTROLLER, 0), heartbeat((1, 154), mavlink.MAV_TYPE_GIMBAL, 0)
    async with repeated(autopilot, *messages), connected(kind, port) as driver:
        assert driver.own_address == (1, 191)


@pytest.mark.realtime
async def test_first_heartbeat_on_a_sending_link_hides_no_service(port: int) -> None:
    """udpout: a router learns our port, and an address that is not the one we want to receive."""
    vehicle = FakeAutopilot(port)
    vehicle.sends_heartbeats = False
    vehicle.answers["HEARTBEAT"] = lambda _: setattr(vehicle, "sends_heartbeats", True)
    vehicle.start()
    url = f"udpout://127.0.0.1:{vehicle.socket.getsockname()[1]}"
    try:
        async with connected("pymavlink", port, url) as driver:
            driver.send_heartbeat(SystemStatus.ACTIVE)
            beats = await vehicle.wait_for("HEARTBEAT", 3)
        assert [sender_of(beat) for beat in (beats[0], beats[-1])] == [(1, 194), (1, 191)]
        marks = [read_commander(beat.type, beat.custom_mode, (1, 1), 0) for beat in (beats[0], beats[-1])]
        assert [mark is not None for mark in marks] == [False, True]
    finally:
        await vehicle.stop()


# --- a shared one -------------------------------------------------------------------------------------------


def commanders(one: ScriptedDriver) -> list[tuple[int, int]]:
    return [other.address for other in one.driver.state.other_commanders]


def scripted(kind: DriverKind = "pymavlink") -> ScriptedDriver:
    one = ScriptedDriver(kind, other_component_ids=OTHERS)
    one.heartbeat()
    return one


def test_heartbeat_with_our_address_is_detected_and_echo_is_not(kind: DriverKind) -> None:
    one = scripted(kind)
    one.driver.send_heartbeat(SystemStatus.ACTIVE, uptime_s=5.0)
    for data in list(one.link.sent):
        one.driver._received(data, AUTOPILOT)  # our own, back from a router
    assert one.driver.state.address_shared_ns == 0
    one.driver._received(heartbeat((1, 191), ONBOARD_CONTROLLER, 0), AUTOPILOT)
    assert one.driver.state.address_shared_ns > 0
    assert one.driver.state.foreign_command_ns == 0


def test_echo_of_the_address_before_is_no_other_service() -> None:
    one = scripted()
    one.driver.send_heartbeat(SystemStatus.ACTIVE, uptime_s=5.0)
    echoes = list(one.link.sent)
    assert one.driver.change_address()
    for data in echoes:
        one.driver._received(data, AUTOPILOT)
    assert commanders(one) == []


def test_changed_address_is_that_of_every_message() -> None:
    one = scripted()
    one.driver._received(heartbeat((1, 191), ONBOARD_CONTROLLER, MARK), AUTOPILOT)
    assert one.driver.change_address()
    assert one.driver.own_address == one.driver.state.own_address
    assert one.driver.own_address[1] in OTHERS
    assert one.driver.state.address_shared_ns == 0
    one.driver.send_heartbeat(SystemStatus.ACTIVE)
    one.driver._send_message("COMMAND_LONG", {**dict.fromkeys(COMMAND_FIELDS, 0), "command": 512})
    assert {(frame.system_id, frame.component_id) for frame in one.taken()} == {one.driver.own_address}


COMMAND_FIELDS = mavlink.MAVLink_command_long_message.fieldnames


@pytest.mark.parametrize("ending", ["done", "refused", "abandoned", "replaced"])
async def test_address_stays_until_no_acknowledgement_can_arrive(ending: str) -> None:
    one = scripted()
    suspend = Suspend(one.driver)
    assert one.driver._flight_commands.in_transit is False
    tasks = [asyncio.create_task(one.driver.set_mode(FlightMode.LAND))]
    await asyncio.sleep(0)
    assert not one.driver.change_address()
    match ending:
        case "done":
            one.receive(acknowledgement(mavlink.MAV_CMD_DO_SET_MODE, (1, 191)))
            one.heartbeat(mode=LAND)
        case "refused":
            one.receive(mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_DO_SET_MODE, 2, 0, 0, 1, 191))
        case "abandoned":
            one.driver.abandon("by a test")
        case "replaced":  # by one that is not sent: decided on another state
            old = replace(one.driver.state, custom_mode=1)
            tasks.append(asyncio.create_task(one.driver.set_mode(FlightMode.HOLD, since=old)))
    await asyncio.wait(tasks, timeout=1.0)
    assert not one.driver.change_address()
    suspend.seconds = 3.1
    assert one.driver.change_address()
    await asyncio.gather(*tasks, return_exceptions=True)


def test_shared_ids_are_not_used_again() -> None:
    one = scripted()
    used = [one.driver.own_address[1]]
    while one.driver.change_address():
        used.append(one.driver.own_address[1])
    assert sorted(used) == [191, *OTHERS]


def test_no_change_without_a_free_id() -> None:
    one = scripted()
    for number in OTHERS:
        one.driver._received(heartbeat((1, number), ONBOARD_CONTROLLER, 0), AUTOPILOT)
    assert not one.driver.change_address()
    assert one.driver.own_address == (1, 191)


@pytest.mark.parametrize(
    ("command", "to", "shared"),
    [
        (mavlink.MAV_CMD_DO_SET_MODE, (1, 191), True),
        (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (1, 191), True),
        (mavlink.MAV_CMD_NAV_TAKEOFF, (1, 191), True),
        (mavlink.MAV_CMD_DO_SET_MODE, (245, 190), False),  # a ground station's
        (mavlink.MAV_CMD_DO_SET_MODE, (0, 0), False),  # an autopilot that names no receiver
        (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (1, 191), False),  # moves nothing
    ],
)
def test_acknowledgement_not_asked_for_is_another_commander(
    command: int, to: tuple[int, int], shared: bool
) -> None:
    one = scripted()
    one.receive(acknowledgement(command, to), source=OTHER_SENDER)
    assert one.driver.state.foreign_command_ns == 0
    one.receive(acknowledgement(command, to))
    assert (one.driver.state.foreign_command_ns > 0) is shared
    assert (one.driver.state.address_shared_ns > 0) is shared


async def test_acknowledgements_of_our_own_command_are_ours() -> None:
    one = scripted()
    request = asyncio.create_task(one.driver._command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, 4.0, 3.0))
    await asyncio.sleep(0)
    for _ in range(5):  # PX4 answers twice, and every repetition
        one.receive(acknowledgement(mavlink.MAV_CMD_DO_SET_MODE, (1, 191)))
        await asyncio.sleep(0)
    assert await request == 0
    assert one.driver.state.foreign_command_ns == 0


def test_acknowledgement_is_ours_for_ten_seconds() -> None:
    address = OwnAddress(1, 191, OTHERS)
    address.asked(mavlink.MAV_CMD_DO_SET_MODE, 100 * S)
    assert not address.is_foreign_ack(mavlink.MAV_CMD_DO_SET_MODE, 110 * S)
    assert address.is_foreign_ack(mavlink.MAV_CMD_DO_SET_MODE, 111 * S)


@pytest.mark.parametrize(("to", "shared"), [((1, 191), True), ((1, 192), False), ((0, 0), False)])
def test_answers_to_others_timesync_show_a_shared_address(to: tuple[int, int], shared: bool) -> None:
    one = scripted()
    for number in range(3):
        assert one.driver.state.address_shared_ns == 0  # the first ones may be of a program before us
        (frame,) = frames_of(timesync(7 + number, to))
        one.driver._received(frame.raw, AUTOPILOT)
    assert (one.driver.state.address_shared_ns > 0) is shared


@pytest.mark.parametrize("to", [(0, 0), (1, 191), (72, 115)])  # PX4 v1.16.2 sends any numbers
def test_answer_with_our_stamp_is_ours_whoever_it_names(to: tuple[int, int]) -> None:
    one = scripted()
    stamp_ns = time.monotonic_ns()
    one.driver._timesync_sent_ns = stamp_ns
    one.driver._timesyncs_ns.append(stamp_ns)
    (frame,) = frames_of(timesync(stamp_ns, to))
    one.driver._received(frame.raw, AUTOPILOT)
    assert one.driver._telemetry.answered_ns == stamp_ns
    assert one.driver.state.clock is not None
    assert one.driver.state.address_shared_ns == 0


def timesync(stamp_ns: int, to: tuple[int, int]) -> bytes:
    payload = struct.pack("<qqBB", 5 * S, stamp_ns, *to)
    return pack_frame(mavlink.MAVLINK_MSG_ID_TIMESYNC, payload, system_id=1, component_id=1, sequence=0)


# --- only the autopilot's link ------------------------------------------------------------------------------


def test_marks_of_other_senders_are_ignored(kind: DriverKind) -> None:
    one = scripted(kind)
    for data in (heartbeat((1, 191), ONBOARD_CONTROLLER, MARK), named_value((1, 192), MARK)):
        one.driver._received(data, OTHER_SENDER)
    assert commanders(one) == []
    assert one.driver.state.address_shared_ns == 0
    assert one.driver.change_address()
    assert one.driver.own_address[1] in OTHERS
    one.driver._received(named_value((1, 191), MARK), AUTOPILOT)
    assert commanders(one) == [(1, 191)]


def test_marks_before_the_first_autopilot_are_ignored() -> None:
    one = ScriptedDriver("pymavlink")
    one.driver._received(heartbeat((1, 192), ONBOARD_CONTROLLER, MARK), OTHER_SENDER)
    one.driver._received(named_value((1, 192), MARK), OTHER_SENDER)
    assert commanders(one) == []


EVERY_MESSAGE = st.sampled_from(
    [
        heartbeat((1, 191), ONBOARD_CONTROLLER, MARK),
        named_value((1, 193), MARK),
        heartbeat((1, 1), 1, 0),
        bytes(mavlink.MAVLink_extended_sys_state_message(4, 1).pack(mavlink.MAVLink(None, 1, 1))),
        bytes(mavlink.MAVLink_statustext_message(0, b"crash").pack(mavlink.MAVLink(None, 1, 1))),
        bytes(mavlink.MAVLink_attitude_message(0, 1, 1, 1, 0, 0, 0).pack(mavlink.MAVLink(None, 1, 1))),
        bytes(
            mavlink.MAVLink_local_position_ned_message(9, 1, 2, 3, 4, 5, 6).pack(mavlink.MAVLink(None, 1, 1))
        ),
        bytes(
            mavlink.MAVLink_home_position_message(*[1] * 6, [1, 0, 0, 0], 0, 0, 0).pack(
                mavlink.MAVLink(None, 1, 1)
            )
        ),
        bytes(acknowledgement(176, (1, 191)).pack(mavlink.MAVLink(None, 1, 1))),
        timesync(7, (1, 191)),
    ]
)


@given(messages=st.lists(EVERY_MESSAGE, max_size=30))
def test_nothing_of_other_senders_changes_the_state(messages: list[bytes]) -> None:
    one = scripted()
    before = one.driver.state
    for number, data in enumerate(messages):
        one.driver._received(data, ("127.0.0.1", 5000 + number))
    assert one.driver.state is before


def test_senders_that_are_noted_are_limited() -> None:
    one = scripted()
    for number in range(1000):
        one.driver._received(heartbeat((1 + number % 250, 191), 6, 0), ("127.0.0.1", 5000 + number))
        one.heartbeat(source=("127.0.0.1", 5000 + number))
    assert len(one.driver._others) <= 64
    assert len(one.driver._address._received_ns) <= 64


async def test_udpout_receives_from_its_peer_only(port: int) -> None:
    vehicle, other = FakeAutopilot(port), FakeAutopilot(port)
    vehicle.sends_heartbeats = False
    vehicle.answers["HEARTBEAT"] = lambda _: setattr(vehicle, "sends_heartbeats", True)
    vehicle.start()
    driver = open_driver("pymavlink", f"udpout://127.0.0.1:{vehicle.socket.getsockname()[1]}")
    try:
        await driver.connect(10.0)
        other._port = vehicle._port
        other.send_bytes(heartbeat((1, 193), ONBOARD_CONTROLLER, MARK))
        vehicle.send_bytes(heartbeat((1, 194), ONBOARD_CONTROLLER, MARK))
        state = await wait_for_state(driver, lambda state: bool(state.other_commanders))
        assert [other.address for other in state.other_commanders] == [(1, 194)]
    finally:
        await driver.close()
        await vehicle.stop()
        await other.stop()
