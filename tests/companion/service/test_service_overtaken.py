"""A command that waits for the gimbal begins nothing once something newer has happened."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

import pytest

from companion.guidance.behaviour import Behaviour, Outcome
from companion.guidance.pilot_event import PilotEvent, PilotEventKind
from companion.service import Service
from companion.settings.reading import load_settings
from companion.vehicle.state import FlightMode, LandedState, VehicleState

SEEK = "seek car sweep=-60"


class Waiting:
    """A service whose gimbal is being looked for, and what its pilot was told to fly."""

    def __init__(self) -> None:
        self.service = Service(load_settings(os.devnull, {"camera.gimbal": "true"}, {}))
        self.service.ready = True
        self.begun: list[str] = []
        self.looking, self.found = asyncio.Event(), asyncio.Event()
        self.service.driver.find_gimbal = self._find  # type: ignore[method-assign]
        self.service.pilot.command = self._command  # type: ignore[method-assign]
        now_ns = time.monotonic_ns()
        self.state = VehicleState(
            heartbeat_ns=now_ns, armed=True, mode=FlightMode.HOLD, landed=LandedState.IN_AIR
        )
        self.show()

    def show(self, **changes: Any) -> None:
        """What the autopilot tells from now on."""
        self.state = replace(self.state, **changes)
        self.service.driver._heard.state = self.state  # type: ignore[attr-defined]
        self.service._take_state(self.state)

    async def seek(self, meanwhile: Callable[[], Awaitable[None]]) -> dict[str, Any]:
        """The answer to a seek during whose wait something happens."""
        seeking = asyncio.create_task(self.service.command(SEEK))
        await self.looking.wait()
        await meanwhile()
        self.found.set()
        return await seeking

    async def _find(self) -> bool:
        self.looking.set()
        await self.found.wait()
        return False

    def _command(self, behaviour: Behaviour) -> asyncio.Future[Outcome]:
        self.begun.append(behaviour.name)
        ended: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        ended.set_result(Outcome(True, "flown"))
        return ended


async def test_where_nothing_happens_meanwhile_the_command_begins() -> None:
    waiting = Waiting()

    async def nothing() -> None:
        waiting.show(heartbeat_ns=time.monotonic_ns())

    assert (await waiting.seek(nothing))["success"]
    assert waiting.begun == ["seek"]


@pytest.mark.parametrize("newer", ["stop", "hold", "land", "gimbal pitch=-30"])
async def test_a_newer_command_overtakes_it(newer) -> None:
    waiting = Waiting()
    later: list[asyncio.Task[dict[str, Any]]] = []

    async def command() -> None:
        later.append(asyncio.create_task(waiting.service.command(newer)))
        await asyncio.sleep(0)

    reply = await waiting.seek(command)
    await asyncio.gather(*later)
    assert not reply["success"]
    assert reply["reason"].startswith("overtaken by ")
    assert reply["reason"].endswith(" while the gimbal was looked for")
    assert "seek" not in waiting.begun


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ([{"mode": FlightMode.POSITION}], "(now position, armed)"),
        ([{"armed": False}], "(now hold, disarmed)"),
        ([{"mode": FlightMode.POSITION}, {"mode": FlightMode.HOLD}], "(now hold, armed)"),
    ],
)
async def test_a_pilots_change_of_mode_or_a_disarming_overtakes_it(changes, words) -> None:
    waiting = Waiting()

    async def change() -> None:
        for change in changes:
            waiting.show(**change)

    reply = await waiting.seek(change)
    assert reply["reason"] == (
        f"overtaken by a change of the vehicle {words} while the gimbal was looked for"
    )
    assert waiting.begun == []


async def test_the_end_of_the_service_overtakes_it() -> None:
    waiting = Waiting()
    reply = await waiting.seek(waiting.service._leave)
    assert reply["reason"] == "overtaken by the end of the service while the gimbal was looked for"
    assert waiting.begun == []


@pytest.mark.parametrize("kind", [PilotEventKind.LOST, PilotEventKind.BATTERY])
async def test_a_loss_of_command_and_a_low_battery_overtake_it(kind) -> None:
    waiting = Waiting()

    async def happen() -> None:
        waiting.service._pilot_event(PilotEvent(1, kind, "follow", "the words"))

    reply = await waiting.seek(happen)
    assert reply["reason"] == "overtaken by an event (the words) while the gimbal was looked for"
    assert waiting.begun == []
