"""The chat of the page by real HTTP, at a stand-in of the service on a real bus."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from companion.dashboard.chat import Chat
from companion.settings import LanguageSection
from tests.companion.cli.test_ask import Service, service
from tests.companion.dashboard.serving import POST, EventStream, request, serving
from tests.companion.dashboard.test_bridge import until
from tests.companion.language.language_server import ollama
from tests.companion.language.language_server import serving as serving_model

pytestmark = pytest.mark.realtime

VEHICLE = "vehicle"


class Window:
    """One window of the page."""

    def __init__(self, port: int, name: str, stream: EventStream) -> None:
        self._port, self._name, self._stream = port, name, stream
        self.chat: dict[str, Any] = {}

    async def until_connected(self) -> None:
        async with asyncio.timeout(20):
            while (news := await self._stream.next()) is None or news["problem"]:
                pass

    async def post(self, **sent: Any) -> int:
        body = {"window": self._name, "vehicle": VEHICLE, **sent}
        return (await request(self._port, "POST", "/ask", POST, body))[0]

    async def command(self, text: str) -> int:
        return (await request(self._port, "POST", "/command", POST, {"text": text, "vehicle": VEHICLE}))[0]

    async def until(self, **wanted: Any) -> dict[str, Any]:
        """The chat when some of its values are these, and nothing else is being written."""
        async with asyncio.timeout(20):
            while not wanted.items() <= self.chat.items():
                news = await self._stream.next()
                assert news is not None
                self.chat = news["chat"] or self.chat
        return self.chat

    async def until_plan(self) -> int:
        async with asyncio.timeout(20):
            while not self.chat.get("plan"):
                await self.until_new()
        plan: int = self.chat["plan"]
        return plan

    async def until_new(self) -> None:
        before = self.chat
        while self.chat is before:
            news = await self._stream.next()
            assert news is not None
            self.chat = news["chat"] or self.chat

    async def until_answered(self) -> str:
        """The newest answer when the chat is not busy any more."""
        async with asyncio.timeout(20):
            while self.chat.get("busy", True) or not self.chat["exchanges"]:
                await self.until_new()
        answer: str = self.chat["exchanges"][-1]["answer"]
        return answer

    def close(self) -> None:
        self._stream.close()


@asynccontextmanager
async def windows(
    language: LanguageSection | None = None, names: tuple[str, ...] = ("one",)
) -> AsyncIterator[tuple[Service, list[Window]]]:
    async with service() as there, serving(there.endpoint, language=language) as port:
        opened = [
            Window(port, name, await EventStream.open(port, f"?vehicle={VEHICLE}&window={name}"))
            for name in names
        ]
        try:
            for each in opened:
                await each.until_connected()
            yield there, opened
        finally:
            for each in opened:
                each.close()


async def test_plan_is_flown_after_its_confirmation_and_history_is_used() -> None:
    async with windows(names=("one", "two")) as (there, (window, other)):
        there.stopped.set()
        assert await window.post(text="circle the red car at ten metres") == 204
        plan = await window.until_plan()
        assert window.chat["model"] == ""
        assert window.chat["exchanges"] == [
            {"asked": "circle the red car at ten metres", "answer": "orbit track=3"}
        ]
        assert there.commands == []
        # Neither another window nor an earlier plan's number confirms it.
        assert await other.post(plan=plan, fly=True) == 409
        assert await window.post(plan=plan + 1, fly=True) == 409
        assert await window.post(text="land") == 429
        assert await window.post(plan=plan, fly=True) == 204
        answer = await window.until_answered()
        assert answer.splitlines() == ["orbit track=3", "confirmed", "done: orbit: ended"]
        assert there.commands == ["orbit track=3"]
        assert await window.post(text="twice as far") == 204
        later = await window.until_plan()
        assert window.chat["exchanges"][1]["answer"] == "orbit radius=20 track=3"
        assert await window.post(plan=later, fly=False) == 204
        assert (await window.until_answered()).splitlines()[-1] == "not flown"
        assert there.commands == ["orbit track=3"]
        assert await window.post(plan=later, fly=True) == 409
        assert other.chat.get("exchanges", []) == []


@pytest.mark.parametrize("way", ["button", "sentence"])
async def test_stop_is_sent_and_ends_the_plan_that_waits(way: str) -> None:
    async with windows() as (there, (window,)):
        assert await window.post(text="circle the red car") == 204
        plan = await window.until_plan()
        if way == "button":
            await window.command("stop")
        else:
            assert await window.post(text="Halt!") == 204
        await until(lambda: there.commands == ["stop"])
        await window.until(busy=False, plan=None)
        assert await window.post(plan=plan, fly=True) == 409
        assert "ended by stop" in window.chat["exchanges"][0]["answer"]
        assert there.commands == ["stop"]


async def test_stop_ends_what_the_chat_flies() -> None:
    async with windows(LanguageSection(may=("orbit",))) as (there, (window,)):
        assert await window.post(text="circle the red car") == 204
        await asyncio.wait_for(there.flying.wait(), 20)
        await window.command("stop")
        await window.until(busy=False)
        assert there.commands == ["orbit track=3", "stop"]


async def test_question_is_answered_by_a_model_that_streams() -> None:
    answers = ollama(calls=[("seen", {})]), ollama("two cars")
    async with (
        serving_model(*answers) as script,
        windows(LanguageSection(model="small", url=script.url)) as (there, (window,)),
    ):
        assert await window.post(text="what is down there?") == 204
        assert (await window.until_answered()).startswith("two")
        assert window.chat["model"] == "small"
        assert len(script.requests) == 2
        assert there.commands == []


async def test_errors_are_shown_in_the_chat() -> None:
    language = LanguageSection(model="small", url="http://127.0.0.1:9")
    async with windows(language) as (_, (window,)):
        assert await window.post(text="what do you see?") == 204
        assert "ollama serve" in await window.until_answered()
    async with windows() as (_, (window,)):
        assert await window.post(text="circle the unicorn") == 204
        assert "unicorn" in await window.until_answered()


@pytest.mark.parametrize(
    "sent",
    [
        {"text": ""},
        {"text": "x" * 2001},
        {"text": 5},
        {"plan": 1},
        {"plan": "1", "fly": True},
        {"text": "hold", "vehicle": "a/b"},
    ],
)
async def test_bad_request_is_refused(sent: dict[str, Any]) -> None:
    async with serving() as port:
        assert (await request(port, "POST", "/ask", POST, {"window": "one", **sent}))[0] == 400
        assert (await request(port, "POST", "/ask", POST, {"text": "hold"}))[0] == 400
        assert (await request(port, "POST", "/ask", {}, {"window": "one", "text": "hold"}))[0] == 403


async def test_chat_is_bounded() -> None:
    async def converse(_chat: Chat) -> Any:
        raise AssertionError

    chat = Chat(VEHICLE, converse)
    for number in range(200):
        chat.add(f"{number}").write("x" * 5000)
    exchanges = chat.state()["exchanges"]
    assert exchanges[-1]["asked"] == "199"
    assert sum(len(each["answer"]) for each in exchanges) <= 45_000
