"""The chat of the page by real HTTP, at a stand-in of the service on a real bus."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import pytest

import companion.dashboard.chat
from companion.bus import topics
from companion.dashboard.chat import Chat, Chats
from companion.dashboard.fleet import Fleet
from companion.language import conversation, serve
from companion.language.sentences import is_stop
from companion.operator.reply_text import ENDED_BY_STOP
from companion.settings import LanguageSection, ZenohSection
from tests.companion.cli.test_ask import QUESTION, RED_CAR, Service, service
from tests.companion.dashboard.serving import POST, EventStream, request, serving
from tests.companion.dashboard.test_bridge import until
from tests.companion.language.language_server import ollama
from tests.companion.language.language_server import serving as serving_model

pytestmark = pytest.mark.realtime

VEHICLE = "vehicle"
AT_TEN_METRES = "circle the red car at ten metres"
FARTHER = "twice as far"
FORWARD = "go ten metres forward"


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

    async def until_alone(self) -> None:
        """Wait until the server has noticed that the other window was closed."""
        async with asyncio.timeout(20):
            while (news := await self._stream.next()) is None or news["windows"] > 1:
                pass

    def close(self) -> None:
        self._stream.close()


async def no_conversation(_chat: Chat) -> Any:
    raise AssertionError


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


async def test_confirmed_plan_is_flown_and_history_is_used() -> None:
    async with windows(names=("one", "two")) as (there, (window, other)):
        there.stopped.set()
        assert await window.post(text=AT_TEN_METRES) == 204
        plan = await window.until_plan()
        assert window.chat["model"] == ""
        assert window.chat["exchanges"] == [{"asked": AT_TEN_METRES, "answer": "orbit radius=10 track=3"}]
        assert there.commands == []
        # Neither another window nor an earlier plan's number confirms it.
        assert await other.post(plan=plan, fly=True) == 409
        assert await window.post(plan=plan + 1, fly=True) == 409
        assert await window.post(text="land") == 429
        assert await window.post(plan=plan, fly=True) == 204
        answer = await window.until_answered()
        *plan_lines, done = answer.splitlines()
        assert plan_lines == ["orbit radius=10 track=3", "confirmed"]
        assert done.split(": ") == ["done", "orbit", "ended"]
        assert there.commands == ["orbit radius=10 track=3"]
        assert await window.post(text=FARTHER) == 204
        later = await window.until_plan()
        assert window.chat["exchanges"][1]["answer"] == "orbit radius=20 track=3"
        assert await window.post(plan=later, fly=False) == 204
        assert (await window.until_answered()).splitlines()[-1] == "not executed"
        assert there.commands == ["orbit radius=10 track=3"]
        assert await window.post(plan=later, fly=True) == 409
        assert other.chat.get("exchanges", []) == []


@pytest.mark.parametrize("way", ["button", "sentence"])
async def test_stop_is_sent_and_ends_the_plan_that_waits(way: str) -> None:
    async with windows() as (there, (window,)):
        assert await window.post(text=RED_CAR) == 204
        plan = await window.until_plan()
        if way == "button":
            await window.command("stop")
        else:
            assert await window.post(text="Halt!") == 204
        await until(lambda: there.commands == ["stop"])
        await window.until(busy=False, plan=None)
        assert await window.post(plan=plan, fly=True) == 409
        assert "stop" in ENDED_BY_STOP
        assert ENDED_BY_STOP in window.chat["exchanges"][0]["answer"]
        assert there.commands == ["stop"]


async def test_stop_ends_what_the_chat_flies() -> None:
    async with windows(LanguageSection(may=("goto",))) as (there, (window,)):
        assert await window.post(text=FORWARD) == 204
        await asyncio.wait_for(there.flying.wait(), 20)
        await window.command("stop")
        await window.until(busy=False)
        assert there.commands == ["goto forward=10 right=0", "stop"]


async def test_reader_of_sentences_is_loaded_with_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = asyncio.Event()

    async def load(_: Chats) -> None:
        loaded.set()

    monkeypatch.setattr(Chats, "load", load)
    async with serving():
        await asyncio.wait_for(loaded.wait(), 20)


async def test_stop_while_a_sentence_is_read_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, read = asyncio.Event(), threading.Event()
    loop = asyncio.get_running_loop()
    # Both are imported now: with the replaced function they would keep it.
    assert vars(conversation)["is_stop"] is vars(serve)["is_stop"] is is_stop

    def slow_is_stop(text: str) -> bool:
        if text:
            loop.call_soon_threadsafe(reading.set)
            assert read.wait(20)
        return is_stop(text)

    monkeypatch.setattr("companion.language.sentences.is_stop", slow_is_stop)
    async with windows(LanguageSection(may=("goto",))) as (there, (window,)):
        asked = asyncio.create_task(window.post(text=FORWARD))
        await asyncio.wait_for(reading.wait(), 20)
        assert await window.command("stop") == 200
        read.set()
        assert await asked == 204
        assert await window.until_answered() == ENDED_BY_STOP
        assert there.commands == ["stop"]


async def test_sentence_that_survives_its_end_sends_no_command(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = asyncio.Event()

    async def stubborn(drone: Any, *_: Any) -> Any:
        class Stubborn:
            async def ask(self, _: str) -> None:
                waiting.set()
                with suppress(asyncio.CancelledError):
                    await asyncio.Event().wait()
                await drone.command("land")

        return lambda _operator: Stubborn()

    monkeypatch.setattr("companion.language.live.conversations", stubborn)
    async with windows() as (there, (window,)):
        assert await window.post(text="land") == 204
        await asyncio.wait_for(waiting.wait(), 20)
        await window.command("stop")
        assert await window.until_answered() == ENDED_BY_STOP
        assert there.commands == ["stop"]


@pytest.mark.parametrize("by", ["page", "other window", "elsewhere"])
async def test_plan_ends_with_another_command(by: str) -> None:
    async with windows(LanguageSection(may=("land",)), names=("one", "two")) as (there, (window, other)):
        assert await window.post(text=RED_CAR) == 204
        plan = await window.until_plan()
        if by == "page":
            await window.command("land")
        elif by == "other window":
            assert await other.post(text="land") == 204
        else:
            there.bus.publish(topics.EVENTS, {"stamp_ns": 1, "level": "info", "text": "command: land"})
        assert "not executed: " in await window.until_answered()
        assert window.chat["plan"] is None
        assert await window.post(plan=plan, fly=True) == 409
        await until(lambda: there.commands == ([] if by == "elsewhere" else ["land"]))


@pytest.mark.parametrize("watched", [True, False])
async def test_plan_ends_in_time_and_at_once_without_a_stream(
    watched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(companion.dashboard.chat, "PLAN_S", 0.0 if watched else 60.0)
    chat = Chat(VEHICLE, no_conversation, lambda: watched)
    assert not await asyncio.wait_for(chat.confirm(), 20)
    assert chat.state()["plan"] is None
    assert "not executed: " in chat.current.answer


async def test_plan_ends_with_the_last_stream_of_its_window() -> None:
    async with windows(names=("one", "two")) as (there, (window, other)):
        assert await window.post(text=RED_CAR) == 204
        plan = await window.until_plan()
        window.close()
        await other.until_alone()
        assert await window.post(plan=plan, fly=True) == 409
        assert there.commands == []


async def test_stop_is_sent_if_all_chats_are_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(companion.dashboard.chat, "MAX_CHATS", 1)
    async with windows(names=("one", "two")) as (there, (window, other)):
        assert await window.post(text=RED_CAR) == 204
        await window.until_plan()
        assert await other.post(text="land") == 429
        assert await other.post(text="Halt!") == 204
        await window.until(busy=False)
        await until(lambda: there.commands == ["stop"])


async def test_least_recently_used_idle_chat_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(companion.dashboard.chat, "MAX_CHATS", 2)
    chats = Chats(Fleet(ZenohSection(), VEHICLE), LanguageSection(), ())
    for window in ("one", "two", "one", "three"):
        assert await chats.ask(window, VEHICLE, "hold") == ""
        await until(lambda: not chats.state(window, VEHICLE)["busy"])  # noqa: B023
    lengths = [len(chats.state(window, VEHICLE)["exchanges"]) for window in ("one", "two", "three")]
    assert lengths == [2, 0, 1]


async def test_question_is_answered_by_a_model_that_streams() -> None:
    answers = ollama(calls=[("seen", {})]), ollama("two cars")
    async with (
        serving_model(*answers) as script,
        windows(LanguageSection(model="small", url=script.url)) as (there, (window,)),
    ):
        question = "what is down there?"
        assert await window.post(text=question) == 204
        assert (await window.until_answered()).startswith("two")
        assert window.chat["model"] == "small"
        assert len(script.requests) == 2
        assert there.commands == []


async def test_errors_are_shown_in_the_chat() -> None:
    language = LanguageSection(model="small", url="http://127.0.0.1:9")
    async with windows(language) as (_, (window,)):
        assert await window.post(text=QUESTION) == 204
        assert "ollama serve" in await window.until_answered()
    async with windows() as (_, (window,)):
        unknown = "circle the unicorn"
        assert await window.post(text=unknown) == 204
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
    chat = Chat(VEHICLE, no_conversation)
    for number in range(200):
        chat.add(f"{number}").write("x" * 5000)
    exchanges = chat.state()["exchanges"]
    assert exchanges[-1]["asked"] == "199"
    assert sum(len(each["answer"]) for each in exchanges) <= 45_000
