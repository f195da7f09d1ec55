"""Whole flights over UDP, by pymavlink and by MAVSDK."""

import asyncio
import json
import time
from collections.abc import Callable
from typing import Any

import pytest
from mavsdk.asyncio import ComponentType
from mavsdk.asyncio.plugins.action import ActionAsync, ActionError
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync, MavlinkMessage
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from pymavlink import mavutil

from mavlink_sim.testing import QUICK_FLIGHT, vehicle
from tests.mavlink_sim.mavsdk_client import mavsdk_client, meanwhile, wait_for

pytestmark = pytest.mark.realtime

SPEED = 4.0  # simulated seconds a second; setpoints are sent by the simulated clock
SETPOINTS_LOST = "failsafe: offboard setpoints lost, RTL"  # an event line of docs/simulator.md


class Companion:
    """A pymavlink client that keeps the newest message of each type."""

    def __init__(self, port: int) -> None:
        self.link = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{port}", source_system=1, source_component=191, dialect="development"
        )
        self.newest: dict[str, Any] = {}
        self.acknowledged: list[tuple[int, int]] = []
        self._sent_ms = 0
        self.until(lambda: "HEARTBEAT" in self.newest)

    def until(
        self, condition: Callable[[], bool], setpoint: tuple[float, ...] | None = None, limit_s: float = 40.0
    ) -> None:
        """Read (and stream a body velocity, forward right down yaw-rate) until `condition` holds."""
        deadline = time.monotonic() + limit_s
        while not condition():
            assert time.monotonic() < deadline, self.newest.get("HEARTBEAT")
            message = self.link.recv_match(blocking=True, timeout=5.0)
            assert message is not None, "the vehicle fell silent"
            self.newest[message.get_type()] = message
            if message.get_type() == "COMMAND_ACK":
                self.acknowledged.append((message.command, message.result))
            if message.get_type() == "ATTITUDE" and message.time_boot_ms - self._sent_ms >= 50:
                self._sent_ms = message.time_boot_ms
                if setpoint is not None:
                    forward, right, down, yaw_rate = setpoint
                    self.link.mav.set_position_target_local_ned_send(
                        0, 1, 1, 8, 1479, 0, 0, 0, forward, right, down, 0, 0, 0, 0, yaw_rate
                    )

    def command(self, number: int, *values: float) -> None:
        """Send a command and wait for an ACCEPTED answer to it."""
        self.acknowledged.clear()
        padded = (*values, *([0.0] * (7 - len(values))))
        self.link.mav.command_long_send(1, 1, number, 0, *padded)
        self.until(lambda: (number, 0) in self.acknowledged)

    def mode(self) -> int:
        return int(self.newest["HEARTBEAT"].custom_mode)

    def armed(self) -> bool:
        return bool(self.newest["HEARTBEAT"].base_mode & 128)

    def height(self) -> float:
        return -float(self.newest["LOCAL_POSITION_NED"].z)


def test_pymavlink_flies_offboard_loses_stream_and_comes_home() -> None:
    with vehicle(speed=SPEED, parameters={**QUICK_FLIGHT, "RTL_RETURN_ALT": 5.0}) as simulator:
        companion = Companion(simulator.onboard_port)
        companion.until(lambda: companion.newest["HEARTBEAT"].system_status == 3)
        companion.command(400, 1)
        companion.command(22, *[float("nan")] * 7)
        companion.until(lambda: companion.mode() == 0x03040000 and companion.height() > 1.5)

        ahead = (2.0, 0.0, -0.5, 0.0)
        companion.newest.clear()
        companion.until(lambda: "HEARTBEAT" in companion.newest, ahead)
        companion.command(511, 436, 50_000)
        companion.command(176, 1, 6)
        companion.until(lambda: companion.mode() == 0x00060000, ahead)
        companion.until(lambda: companion.newest["LOCAL_POSITION_NED"].x > 5.0, ahead)

        # no more setpoints: the failsafe returns and lands without any command
        companion.until(lambda: companion.newest["CURRENT_MODE"].custom_mode == 0x05040000)
        assert companion.newest["CURRENT_MODE"].intended_custom_mode == 0x00060000
        companion.until(lambda: companion.newest["HEARTBEAT"].system_status == 5)
        companion.until(lambda: not companion.armed(), limit_s=60.0)

        position = companion.newest["LOCAL_POSITION_NED"]
        assert abs(position.x) < 2.0
        assert abs(position.y) < 2.0
        assert companion.newest["EXTENDED_SYS_STATE"].landed_state == 1
        companion.link.close()
        simulator.wait_for_event("disarmed (after landing)")
    assert simulator.events[:5] == ["armed", "mode TAKEOFF", "takeoff", "mode HOLD", "mode OFFBOARD"]
    assert SETPOINTS_LOST in simulator.events


AHEAD = {
    **dict.fromkeys(("time_boot_ms", "x", "y", "z", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate"), 0),
    "coordinate_frame": 8,
    "type_mask": 1479,
    "vx": 1.5,
}
TO_OFFBOARD: dict[str, float] = {
    "command": 176,
    "confirmation": 0,
    "param1": 1,
    "param2": 6,
    **dict.fromkeys(("param3", "param4", "param5", "param6", "param7"), 0),
}


def message(name: str, fields: dict[str, float]) -> MavlinkMessage:
    """A message from the companion to the autopilot."""
    addressed = {"target_system": 1, "target_component": 1, **fields}
    return MavlinkMessage(name, 1, 191, 1, 1, json.dumps(addressed))


async def test_mavsdk_flies_the_vehicle() -> None:
    async with vehicle(speed=SPEED, parameters=QUICK_FLIGHT) as simulator:
        url = f"udpin://127.0.0.1:{simulator.onboard_port}"
        async with mavsdk_client(url, ComponentType.COMPANION_COMPUTER) as system:
            action, telemetry = system.plugin(ActionAsync), system.plugin(TelemetryAsync)
            direct = system.plugin(MavlinkDirectAsync)
            await wait_for(telemetry.subscribe_health(), lambda health: health.is_armable)

            await action.set_takeoff_altitude(3.0)
            assert await action.get_takeoff_altitude() == pytest.approx(3.0)
            await action.arm()
            await action.takeoff()
            await wait_for(
                telemetry.subscribe_position(), lambda position: position.relative_altitude_m > 2.2
            )
            await wait_for(telemetry.subscribe_flight_mode(), lambda mode: mode.name == "HOLD")
            with pytest.raises(ActionError):
                await action.disarm()  # in the air

            async def stream() -> None:
                while True:
                    await direct.send_message(message("SET_POSITION_TARGET_LOCAL_NED", AHEAD))
                    await asyncio.sleep(0.02)

            async with meanwhile(stream()):
                await wait_for(direct.subscribe_message("POSITION_TARGET_LOCAL_NED"))
                answer = await direct.send_command(message("COMMAND_LONG", TO_OFFBOARD))
                assert json.loads(answer.fields_json)["result"] == 0
                await wait_for(telemetry.subscribe_flight_mode(), lambda mode: mode.name == "OFFBOARD")
                await wait_for(
                    telemetry.subscribe_position_velocity_ned(), lambda p: p.position.north_m > 3.0
                )
            await action.hold()
            await action.land()
            await asyncio.to_thread(simulator.wait_for_event, "mode LAND")
            await wait_for(telemetry.subscribe_armed(), lambda armed: not armed)
        simulator.wait_for_event("disarmed (after landing)")
    assert "landed" in simulator.events
