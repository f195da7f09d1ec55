"""The chats of the page: plain sentences to a vehicle, by the same code as `companion ask`.

A window has one chat for each vehicle. Its state is small and sent whole. What moves the vehicle is flown
after the window has confirmed it. A stop of the vehicle ends what its chats do. The code that reads sentences
loads OpenCV, so it is imported with the first one.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from companion.bus.client import NoAnswerError
from companion.client import Drone
from companion.client.commands import Reply
from companion.dashboard.fleet import Fleet
from companion.plugins import PluginError, load_plugins
from companion.settings import LanguageSection

if TYPE_CHECKING:
    from companion.language.conversation import Conversation

logger = logging.getLogger(__name__)

MAX_CHATS = 32
MAX_SENTENCE_CHARACTERS = 2000
_KEPT_EXCHANGES, _KEPT_CHARACTERS = 20, 40_000
# Each occupies a thread of the pool, which a stop of all vehicles needs too.
_BEGINNING = 2
# Unique over all chats: a late click cannot confirm another plan.
_plan_numbers = itertools.count(1)
_STOPPED_WITHIN_S = 1.0
_BUSY = "busy with another sentence; STOP ends it"


@dataclass(slots=True)
class Exchange:
    """A sentence, and what an operator reads in answer."""

    asked: str
    answer: str = ""

    def write(self, piece: str) -> None:
        """Add a piece of an answer."""
        self.answer += piece

    def show(self, line: str) -> None:
        """Add a line; an empty one only ends the line before."""
        self.answer = "\n".join(part for part in (self.answer.rstrip("\n"), line) if part)


class Chat:
    """One window's chat with one vehicle.

    Attributes:
        current: the newest exchange that a conversation answers.

    Args:
        converse: makes the conversation.
    """

    def __init__(self, vehicle: str, converse: Callable[[Chat], Awaitable[Conversation]]) -> None:
        self.vehicle = vehicle
        self._converse = converse
        self._conversation: Conversation | None = None
        self._exchanges: deque[Exchange] = deque(maxlen=_KEPT_EXCHANGES)
        self.current = Exchange("")
        self._running: asyncio.Task[None] | None = None
        # The plan that waits for its confirmation.
        self._plan: tuple[int, asyncio.Future[bool]] | None = None

    @property
    def busy(self) -> bool:
        """Whether a sentence is being answered."""
        return self._running is not None

    def state(self) -> dict[str, Any]:
        """What the window shows. `plan`: number of the plan that waits for its confirmation, or None."""
        return {
            "busy": self.busy,
            "plan": None if self._plan is None else self._plan[0],
            "exchanges": [{"asked": each.asked, "answer": each.answer} for each in self._exchanges],
        }

    def begin(self, text: str) -> None:
        """Answer a sentence; none is being answered."""
        self._running = asyncio.create_task(self._run(self.add(text), text))

    def end(self) -> None:
        """End what is being answered; what it flies is stopped."""
        if self._running is not None:
            self._running.cancel()

    def add(self, asked: str) -> Exchange:
        """Add an exchange. The oldest are dropped."""
        self._exchanges.append(exchange := Exchange(asked))
        while sum(len(each.answer) for each in self._exchanges) > _KEPT_CHARACTERS:
            self._exchanges.popleft()
        return exchange

    def answer_plan(self, number: int, *, fly: bool) -> bool:
        """Confirm or decline a plan; False: it does not wait any more."""
        if self._plan is None or self._plan[0] != number or self._plan[1].done():
            return False
        self._plan[1].set_result(fly)
        return True

    async def confirm(self) -> bool:
        """Wait for the window's answer to the plan that was shown."""
        self._plan = next(_plan_numbers), asyncio.get_running_loop().create_future()
        try:
            fly = await self._plan[1]
        finally:
            self._plan = None
        self.current.show("confirmed" if fly else "not flown")
        return fly

    async def _run(self, exchange: Exchange, text: str) -> None:
        from companion.language.endpoints import LanguageError

        self.current = exchange
        try:
            if self._conversation is None:
                self._conversation = await self._converse(self)
            await self._conversation.ask(text)
        except asyncio.CancelledError:
            exchange.show("ended by stop")
            raise
        except (NoAnswerError, LanguageError, PluginError, ValueError) as error:
            exchange.show(str(error))
        except Exception as error:
            logger.exception("the sentence %r failed", text)
            exchange.show(f"{type(error).__name__}: {error}")
        finally:
            self._running = None


class Chats:
    """The chats of all windows, by window and vehicle.

    Args:
        plugins: modules, loaded with the first sentence.
    """

    def __init__(self, fleet: Fleet, language: LanguageSection, plugins: tuple[str, ...]) -> None:
        self._fleet, self._language, self._plugins = fleet, language, plugins
        self._chats: dict[tuple[str, str], Chat] = {}
        self._beginning = asyncio.Semaphore(_BEGINNING)
        self._noting: set[asyncio.Task[None]] = set()

    def state(self, window: str, vehicle: str) -> dict[str, Any]:
        """What a window shows. `model`: empty if sentences are read by patterns."""
        chat = self._chats.get((window, vehicle))
        shown = {"busy": False, "plan": None, "exchanges": []} if chat is None else chat.state()
        return {"model": self._language.model, **shown}

    async def ask(self, window: str, vehicle: str, text: str) -> str:
        """Begin to answer a sentence. Returns why it is not; empty: it is."""
        chat = self._chat(window, vehicle)
        if chat is None:
            return f"at most {MAX_CHATS} chats"
        if text.strip().lower() == "stop" or await self._is_stop(text):
            self._stop(chat, text)
        elif chat.busy:
            return _BUSY
        else:
            chat.begin(text)
        return ""

    def answer_plan(self, window: str, vehicle: str, number: int, *, fly: bool) -> bool:
        """Confirm or decline a plan; False: it does not wait any more."""
        chat = self._chats.get((window, vehicle))
        return chat is not None and chat.answer_plan(number, fly=fly)

    def end(self, vehicle: str | None = None) -> None:
        """End what the chats of a vehicle do; None: of all."""
        for chat in self._chats.values():
            if vehicle in (None, chat.vehicle):
                chat.end()

    async def _is_stop(self, text: str) -> bool:
        def is_stop_() -> bool:
            import companion.language.live  # noqa: F401, it takes long
            from companion.language.sentences import is_stop

            return is_stop(text)

        return await asyncio.to_thread(is_stop_)

    def _stop(self, chat: Chat, text: str) -> None:
        self.end(chat.vehicle)  # first: they send nothing after the stop
        exchange, outcome = chat.add(text), self._fleet.command(chat.vehicle, "stop", "")

        async def note() -> None:
            if outcome is None:
                exchange.show("too many commands are waiting for their outcome")
                return
            reply = await outcome
            exchange.show(f"{'done' if reply['success'] else 'failed'}: {reply['reason']}")

        task = asyncio.create_task(note())
        self._noting.add(task)
        task.add_done_callback(self._noting.discard)

    def _chat(self, window: str, vehicle: str) -> Chat | None:
        """Return the chat of a window; None: too many are busy."""
        key = window, vehicle
        if key not in self._chats:
            if len(self._chats) >= MAX_CHATS:
                idle = next((other for other, chat in self._chats.items() if not chat.busy), None)
                if idle is None:
                    return None
                del self._chats[idle]
            self._chats[key] = Chat(vehicle, self._converse)
        return self._chats[key]

    async def _converse(self, chat: Chat) -> Conversation:
        """A conversation with a vehicle whose operator is a window.

        Raises:
            NoAnswerError: no service. LanguageError, PluginError, ValueError: of the settings.
        """
        from companion.language.conversation import Operator
        from companion.language.endpoints import endpoint_from
        from companion.language.live import conversations
        from companion.language.tools import check_words

        session = self._fleet.session
        if session is None:
            raise NoAnswerError(self._fleet.problem)
        await asyncio.to_thread(load_plugins, self._plugins)
        check_words("language.may", self._language.may)
        endpoint = await asyncio.to_thread(endpoint_from, self._language)
        async with self._beginning:
            converse = await conversations(_ChatDrone(session, chat.vehicle), endpoint, self._language.may)
        operator = Operator(
            lambda piece: chat.current.write(piece), lambda line: chat.current.show(line), chat.confirm
        )
        return converse(operator)


class _ChatDrone(Drone):
    """A chat's vehicle."""

    async def command(self, text: str) -> Reply:
        """As the client's. Cancelled by a stop, it sends one of its own only if that stop does not end it."""
        flown = asyncio.ensure_future(super().command(text))
        try:
            return await asyncio.shield(flown)
        except asyncio.CancelledError:
            await asyncio.wait({flown}, timeout=_STOPPED_WITHIN_S)
            flown.cancel()
            await asyncio.gather(flown, return_exceptions=True)
            raise
