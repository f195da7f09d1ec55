"""What the demonstration does when its mission fails, and its page."""

from __future__ import annotations

import asyncio
import re
import socket
import urllib.request
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from companion import demo
from companion.bus.config import zenoh_config
from companion.service import Service
from companion.settings import Settings, ZenohSection
from companion.vehicle.state import LandedState, VehicleState
from mavlink_sim.testing import free_port

FLYING = VehicleState(armed=True, ready_to_arm=True, landed=LandedState.IN_AIR)
LANDED = VehicleState(ready_to_arm=True, landed=LandedState.ON_GROUND)


class Driver:
    """A vehicle that is ready to be armed."""

    state = FLYING

    def subscribe(self, callback: Callable[[VehicleState], None]) -> Callable[[], None]:
        callback(self.state)
        return lambda: None


class FailingService:
    """Its missions fail in the air; a return lands."""

    def __init__(self, *, in_command: bool) -> None:
        self.driver, self.guidance = Driver(), SimpleNamespace(in_command=in_command)
        self.commands: list[str] = []

    async def command(self, text: str) -> dict[str, Any]:
        self.commands.append(text)
        if text == "rtl":
            self.driver.state = LANDED
        return {"success": text == "rtl", "reason": "the battery has 14%", "steps": []}


@pytest.mark.parametrize("in_command", [True, False])
async def test_a_failed_demo_returns_unless_the_pilot_flies(in_command: bool) -> None:
    service, flight = FailingService(in_command=in_command), demo._Flight()
    await demo._mission(cast(Service, service), flight)
    assert service.commands[1:] == (["rtl"] if in_command else [])
    assert flight.failure is not None
    assert flight.failure.startswith("the battery has 14%")
    assert flight.on_ground is flight.ended is in_command


async def test_demo_prints_the_address_of_its_page_which_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = ZenohSection(listen=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",))
    settings = Settings(zenoh=bus)
    assert settings.dashboard.listen == "127.0.0.1:8088"  # on by default
    port = free_port(socket.SOCK_STREAM)
    page = settings.dashboard.model_copy(update={"listen": f"127.0.0.1:{port}"})
    said: asyncio.Queue[str] = asyncio.Queue()
    answers: list[tuple[int, bytes]] = []

    async def mission(_service: object, _flight: object) -> None:
        found = re.search(r"http://[\d.:]+/", await asyncio.wait_for(said.get(), 30.0))
        assert found is not None
        assert found[0] == f"http://127.0.0.1:{port}/"
        answer = await asyncio.to_thread(urllib.request.urlopen, found[0], timeout=10.0)
        answers.append((answer.status, answer.read()))

    monkeypatch.setattr(demo, "_mission", mission)
    service = SimpleNamespace(settings=settings.model_copy(update={"dashboard": page}))
    with zenoh.open(zenoh_config(bus)):
        await demo._watched_mission(cast(Service, service), demo._Flight(), said.put_nowait)
    ((status, html),) = answers
    assert status == 200
    assert b"<title>" in html
