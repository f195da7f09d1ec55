"""The cameras' process, and a station in QGroundControl's order and timers, over a network that loses 30 %.

The order and the timers are those of `test_qgroundcontrol_order`, which has many cases in simulated time.
"""

from __future__ import annotations

import asyncio
import os
import random
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import cast

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station.component import Message
from companion.vehicle.framing import frames_of
from mavlink_sim.testing import free_port
from tests.companion.ground_station.station_harness import CAMERA_ID
from tests.companion.ground_station.test_ground_station_process import process_of_cameras, until
from tests.companion.ground_station.test_qgroundcontrol_order import ALL, COMPLETE_S, GONE_S, LOSS, Station
from tests.companion.service_process import heartbeats, running_service

pytestmark = [pytest.mark.realtime, pytest.mark.slow]


class RealTime:
    """The clock of the loop."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()

    @property
    def now_s(self) -> float:
        return self._loop.time()

    def after(self, seconds: float, call: Callable[[], None]) -> None:
        self._loop.call_later(seconds, call)


class LossyNetwork(asyncio.DatagramProtocol):
    """What the cameras' process sends to, with a station behind it. Both ways lose datagrams.

    Attributes:
        station: it gets what is not lost. heartbeat_s: when the newest heartbeat arrived here, lost or not;
            0: none did. active: it said so.
        passed, lost: datagrams.
    """

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._decoder = mavlink.MAVLink(None)
        self._transport: asyncio.DatagramTransport | None = None
        self._peer: tuple[str, int] | None = None
        self.station: Station | None = None
        self.heartbeat_s, self.active = 0.0, False
        self.passed = self.lost = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, source: tuple[str, int]) -> None:
        self._peer = source
        messages = [
            self._decoder.decode(bytearray(frame.raw))
            for frame in frames_of(data)
            if frame.component_id == CAMERA_ID and frame.message_id in mavlink.mavlink_map
        ]
        for message in messages:
            if message.get_type() == "HEARTBEAT":
                self.heartbeat_s = time.monotonic()
                self.active = message.system_status == mavlink.MAV_STATE_ACTIVE
        if self.station is not None and not self._is_lost():
            for message in messages:
                self.station.receive(message)

    def send(self, message: Message) -> None:
        """Send a message of the station to the process, unless it is lost."""
        if self._peer is not None and not self._is_lost():
            assert self._transport is not None
            self._transport.sendto(bytes(message.get_msgbuf()), self._peer)

    def _is_lost(self) -> bool:
        lost = self._random.random() < LOSS
        self.lost += lost
        self.passed += not lost
        return lost

    async def complete_s(self, since_s: float) -> float:
        """Seconds from then until the station knows everything."""
        station = self.station
        assert station is not None
        await until(lambda: station.known == ALL, 2 * COMPLETE_S)
        return time.monotonic() - since_s


async def test_a_third_lost_delays_by_seconds(filming: list[str], tmp_path: Path) -> None:
    port, loop = free_port(), asyncio.get_running_loop()
    _, network = await loop.create_datagram_endpoint(lambda: LossyNetwork(5), ("127.0.0.1", port))
    flags = [*filming, "--ground-station-url", f"udpout://127.0.0.1:{port}"]
    flags += ["--ground-station-video-listen", f"127.0.0.1:{free_port()}"]
    times_s: dict[str, float] = {}
    with ExitStack() as stack:
        autopilot = stack.enter_context(heartbeats())
        service = running_service(autopilot, flags, cwd=tmp_path)
        running = await asyncio.to_thread(stack.enter_context, service)
        await until(lambda: network.active)

        network.station = station = Station(RealTime(), network.send)
        times_s["station later"] = await network.complete_s(time.monotonic())

        stopped = process_of_cameras(running)
        os.kill(stopped, signal.SIGSTOP)
        silent_s = time.monotonic()
        await until(lambda: not station.known)
        assert time.monotonic() - silent_s > GONE_S - 1.0  # of the newest heartbeat
        os.kill(stopped, signal.SIGCONT)
        times_s["after a silence"] = await network.complete_s(time.monotonic())

        os.kill(stopped, signal.SIGSTOP)
        await until(lambda: not station.known)
        network.active = False
        killed_s = time.monotonic()
        os.kill(stopped, signal.SIGKILL)  # another process begins while the station is there
        await until(lambda: network.active and network.heartbeat_s > killed_s)
        times_s["station before"] = await network.complete_s(network.heartbeat_s)
        await asyncio.to_thread(stack.close)
    assert max(times_s.values()) < COMPLETE_S, times_s
    assert network.lost / (network.passed + network.lost) == pytest.approx(LOSS, abs=0.1)
