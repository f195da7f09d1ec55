"""Two services behind a MAVLink router on one vehicle: each detects the other, and the later one refuses."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.service.other_commanders import FOREIGN_COMMAND
from companion.vehicle import autopilot_driver
from companion.vehicle.framing import pack_frame
from companion.vehicle.own_address import OwnAddress
from companion.vehicle.state import FlightMode
from mavlink_sim.testing import free_port
from tests.companion.live_flight import LiveFlight
from tests.companion.mavlink_router import mavlink_router
from tests.companion.vehicle.fake_autopilot import FakeAutopilot, sender_of

pytestmark = pytest.mark.realtime


@asynccontextmanager
async def two_flights(
    *, timesync: bool, kind: str = "pymavlink"
) -> AsyncIterator[tuple[LiveFlight, LiveFlight, FakeAutopilot]]:
    """Two services, not connected yet, behind a router. `timesync`: its answers name their receiver."""
    port, ports = free_port(), (free_port(), free_port())
    autopilot = FakeAutopilot(port)

    def answer(message: Any) -> None:
        if message.tc1 == 0:
            payload = struct.pack("<qqBB", 7_000_000_000, message.ts1, *sender_of(message))
            autopilot.send_bytes(
                pack_frame(mavlink.MAVLINK_MSG_ID_TIMESYNC, payload, system_id=1, component_id=1, sequence=0)
            )

    if timesync:
        autopilot.answers["TIMESYNC"] = answer
    async with mavlink_router(port, ports):
        autopilot.start()
        try:
            first, second = LiveFlight(kind, ports[0], ran_s=60.0), LiveFlight(kind, ports[1])
            yield first, second, autopilot
        finally:
            await autopilot.stop()


def start_at_the_same_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither receives the other's heartbeat before it sends its own, with the same id."""
    monkeypatch.setattr(OwnAddress, "is_taken", lambda *_: False)
    monkeypatch.setattr(autopilot_driver, "LISTEN_S", 0.0)


def addresses(flight: LiveFlight) -> set[tuple[int, int]]:
    return {other.address for other in flight.driver.state.other_commanders}


async def each_notices_the_other(first: LiveFlight, second: LiveFlight) -> None:
    await first.until(lambda: second.driver.own_address in addresses(first))
    await second.until(lambda: first.driver.own_address in addresses(second))
    refused = await second.fly("hold")
    assert "allow_other_commander" in refused.reason
    assert "allow_other_commander" not in (await first.fly("hold")).reason


@pytest.mark.parametrize("kind", ["pymavlink", "mavsdk"])
async def test_later_service_takes_another_id_and_refuses(kind: str) -> None:
    async with two_flights(timesync=False, kind=kind) as (first, second, _):
        async with first.running(), second.running():
            assert (first.driver.own_address, second.driver.own_address) == ((1, 191), (1, 192))
            await each_notices_the_other(first, second)
        assert [level for level, text in second.events if "1/192" in text] == ["warning"]


async def test_services_that_start_together_part_and_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    start_at_the_same_moment(monkeypatch)
    async with two_flights(timesync=True) as (first, second, _), first.running(), second.running():
        assert first.driver.own_address == second.driver.own_address
        await first.until(lambda: first.driver.own_address != second.driver.own_address)
        await each_notices_the_other(first, second)


async def test_foreign_acknowledgement_refuses_and_changes_the_id(monkeypatch: pytest.MonkeyPatch) -> None:
    start_at_the_same_moment(monkeypatch)
    async with two_flights(timesync=False) as (first, second, _), first.running(), second.running():
        assert first.driver.own_address == second.driver.own_address
        request = asyncio.create_task(first.driver.set_mode(FlightMode.HOLD))
        await second.until(
            lambda: second.others.status(second.driver.state, second.driver.state.heartbeat_ns)
        )
        assert FOREIGN_COMMAND in (await second.fly("hold")).reason
        await request
        # The router never delivers 1/191 to the second one, which has sent with it; the first one sees both.
        await first.until(lambda: second.driver.own_address in addresses(first))
        assert second.driver.own_address != first.driver.own_address
