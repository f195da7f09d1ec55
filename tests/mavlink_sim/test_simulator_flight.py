"""A whole flight over UDP, by pymavlink; MAVSDK's are in test_client_mavsdk.py."""

import time
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink import mavutil

from mavlink_sim.testing import QUICK_FLIGHT, vehicle

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
        companion.until(lambda: companion.newest["LOCAL_POSITION_NED"].x > 3.0, ahead)

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
