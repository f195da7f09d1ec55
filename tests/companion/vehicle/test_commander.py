"""Another service on the same vehicle, detected by its heartbeat."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.commander import Commander, commander_mode, read_commander
from companion.vehicle.driver import Driver, SystemStatus
from companion.vehicle.state import VehicleState
from tests.companion.vehicle.fake_autopilot import FakeAutopilot, wait_for_state

DAY_S = 24 * 3600.0
OURS = commander_mode(100.0, True)
ONBOARD, STATION = mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_TYPE_GCS


@given(uptime_s=st.floats(0, 5 * DAY_S), in_command=st.booleans())
def test_heartbeat_encodes_uptime_and_command(uptime_s: float, in_command: bool) -> None:
    mode = commander_mode(uptime_s, in_command)
    assert 0 <= mode < 2**32
    assert read_commander(ONBOARD, mode, (1, 191), 7) == Commander((1, 191), 7, int(uptime_s), in_command)


def test_uptime_is_clamped() -> None:
    one = read_commander(ONBOARD, commander_mode(30 * DAY_S, False), (1, 191), 7)
    assert one is not None
    assert (one.uptime_s, one.in_command) == (2**19 - 1, False)


def named_value(address: tuple[int, int], value: int, name: bytes = b"companion") -> bytes:
    """The mark as ArduPilot forwards it from another link, whoever sends heartbeats there."""
    signed = int.from_bytes(value.to_bytes(4, "little"), "little", signed=True)
    codec = mavlink.MAVLink(None, *address)
    codec.seq = 99
    return bytes(mavlink.MAVLink_named_value_int_message(7, name, signed).pack(codec))


def heartbeat(address: tuple[int, int], mav_type: int, custom_mode: int, sequence: int = 99) -> bytes:
    """A heartbeat of another system or component, as forwarded by the autopilot."""
    codec = mavlink.MAVLink(None, *address)
    codec.seq = sequence
    return bytes(mavlink.MAVLink_heartbeat_message(mav_type, 8, 0, custom_mode, 4, 3).pack(codec))


async def test_heartbeat_of_a_service_is_in_the_state(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.send_bytes(heartbeat((1, 191), ONBOARD, OURS))
    autopilot.send_bytes(heartbeat((1, 192), ONBOARD, commander_mode(3.0, False)))
    state = await wait_for_state(driver, lambda state: len(state.other_commanders) == 2)
    others = [(other.address, other.uptime_s, other.in_command) for other in state.other_commanders]
    assert others == [((1, 191), 100.0, True), ((1, 192), 3.0, False)]
    autopilot.send_bytes(heartbeat((1, 191), ONBOARD, commander_mode(101.0, False)))

    def updated(state: VehicleState) -> bool:
        return [other.uptime_s for other in state.other_commanders] == [3.0, 101.0]

    await wait_for_state(driver, updated)


async def test_other_heartbeats_are_no_commanders(driver: Driver, autopilot: FakeAutopilot) -> None:
    for address, mav_type, custom_mode in (
        ((245, 190), STATION, 0),
        ((1, 191), ONBOARD, 0),  # MAVROS, or a logger
        ((1, 154), mavlink.MAV_TYPE_GIMBAL, 0),
        ((1, 100), mavlink.MAV_TYPE_CAMERA, OURS),
        ((2, 191), ONBOARD, OURS),  # another vehicle's
    ):
        autopilot.send_bytes(heartbeat(address, mav_type, custom_mode))
    autopilot.send_bytes(heartbeat((1, 193), ONBOARD, OURS))
    state = await wait_for_state(driver, lambda state: bool(state.other_commanders))
    assert [other.address for other in state.other_commanders] == [(1, 193)]


async def test_echo_of_our_heartbeat_is_no_commander(driver: Driver, autopilot: FakeAutopilot) -> None:
    driver.send_heartbeat(SystemStatus.ACTIVE, uptime_s=5.0, in_command=True)
    await autopilot.wait_for("HEARTBEAT")
    (raw,) = [raw for message, raw in autopilot.received if message.get_type() == "HEARTBEAT"]
    autopilot.send_bytes(raw)
    autopilot.send_bytes(heartbeat((1, 192), ONBOARD, OURS))
    state = await wait_for_state(driver, lambda state: bool(state.other_commanders))
    assert [other.address for other in state.other_commanders] == [(1, 192)]


async def test_named_value_is_a_commander(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.send_bytes(named_value((1, 193), OURS, b"other"))
    autopilot.send_bytes(named_value((1, 191), OURS))
    state = await wait_for_state(driver, lambda state: bool(state.other_commanders))
    others = [(other.address, other.uptime_s, other.in_command) for other in state.other_commanders]
    assert others == [((1, 191), 100.0, True)]
