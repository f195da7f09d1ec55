"""The chats of the page: plain sentences to a vehicle, by the same code as `companion ask`.

A window has one chat for each vehicle. Its state is small and sent whole. Commands that move the vehicle are
sent after the window has confirmed them. A stop of the vehicle ends what its chats do, another command the
plans that wait. The code that reads sentences loads OpenCV, so it is imported in a thread, from the server's
start.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from companion.bus.client import NoAnswerError
from companion.bus.command_order import CommandOrder
from companion.client import Drone
from companion.client.commands import Reply
from companion.dashboard.fleet import Fleet
from companion.host.tasks import spawn
from companion.operator.reply_text import ENDED_BY_STOP
from companion.settings import LanguageSection
from companion.settings.plugins import PluginError, load_plugins

if TYPE_CHECKING:
    import zenoh

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
PLAN_S = 60.0
"""How long a plan waits for its confirmation."""
_OTHER_COMMAND = "another command was sent"
_NOT_WATCHED = "the window was closed or hidden"
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
        stops: number of the vehicle's stops before the newest sentence.

    Args:
        converse: makes the conversation. watched: whether the window has an open stream.
    """

    def __init__(
        self,
        vehicle: str,
        converse: Callable[[Chat], Awaitable[Conversation]],
        watched: Callable[[], bool] = lambda: True,
    ) -> None:
        self.vehicle, self.stops = vehicle, 0
        self._converse, self._watched = converse, watched
        self._conversation: Conversation | None = None
        self._exchanges: deque[Exchange] = deque(maxlen=_KEPT_EXCHANGES)
        self.current = Exchange("")
        self._running: asyncio.Task[None] | None = None
        # The plan that waits for its confirmation.
        self._plan: tuple[int, asyncio.Future[str]] | None = None

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

    def begin(self, text: str, stops: int) -> None:
        """Answer a sentence; none is being answered."""
        self.stops = stops
        self._running = spawn(self._run(self.add(text), text), "chat")

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
        self._plan[1].set_result("confirmed" if fly else "not executed")
        return True

    def end_plan(self, reason: str) -> None:
        """Decline the plan that waits, if there is one."""
        if self._plan is not None and not self._plan[1].done():
            self._plan[1].set_result(f"not executed: {reason}")

    async def confirm(self) -> bool:
        """Wait for the window's answer to the plan that was shown, at most `PLAN_S`."""
        loop = asyncio.get_running_loop()
        self._plan = next(_plan_numbers), loop.create_future()
        expiry = loop.call_later(PLAN_S, self.end_plan, f"not confirmed within {PLAN_S:g} s")
        if not self._watched():
            self.end_plan(_NOT_WATCHED)
        try:
            outcome = await self._plan[1]
        finally:
            expiry.cancel()
            self._plan = None
        self.current.show(outcome)
        return outcome == "confirmed"

    async def _run(self, exchange: Exchange, text: str) -> None:
        from companion.language.endpoints import LanguageError

        self.current = exchange
        try:
            if self._conversation is None:
                self._conversation = await self._converse(self)
            await self._conversation.ask(text)
        except asyncio.CancelledError:
            exchange.show(ENDED_BY_STOP)
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
        # The least recently used first.
        self._chats: dict[tuple[str, str], Chat] = {}
        self._stops: Counter[str | None] = Counter()
        self._streams: Counter[tuple[str, str]] = Counter()
        fleet.on_command(self.end_plans)
        self._beginning = asyncio.Semaphore(_BEGINNING)
        self._noting: set[asyncio.Task[None]] = set()

    def state(self, window: str, vehicle: str) -> dict[str, Any]:
        """What a window shows. `model`: empty if sentences are read by patterns."""
        chat = self._chats.get((window, vehicle))
        shown = {"busy": False, "plan": None, "exchanges": []} if chat is None else chat.state()
        return {"model": self._language.model, **shown}

    async def ask(self, window: str, vehicle: str, text: str) -> str:
        """Begin to answer a sentence. Returns why it is not; empty: it is."""
        stops = self._stops_of(vehicle)
        stop = text.strip().lower() == "stop" or await self._is_stop(text)
        chat = self._chat(window, vehicle)
        if stop:
            self._stop(chat or Chat(vehicle, self._converse), text)
        elif chat is None:
            return f"at most {MAX_CHATS} chats"
        elif stops != self._stops_of(vehicle):
            chat.add(text).show(ENDED_BY_STOP)
        elif chat.busy:
            return _BUSY
        else:
            chat.begin(text, stops)
        return ""

    def answer_plan(self, window: str, vehicle: str, number: int, *, fly: bool) -> bool:
        """Confirm or decline a plan; False: it does not wait any more."""
        chat = self._chats.get((window, vehicle))
        return chat is not None and chat.answer_plan(number, fly=fly)

    def end(self, vehicle: str | None = None) -> None:
        """End what the chats of a vehicle do; None: of all. They send nothing after it."""
        self._stops[vehicle] += 1
        for chat in self._chats.values():
            if vehicle in (None, chat.vehicle):
                chat.end()

    def end_plans(self, vehicle: str) -> None:
        """End the plans that wait: another command was sent to the vehicle."""
        for chat in self._chats.values():
            if chat.vehicle == vehicle:
                chat.end_plan(_OTHER_COMMAND)

    @contextmanager
    def watching(self, window: str, vehicle: str) -> Iterator[None]:
        """A window has an open stream meanwhile; its plan ends with the last one."""
        key = window, vehicle
        self._streams[key] += 1
        try:
            yield
        finally:
            self._streams[key] -= 1
            if not self._streams[key]:
                del self._streams[key]
                if (chat := self._chats.get(key)) is not None:
                    chat.end_plan(_NOT_WATCHED)

    async def load(self) -> None:
        """Import what reads sentences; it takes long."""
        await self._is_stop("")

    async def _is_stop(self, text: str) -> bool:
        def is_stop_() -> bool:
            import companion.language.live  # noqa: F401, it takes long
            from companion.language.sentences import is_stop

            return is_stop(text)

        return await asyncio.to_thread(is_stop_)

    def _stops_of(self, vehicle: str) -> int:
        return self._stops[vehicle] + self._stops[None]

    def _stop(self, chat: Chat, text: str) -> None:
        self.end(chat.vehicle)  # first: they send nothing after the stop
        exchange, outcome = chat.add(text), self._fleet.command(chat.vehicle, "stop", "")

        async def note() -> None:
            if outcome is None:
                exchange.show("too many commands are waiting for their outcome")
                return
            reply = await outcome
            exchange.show(f"{'done' if reply['success'] else 'failed'}: {reply['reason']}")

        task = spawn(note(), "stop in a chat")
        self._noting.add(task)
        task.add_done_callback(self._noting.discard)

    def _chat(self, window: str, vehicle: str) -> Chat | None:
        """Return the chat of a window; None: too many are busy."""
        key = window, vehicle
        chat = self._chats.pop(key, None)
        if chat is None:
            if len(self._chats) >= MAX_CHATS:
                idle = next((other for other, each in self._chats.items() if not each.busy), None)
                if idle is None:
                    return None
                del self._chats[idle]
            chat = Chat(vehicle, self._converse, lambda: key in self._streams)
        self._chats[key] = chat
        return chat

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
            drone = _ChatDrone(session, chat.vehicle, self._fleet.order, lambda: self._before_command(chat))
            converse = await conversations(drone, endpoint, self._language.may)
        operator = Operator(
            lambda piece: chat.current.write(piece), lambda line: chat.current.show(line), chat.confirm
        )
        return converse(operator)

    def _before_command(self, chat: Chat) -> None:
        if chat.stops != self._stops_of(chat.vehicle):
            raise asyncio.CancelledError
        self.end_plans(chat.vehicle)


class _ChatDrone(Drone):
    """A chat's vehicle.

    Args:
        order: of the page's commands too, so that its `stop` is the last one.
        before_command: called before each; raises CancelledError after a stop.
    """

    def __init__(
        self, session: zenoh.Session, name: str, order: CommandOrder, before_command: Callable[[], None]
    ) -> None:
        super().__init__(session, name)
        self._order, self._before_command = order, before_command

    async def command(self, text: str) -> Reply:
        """As the client's. Cancelled by a stop, it sends one of its own only if that stop does not end it."""
        self._before_command()
        running = asyncio.ensure_future(super().command(text))
        try:
            return await asyncio.shield(running)
        except asyncio.CancelledError:
            await asyncio.wait({running}, timeout=_STOPPED_WITHIN_S)
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            raise
