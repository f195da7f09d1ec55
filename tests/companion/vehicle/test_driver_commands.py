"""Commands and parameters of both drivers, on a real socket."""

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
from companion.vehicle.driver import CommandRefusedError, Driver, TakenOverError
from companion.vehicle.drivers import open_driver
from companion.vehicle.framing import CURRENT_MODE_ID, pack_frame
from companion.vehicle.mavsdk_driver import MavsdkDriver
from companion.vehicle.state import FlightMode
from tests.companion.vehicle.fake_autopilot import HOLD, MISSION, FakeAutopilot, wait_for_state, wait_until

pytestmark = [pytest.mark.usefixtures("short_measurement"), pytest.mark.realtime]
ORBIT, EXTERNAL = 0x01030000, 0x0B040000  # of PX4; they have no name here


async def test_arm_returns_when_the_vehicle_reports_it(driver: Driver, autopilot: FakeAutopilot) -> None:
    asyncio.get_running_loop().call_later(0.5, setattr, autopilot, "base_mode", 157)
    await driver.arm()
    assert driver.state.armed
    arm = next(m for m in autopilot.received_named("COMMAND_LONG") if m.command == 400)
    assert (arm.param1, arm.param2) == (1.0, 0.0)


async def test_denied_arming_has_its_reason(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.answers["COMMAND_LONG"] = lambda m: autopilot.acknowledge(m.command, 1)
    with pytest.raises(CommandRefusedError, match=r"rejected\): .*pre-arm"):
        await driver.arm()


async def test_acknowledged_mode_must_be_reported(driver: Driver, autopilot: FakeAutopilot) -> None:
    with pytest.raises(CommandRefusedError, match=r"mission .*0\.5 s: .*hold"):
        await driver.set_mode(FlightMode.MISSION, timeout_s=0.5)


async def test_second_acknowledgement_refuses_at_once(driver: Driver, autopilot: FakeAutopilot) -> None:
    def twice(message: Any) -> None:
        autopilot.acknowledge(message.command, 0)
        if message.command == 176:
            autopilot.acknowledge(176, 1)

    autopilot.answers["COMMAND_LONG"] = twice
    with pytest.raises(CommandRefusedError, match=r"offboard .*setpoint .*hold"):
        await driver.set_mode(FlightMode.OFFBOARD, timeout_s=60.0)


async def test_mode_is_sent_as_main_and_sub_mode(driver: Driver, autopilot: FakeAutopilot) -> None:
    def obey(message: Any) -> None:
        autopilot.acknowledge(message.command)
        if message.command == 176:
            autopilot.custom_mode = int(message.param2) << 16 | int(message.param3) << 24

    autopilot.answers["COMMAND_LONG"] = obey
    for mode in (FlightMode.OFFBOARD, FlightMode.LAND, FlightMode.RETURN, FlightMode.HOLD):
        await driver.set_mode(mode)
        assert driver.state.mode is mode
    asked = [
        (m.param1, m.param2, m.param3) for m in autopilot.received_named("COMMAND_LONG") if m.command == 176
    ]
    assert asked == [(1, 6, 0), (1, 4, 6), (1, 4, 5), (1, 4, 3)]
    with pytest.raises(ValueError, match=r"mode unknown .*; known: "):
        await driver.set_mode(FlightMode.UNKNOWN)


async def test_takeoff_altitude_is_above_home(driver: Driver, autopilot: FakeAutopilot) -> None:
    asyncio.get_running_loop().call_later(0.3, autopilot.home, 488.5)
    await driver.takeoff(4.0)
    (message,) = [m for m in autopilot.received_named("COMMAND_LONG") if m.command == 22]
    assert message.param7 == 492.5
    assert all(math.isnan(getattr(message, f"param{number}")) for number in range(1, 7))


async def test_takeoff_uses_home_after_arming(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.home(488.85)
    await wait_for_state(driver, lambda state: state.home_altitude_amsl_m == 488.85)

    def moved(message: Any) -> None:
        """Home has moved by the height's drift on the ground; it is sent only on request."""
        autopilot.acknowledge(message.command)
        if (message.command, message.param1) == (512, 242):
            autopilot.home(489.58)

    autopilot.answers["COMMAND_LONG"] = moved
    await driver.takeoff(5.0)
    (message,) = [m for m in autopilot.received_named("COMMAND_LONG") if m.command == 22]
    assert message.param7 == pytest.approx(494.58, abs=1e-3)


async def test_takeoff_without_home_is_refused(
    driver: Driver, autopilot: FakeAutopilot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flight_commands, "_HOME_TIMEOUT_S", 0.2)
    with pytest.raises(CommandRefusedError, match=r"home position"):
        await driver.takeoff(4.0)
    with pytest.raises(CommandRefusedError, match="above 0 m"):
        await driver.takeoff(-1.0)
    assert not [m for m in autopilot.received_named("COMMAND_LONG") if m.command == 22]


async def test_unanswered_command_is_repeated_then_fails(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.answers.pop("COMMAND_LONG")
    with pytest.raises(CommandRefusedError, match=r"no answer .*command 400 "):
        await driver.arm()
    attempts = [m.confirmation for m in autopilot.received_named("COMMAND_LONG") if m.command == 400]
    assert len(attempts) >= 3


async def test_pilots_mode_ends_the_repetition(driver: Driver, autopilot: FakeAutopilot) -> None:
    def pilot(message: Any) -> None:
        if message.command == 176:
            autopilot.custom_mode = MISSION

    autopilot.answers["COMMAND_LONG"] = pilot
    with pytest.raises(TakenOverError, match="mission mode"):
        await driver.set_mode(FlightMode.LAND, timeout_s=60.0)
    await driver.settle()
    assert len([m for m in autopilot.received_named("COMMAND_LONG") if m.command == 176]) == 1


@pytest.mark.parametrize("mode", [ORBIT, EXTERNAL])
async def test_pilots_mode_without_a_name_here_ends_the_repetition(
    driver: Driver, autopilot: FakeAutopilot, mode: int
) -> None:
    """Only CURRENT_MODE reports it, as between two heartbeats of PX4."""

    def changed(message: Any) -> None:
        if message.command == 176:
            autopilot.sends_heartbeats = False
            payload = struct.pack("<IIB", mode, mode, 0)
            frame = pack_frame(CURRENT_MODE_ID, payload, system_id=1, component_id=1, sequence=9)
            for tick in range(10):
                asyncio.get_running_loop().call_later(0.1 * tick, autopilot.send_bytes, frame)

    autopilot.answers["COMMAND_LONG"] = changed
    with pytest.raises(TakenOverError):
        await driver.set_mode(FlightMode.LAND)
    await driver.settle()
    assert len([m for m in autopilot.received_named("COMMAND_LONG") if m.command == 176]) == 1


async def test_pilots_mode_that_ours_overrides_is_requested_again(
    driver: Driver, autopilot: FakeAutopilot
) -> None:
    def late(message: Any) -> None:
        """It arrives after the pilot's change."""
        if message.command == 176 and autopilot.custom_mode == HOLD:
            autopilot.custom_mode = MISSION
            autopilot.heartbeat()
        if message.command == 176:
            autopilot.acknowledge(176)
            autopilot.custom_mode = int(message.param2) << 16 | int(message.param3) << 24
            autopilot.heartbeat()

    autopilot.answers["COMMAND_LONG"] = late
    with pytest.raises(TakenOverError):
        await driver.set_mode(FlightMode.LAND)
    await driver.settle()
    asked = [(m.param2, m.param3) for m in autopilot.received_named("COMMAND_LONG") if m.command == 176]
    assert asked == [(4, 6), (4, 4)]
    assert driver.state.mode is FlightMode.MISSION
    assert driver.state.mode_restored


async def test_mode_since_the_decision_is_not_overridden(driver: Driver, autopilot: FakeAutopilot) -> None:
    decided = driver.state
    autopilot.custom_mode = MISSION
    await wait_for_state(driver, lambda state: state.mode is FlightMode.MISSION)
    with pytest.raises(TakenOverError):
        await driver.set_mode(FlightMode.LAND, since=decided)
    assert not [m for m in autopilot.received_named("COMMAND_LONG") if m.command == 176]


async def test_command_in_progress_is_not_repeated(driver: Driver, autopilot: FakeAutopilot) -> None:
    def slowly(message: Any) -> None:
        autopilot.acknowledge(message.command, 5)
        asyncio.get_running_loop().call_later(1.1, autopilot.acknowledge, message.command, 0)

    autopilot.answers["COMMAND_LONG"] = slowly
    autopilot.base_mode = 157
    await driver.arm()
    assert len([m for m in autopilot.received_named("COMMAND_LONG") if m.command == 400]) == 1


async def test_acknowledgement_for_another_component_is_ignored(
    driver: Driver, autopilot: FakeAutopilot
) -> None:
    def to_another(message: Any) -> None:
        autopilot.send(mavlink.MAVLink_command_ack_message(message.command, 2, 0, 0, 255, 190))
        autopilot.acknowledge(message.command, 0)

    autopilot.answers["COMMAND_LONG"] = to_another
    autopilot.base_mode = 157
    await driver.arm()


async def test_slow_streams_are_requested(driver: Driver, autopilot: FakeAutopilot) -> None:
    def intervals() -> dict[float, float]:
        return {m.param1: m.param2 for m in autopilot.received_named("COMMAND_LONG") if m.command == 511}

    await wait_until(lambda: len(intervals()) >= 6, 10.0, intervals)
    assert intervals()[31] == 20000
    assert intervals()[CURRENT_MODE_ID] == 100000


async def test_pending_command_fails_on_close(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.answers.clear()
    arming = asyncio.create_task(driver.arm())
    await wait_until(lambda: any(m.command == 400 for m in autopilot.received_named("COMMAND_LONG")), 5.0)
    await driver.close()
    with pytest.raises(CommandRefusedError):
        await arming


@pytest.fixture
def parameters(autopilot: FakeAutopilot) -> dict[str, tuple[int, bytes]]:
    """name → (MAV_PARAM_TYPE, the four bytes): PX4's bytewise encoding."""
    stored = {"COM_OF_LOSS_T": (9, struct.pack("<f", 1.0)), "COM_OBL_RC_ACT": (6, struct.pack("<i", 0))}

    def send_value(name: str) -> None:
        if name not in stored:
            autopilot.send(mavlink.MAVLink_param_error_message(1, 191, name.encode(), -1, 1))
            return
        kind, value = stored[name]
        payload = value + struct.pack("<HH16sB", len(stored), 0, name.encode(), kind)
        autopilot.send_bytes(pack_frame(22, payload, system_id=1, component_id=1, sequence=0))

    def set_value(message: Any) -> None:
        frame = next(raw for received, raw in reversed(autopilot.received) if received is message)
        stored[message.param_id] = (message.param_type, frame[10:14].ljust(4, b"\0"))
        send_value(message.param_id)

    autopilot.answers["PARAM_REQUEST_READ"] = lambda m: send_value(m.param_id)
    autopilot.answers["PARAM_SET"] = set_value
    return stored


async def test_parameters_keep_their_type(driver: Driver, parameters: dict[str, tuple[int, bytes]]) -> None:
    assert await driver.get_parameter("COM_OF_LOSS_T") == 1.0
    await driver.set_parameter("COM_OF_LOSS_T", 0.5)
    await driver.set_parameter("COM_OBL_RC_ACT", 4.0)
    assert parameters["COM_OF_LOSS_T"] == (9, struct.pack("<f", 0.5))
    assert parameters["COM_OBL_RC_ACT"] == (6, struct.pack("<i", 4))
    assert await driver.get_parameter("COM_OBL_RC_ACT") == 4.0


@pytest.mark.parametrize("value", [-1, -5_000_000, 2**31 - 1])
async def test_integer_parameters_are_sent_as_bytes(
    driver: Driver, parameters: dict[str, tuple[int, bytes]], value: int
) -> None:
    await driver.set_parameter("COM_OBL_RC_ACT", value)
    assert parameters["COM_OBL_RC_ACT"] == (6, struct.pack("<i", value))
    assert await driver.get_parameter("COM_OBL_RC_ACT") == value


async def test_unknown_parameter_is_refused_by_name(
    driver: Driver, parameters: dict[str, tuple[int, bytes]]
) -> None:
    with pytest.raises(CommandRefusedError, match=r"THERE: .*no such"):
        await driver.get_parameter("COM_NOT_THERE")
    with pytest.raises(CommandRefusedError, match="16 characters"):
        await driver.get_parameter("A_NAME_LONGER_THAN_16")
    with pytest.raises(CommandRefusedError, match=r"integer .*0\.5"):
        await driver.set_parameter("COM_OBL_RC_ACT", 0.5)


async def test_command_callbacks_outlive_mavsdk(
    autopilot: FakeAutopilot, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """MAVSDK calls them from C++: an answer to a freed callback crashes the process."""
    autopilot.answers["COMMAND_LONG"] = lambda _: None
    driver = open_driver("mavsdk", f"udpin://127.0.0.1:{port}")
    await driver.connect(10.0)
    arming = asyncio.create_task(driver.arm())
    callbacks: list[weakref.ref[object]] = []
    alive: list[bool] = []
    destroy = mavsdk.Mavsdk.destroy

    def destroy_and_check(library: mavsdk.Mavsdk) -> None:
        destroy(library)
        alive.extend(reference() is not None for reference in callbacks)

    monkeypatch.setattr(mavsdk.Mavsdk, "destroy", destroy_and_check)
    try:
        await autopilot.wait_for_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM)  # others request streams
        assert isinstance(driver, MavsdkDriver)
        assert driver._direct is not None
        subscribed = [trampoline for trampoline, _ in driver._direct._subscriptions.values()]
        callbacks += [weakref.ref(callback) for callback in [*driver._direct._callbacks, *subscribed]]
        assert len(callbacks) > len(subscribed) > 5
        del subscribed
    finally:
        await driver.close()
    with pytest.raises(CommandRefusedError, match="was closed"):
        await arming
    assert alive == [True] * len(callbacks)


async def test_mavsdk_search_is_cancelled_before_destroy(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A vehicle found during the destruction would outlive the library."""
    vehicle = FakeAutopilot(port)
    vehicle.start()
    order: list[str] = []
    for name in ("cancel_first_autopilot", "destroy"):
        method = getattr(mavsdk.Mavsdk, name)

        def noted(*arguments: Any, name: str = name, method: Callable[..., Any] = method) -> Any:
            order.append(name)
            return method(*arguments)

        monkeypatch.setattr(mavsdk.Mavsdk, name, noted)
    # MAVSDK receives nothing, and searches until it is cancelled.
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


async def test_queued_requests_fail_on_close(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.answers["COMMAND_LONG"] = lambda _: None
    arming = [asyncio.create_task(driver.arm()) for _ in range(2)]
    reading = asyncio.create_task(driver.set_parameter("COM_OF_LOSS_T", 1.0))
    await wait_until(lambda: any(m.command == 400 for m in autopilot.received_named("COMMAND_LONG")), 10.0)
    await driver.close()
    for outcome in await asyncio.gather(*arming, reading, return_exceptions=True):
        assert isinstance(outcome, CommandRefusedError), outcome
    with pytest.raises(CommandRefusedError, match="not connected"):
        await driver.set_parameter("COM_OF_LOSS_T", 1.0)
