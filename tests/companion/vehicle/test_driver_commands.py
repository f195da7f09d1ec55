"""Commands and parameters of both drivers, against a real socket: refused, repeated, believed when shown."""

from __future__ import annotations

import asyncio
import math
import struct
import weakref
from collections.abc import Callable
from typing import Any

import mavsdk
import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle import flight_commands
from companion.vehicle.driver import CommandRefusedError, Driver
from companion.vehicle.drivers import open_driver
from companion.vehicle.framing import CURRENT_MODE_ID, pack_frame
from companion.vehicle.mavsdk_driver import MavsdkDriver
from companion.vehicle.state import FlightMode
from tests.companion.vehicle.fake_autopilot import FakeAutopilot, state_shows, wait_until

pytestmark = pytest.mark.usefixtures("short_measurement")


async def test_arming_returns_when_the_vehicle_shows_it(driver: Driver, autopilot: FakeAutopilot) -> None:
    asyncio.get_running_loop().call_later(0.5, setattr, autopilot, "base_mode", 157)
    await driver.arm()
    assert driver.state.armed
    arm = next(m for m in autopilot.heard_named("COMMAND_LONG") if m.command == 400)
    assert (arm.param1, arm.param2) == (1.0, 0.0)


async def test_a_refused_arming_says_why(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.answers["COMMAND_LONG"] = lambda m: autopilot.acknowledge(m.command, 1)
    with pytest.raises(
        CommandRefusedError, match=r"refused to arm \(temporarily rejected\): its pre-arm checks fail"
    ):
        await driver.arm()


async def test_a_mode_is_believed_when_shown_and_not_when_acknowledged(
    driver: Driver, autopilot: FakeAutopilot
) -> None:
    with pytest.raises(CommandRefusedError, match=r"did not enter mode mission within 0\.5 s: it shows hold"):
        await driver.set_mode(FlightMode.MISSION, timeout_s=0.5)


async def test_the_second_acknowledgement_refuses_at_once(driver: Driver, autopilot: FakeAutopilot) -> None:
    def twice(message: Any) -> None:
        autopilot.acknowledge(message.command, 0)
        if message.command == 176:
            autopilot.acknowledge(176, 1)

    autopilot.answers["COMMAND_LONG"] = twice
    with pytest.raises(CommandRefusedError, match=r"refused mode offboard .*setpoint stream.*shows hold"):
        await driver.set_mode(FlightMode.OFFBOARD, timeout_s=60.0)


async def test_a_mode_asked_for_goes_out_as_main_and_sub_mode(
    driver: Driver, autopilot: FakeAutopilot
) -> None:
    def obey(message: Any) -> None:
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


async def test_takeoff_goes_to_a_height_above_home(driver: Driver, autopilot: FakeAutopilot) -> None:
    asyncio.get_running_loop().call_later(0.3, autopilot.home, 488.5)
    await driver.takeoff(4.0)
    (message,) = [m for m in autopilot.heard_named("COMMAND_LONG") if m.command == 22]
    assert message.param7 == 492.5
    assert all(math.isnan(getattr(message, f"param{number}")) for number in range(1, 7))


async def test_takeoff_takes_home_as_it_is_after_arming(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.home(488.85)
    await state_shows(driver, lambda state: state.home_altitude_amsl_m == 488.85)

    def moved(message: Any) -> None:
        """Home has moved by what the height drifted on the ground; it is not told unasked."""
        autopilot.acknowledge(message.command)
        if (message.command, message.param1) == (512, 242):
            autopilot.home(489.58)

    autopilot.answers["COMMAND_LONG"] = moved
    await driver.takeoff(5.0)
    (message,) = [m for m in autopilot.heard_named("COMMAND_LONG") if m.command == 22]
    assert message.param7 == pytest.approx(494.58, abs=1e-3)


async def test_takeoff_without_a_known_home_is_refused_here(
    driver: Driver, autopilot: FakeAutopilot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flight_commands, "_SHOWN_TIMEOUT_S", 0.2)
    with pytest.raises(CommandRefusedError, match="needs home's altitude"):
        await driver.takeoff(4.0)
    with pytest.raises(CommandRefusedError, match="above 0 m"):
        await driver.takeoff(-1.0)
    assert not [m for m in autopilot.heard_named("COMMAND_LONG") if m.command == 22]


async def test_an_unanswered_command_is_sent_again_and_then_given_up(
    driver: Driver, autopilot: FakeAutopilot
) -> None:
    autopilot.answers.clear()
    with pytest.raises(CommandRefusedError, match="does not answer command 400"):
        await driver.arm()
    attempts = [m.confirmation for m in autopilot.heard_named("COMMAND_LONG") if m.command == 400]
    assert len(attempts) >= 3


async def test_a_command_in_progress_is_waited_for(driver: Driver, autopilot: FakeAutopilot) -> None:
    def slowly(message: Any) -> None:
        autopilot.acknowledge(message.command, 5)
        asyncio.get_running_loop().call_later(1.1, autopilot.acknowledge, message.command, 0)

    autopilot.answers["COMMAND_LONG"] = slowly
    autopilot.base_mode = 157
    await driver.arm()
    assert len([m for m in autopilot.heard_named("COMMAND_LONG") if m.command == 400]) == 1


async def test_acknowledgements_for_another_component_are_not_ours(
    driver: Driver, autopilot: FakeAutopilot
) -> None:
    def to_another(message: Any) -> None:
        autopilot.say(mavlink.MAVLink_command_ack_message(message.command, 2, 0, 0, 255, 190))
        autopilot.acknowledge(message.command, 0)

    autopilot.answers["COMMAND_LONG"] = to_another
    autopilot.base_mode = 157
    await driver.arm()


async def test_streams_that_come_too_slowly_are_asked_for(driver: Driver, autopilot: FakeAutopilot) -> None:
    def intervals() -> dict[float, float]:
        return {m.param1: m.param2 for m in autopilot.heard_named("COMMAND_LONG") if m.command == 511}

    await wait_until(lambda: len(intervals()) >= 6, 10.0, intervals)
    assert intervals()[31] == 20000
    assert intervals()[CURRENT_MODE_ID] == 100000


async def test_commands_under_way_fail_when_the_driver_is_closed(
    driver: Driver, autopilot: FakeAutopilot
) -> None:
    autopilot.answers.clear()
    arming = asyncio.create_task(driver.arm())
    await wait_until(lambda: any(m.command == 400 for m in autopilot.heard_named("COMMAND_LONG")), 5.0)
    await driver.close()
    with pytest.raises(CommandRefusedError):
        await arming


@pytest.fixture
def parameters(autopilot: FakeAutopilot) -> dict[str, tuple[int, bytes]]:
    """name → (MAV_PARAM_TYPE, the four bytes): PX4's bytewise encoding."""
    stored = {"COM_OF_LOSS_T": (9, struct.pack("<f", 1.0)), "COM_OBL_RC_ACT": (6, struct.pack("<i", 0))}

    def tell(name: str) -> None:
        if name not in stored:
            autopilot.say(mavlink.MAVLink_param_error_message(1, 191, name.encode(), -1, 1))
            return
        kind, value = stored[name]
        payload = value + struct.pack("<HH16sB", len(stored), 0, name.encode(), kind)
        autopilot.say_bytes(pack_frame(22, payload, system_id=1, component_id=1, sequence=0))

    def take(message: Any) -> None:
        frame = next(raw for heard, raw in reversed(autopilot.heard) if heard is message)
        stored[message.param_id] = (message.param_type, frame[10:14].ljust(4, b"\0"))
        tell(message.param_id)

    autopilot.answers["PARAM_REQUEST_READ"] = lambda m: tell(m.param_id)
    autopilot.answers["PARAM_SET"] = take
    return stored


async def test_parameters_keep_their_type(driver: Driver, parameters: dict[str, tuple[int, bytes]]) -> None:
    assert await driver.get_parameter("COM_OF_LOSS_T") == 1.0
    await driver.set_parameter("COM_OF_LOSS_T", 0.5)
    await driver.set_parameter("COM_OBL_RC_ACT", 4.0)
    assert parameters["COM_OF_LOSS_T"] == (9, struct.pack("<f", 0.5))
    assert parameters["COM_OBL_RC_ACT"] == (6, struct.pack("<i", 4))
    assert await driver.get_parameter("COM_OBL_RC_ACT") == 4.0


@pytest.mark.parametrize("value", [-1, -5_000_000, 2**31 - 1])
async def test_integers_travel_as_bytes_whatever_float_they_look_like(
    driver: Driver, parameters: dict[str, tuple[int, bytes]], value: int
) -> None:
    await driver.set_parameter("COM_OBL_RC_ACT", value)
    assert parameters["COM_OBL_RC_ACT"] == (6, struct.pack("<i", value))
    assert await driver.get_parameter("COM_OBL_RC_ACT") == value


async def test_a_parameter_that_is_not_there_is_refused_by_name(
    driver: Driver, parameters: dict[str, tuple[int, bytes]]
) -> None:
    with pytest.raises(CommandRefusedError, match="COM_NOT_THERE: there is no such parameter"):
        await driver.get_parameter("COM_NOT_THERE")
    with pytest.raises(CommandRefusedError, match="16 characters"):
        await driver.get_parameter("A_NAME_LONGER_THAN_16")
    with pytest.raises(CommandRefusedError, match=r"is an integer and cannot take 0\.5"):
        await driver.set_parameter("COM_OBL_RC_ACT", 0.5)


async def test_what_answers_a_command_lives_until_mavsdk_has_stopped(
    autopilot: FakeAutopilot, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """MAVSDK calls it from C++: had it been freed before, an answer in that moment ended the process."""
    autopilot.answers["COMMAND_LONG"] = lambda _: None
    driver = open_driver("mavsdk", f"udpin://127.0.0.1:{port}")
    await driver.connect(10.0)
    arming = asyncio.create_task(driver.arm())
    called_back: list[weakref.ref[object]] = []
    lived: list[bool] = []
    destroy = mavsdk.Mavsdk.destroy

    def destroy_and_look(library: mavsdk.Mavsdk) -> None:
        destroy(library)
        lived.extend(reference() is not None for reference in called_back)

    monkeypatch.setattr(mavsdk.Mavsdk, "destroy", destroy_and_look)
    try:
        await autopilot.hears_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM)  # others ask for streams
        assert isinstance(driver, MavsdkDriver)
        assert driver._direct is not None
        subscribed = [trampoline for trampoline, _ in driver._direct._subscriptions.values()]
        called_back += [weakref.ref(one) for one in [*driver._direct._callbacks, *subscribed]]
        assert len(called_back) > len(subscribed) > 5
        del subscribed
    finally:
        await driver.close()
    with pytest.raises(CommandRefusedError, match="the link was closed before an answer came"):
        await arming
    assert lived == [True] * len(called_back)


async def test_mavsdk_looks_for_no_vehicle_any_more_before_it_is_destroyed(
    port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that it found while it was being destroyed would outlive it."""
    vehicle = FakeAutopilot(port)
    vehicle.start()
    order: list[str] = []
    for name in ("cancel_first_autopilot", "destroy"):
        method = getattr(mavsdk.Mavsdk, name)

        def noted(*arguments: Any, name: str = name, method: Callable[..., Any] = method) -> Any:
            order.append(name)
            return method(*arguments)

        monkeypatch.setattr(mavsdk.Mavsdk, name, noted)
    # MAVSDK hears nothing, and searches until it is cancelled.
    monkeypatch.setattr(mavsdk.Mavsdk, "pass_received_raw_bytes", lambda *_: None)
    driver = open_driver("mavsdk", f"udpin://127.0.0.1:{port}")
    connecting = asyncio.create_task(driver.connect(30.0))
    assert isinstance(driver, MavsdkDriver)
    await wait_until(lambda: driver._search is not None, 10.0)
    connecting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await connecting
    assert order == ["cancel_first_autopilot", "destroy"]
    await vehicle.stop()


async def test_what_waits_for_its_turn_when_the_link_is_closed_is_refused(
    driver: Driver, autopilot: FakeAutopilot
) -> None:
    autopilot.answers["COMMAND_LONG"] = lambda _: None
    arming = [asyncio.create_task(driver.arm()) for _ in range(2)]
    reading = asyncio.create_task(driver.set_parameter("COM_OF_LOSS_T", 1.0))
    await wait_until(lambda: any(m.command == 400 for m in autopilot.heard_named("COMMAND_LONG")), 10.0)
    await driver.close()
    for outcome in await asyncio.gather(*arming, reading, return_exceptions=True):
        assert isinstance(outcome, CommandRefusedError), outcome
    with pytest.raises(CommandRefusedError, match="not connected"):
        await driver.set_parameter("COM_OF_LOSS_T", 1.0)
