"""Each program that sends commands from threads sends them in the order in which it got them."""

from __future__ import annotations

import asyncio
import json
import queue
import threading
from collections.abc import Awaitable, Callable, Mapping
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, cast

import pytest

from companion.bus.child_client import ChildClient
from companion.bus.command_order import STOPPED, Turn, is_stop
from companion.client.attached import attached_target
from companion.client.drone import CommandFailedError, Drone
from companion.dashboard.fleet import Fleet
from companion.mqtt.publisher import _Publisher
from companion.ros2.cdr import decode, encode
from companion.ros2.requests import STRING, Requests
from companion.settings import ZenohSection
from companion.settings.operator import MqttSection

VEHICLE = "hawk"
WAIT_S = 30.0

Replies = list[Mapping[str, Any]]
Client = Callable[[list[str]], Awaitable[Replies]]
"""Gives all commands to a client at once; returns their replies in any order."""


class LateSends:
    """In place of `send_command`: a `goto` waits for its service until another command is ready."""

    def __init__(self) -> None:
        self.sent: list[str] = []
        self._other = threading.Event()

    def __call__(
        self, session: Any, vehicle: str, text: str, *, turn: Turn | None = None, **_: Any
    ) -> dict[str, Any]:
        with turn or nullcontext():
            if text.startswith("goto"):
                self._other.wait(WAIT_S)
            elif turn is not None:
                self._other.set()
            if turn is not None and (not_sent := turn.wait()) is not None:
                return {"success": False, "reason": not_sent}
            self.sent.append(text)
            self._other.set()
            return {"success": True, "reason": "done"}


async def of_a_console(texts: list[str]) -> Replies:
    target = attached_target(cast(Any, object()), VEHICLE, print)
    return await asyncio.gather(*map(target.command, texts))


async def of_a_program(texts: list[str]) -> Replies:
    drone = Drone(cast(Any, object()), VEHICLE)
    drone._endings = cast(Any, object())
    drones = [drone, drone.other("owl").other(VEHICLE)]

    async def reply(number: int, text: str) -> Mapping[str, Any]:
        try:
            return await drones[number % 2].command(text)
        except CommandFailedError as error:
            return error.reply

    drones[1]._endings = cast(Any, object())
    return await asyncio.gather(*(reply(number, text) for number, text in enumerate(texts)))


async def of_the_dashboard(texts: list[str]) -> Replies:
    fleet = Fleet(ZenohSection(), VEHICLE)
    fleet._link.loop, fleet._link.session = asyncio.get_running_loop(), cast(Any, object())
    outcomes = [fleet.command(VEHICLE, text, "") for text in texts]
    return [await outcome for outcome in outcomes if outcome is not None]


async def of_mqtt(texts: list[str]) -> Replies:
    client = ChildClient(
        ZenohSection(), {"mqtt": MqttSection().model_dump(mode="json"), "vehicle": VEHICLE, "cameras": []}
    )
    publisher, results = _Publisher(client, cast(Any, object())), asyncio.Queue[dict[str, Any]]()
    publisher._link = cast(
        Any, SimpleNamespace(event=lambda _, payload: results.put_nowait(json.loads(payload)))
    )
    for text in texts:
        publisher._on_command(text)
    return [await results.get() for _ in texts]


async def of_ros(texts: list[str]) -> Replies:
    results = queue.SimpleQueue[dict[str, Any]]()

    def on_result(payload: bytes) -> None:
        results.put(json.loads(decode(STRING, payload)["data"]))

    session = cast(Any, SimpleNamespace(declare_publisher=lambda *_, **__: None))
    requests = Requests(session, VEHICLE, commands=True, publish_result=on_result, say=print)
    for text in texts:
        requests.on_command("command", STRING, memoryview(encode(STRING, {"data": text})), 0)
    return [await asyncio.to_thread(results.get, timeout=WAIT_S) for _ in texts]


@pytest.fixture(
    params=[
        ("companion.client.attached", of_a_console),
        ("companion.client.drone", of_a_program),
        ("companion.dashboard.fleet", of_the_dashboard),
        ("companion.mqtt.publisher", of_mqtt),
        ("companion.ros2.requests", of_ros),
    ],
    ids=lambda param: param[1].__name__,
)
def client(request: pytest.FixtureRequest) -> tuple[str, Client]:
    return cast(tuple[str, Client], request.param)


async def replies_of(
    client: tuple[str, Client], texts: list[str], monkeypatch: pytest.MonkeyPatch
) -> tuple[LateSends, Replies]:
    module, ask = client
    sends = LateSends()
    monkeypatch.setattr(f"{module}.send_command", sends)
    async with asyncio.timeout(WAIT_S):
        return sends, await ask(texts)


async def test_commands_given_at_once_are_sent_in_order(
    client: tuple[str, Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = ["goto 1 0", "hold"]
    sends, replies = await replies_of(client, texts, monkeypatch)
    assert sends.sent == texts
    assert all(reply["success"] for reply in replies)


async def test_stop_is_sent_and_the_commands_before_it_are_not(
    client: tuple[str, Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where more commands wait for their outcome than are allowed at once."""
    texts = [*(f"goto {number} 0" for number in range(20)), "STOP "]
    sends, replies = await replies_of(client, texts, monkeypatch)
    assert list(map(is_stop, sends.sent)) == [True]
    assert [reply["success"] for reply in replies].count(True) == 1
    assert STOPPED in [reply["reason"] for reply in replies]
