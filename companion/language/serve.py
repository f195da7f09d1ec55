"""Questions and orders on zenoh: a queryable `ask` beside those of the service, in a process of the operator.

Nobody confirms here: only the commands of `language.may` are executed.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable
from contextlib import suppress

import zenoh

from companion.bus.topics import ROOT
from companion.client import NoAnswerError
from companion.host.peer_data import PeerDataError, copy_payload
from companion.host.tasks import spawn
from companion.language.conversation import Conversation, Operator
from companion.language.endpoints import LanguageError
from companion.language.sentences import is_stop
from companion.operator.reply_text import ENDED_BY_STOP

ASK = "ask"
MAX_SENTENCE_BYTES = 2000

logger = logging.getLogger(__name__)


class Lines:
    """Collects what an operator would read."""

    def __init__(self) -> None:
        self.text = ""

    def write(self, piece: str) -> None:
        self.text += piece

    def show(self, line: str) -> None:
        self.text = "\n".join(part for part in (self.text.rstrip("\n"), line) if part)

    async def confirm(self) -> bool:
        self.show("not executed: nobody confirms it here; language.may lists what needs no confirmation")
        return False


async def serve(session: zenoh.Session, vehicle: str, converse: Callable[[Operator], Conversation]) -> None:
    """Answer queries until cancelled, one at a time; `stop` ends the one that is being answered.

    The payload is a sentence, the reply JSON: {"success": bool, "answer": str}. A sentence that comes
    meanwhile is refused: its commands would be sent when its asker no longer expects it.

    Args:
        converse: makes the conversation, whose history all queries share.
    """
    lines = Lines()
    operator = Operator(
        lambda piece: lines.write(piece), lambda line: lines.show(line), lambda: lines.confirm()
    )
    conversation = converse(operator)
    running: asyncio.Task[bool | str] | None = None
    loop, tasks = asyncio.get_running_loop(), set[asyncio.Task[None]]()

    async def answer(query: zenoh.Query) -> None:
        nonlocal lines, running
        sentence = query.payload
        try:
            data = b"" if sentence is None else copy_payload(sentence, MAX_SENTENCE_BYTES)
        except PeerDataError as error:
            await reply(query, f"sentence refused: {error}", "")
            return
        text = data.decode(errors="replace")
        if is_stop(text):
            if running is not None:
                running.cancel()  # first: it sends nothing after the stop
            own = Lines()
            stopping = converse(Operator(own.write, own.show, own.confirm))
            await reply(query, await _attempt(stopping, text), "stop")
            return
        if running is not None:
            await reply(query, "busy with another sentence; `stop` ends it", "")
            return
        lines = Lines()
        running = loop.create_task(_attempt(conversation, text))
        try:
            await asyncio.wait((running,))
            await reply(query, ENDED_BY_STOP if running.cancelled() else running.result(), lines.text)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            running = None

    async def reply(query: zenoh.Query, outcome: bool | str, text: str) -> None:
        failed = isinstance(outcome, str)
        body = {"success": outcome is True, "answer": outcome if failed else text}
        with query, suppress(zenoh.ZError):  # the asker has gone
            query.reply(query.key_expr, json.dumps(body))

    def begin(query: zenoh.Query) -> None:
        task = spawn(answer(query), "answer to a query")
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    def receive(query: zenoh.Query) -> None:
        with suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(begin, query)

    queryable = session.declare_queryable(f"{ROOT}/{vehicle}/{ASK}", receive)
    try:
        await asyncio.Event().wait()
    finally:
        queryable.undeclare()  # type: ignore[no-untyped-call]
        for task in tuple(tasks):
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _attempt(conversation: Conversation, text: str) -> bool | str:
    """Success, or the error in a line."""
    try:
        return await conversation.ask(text)
    except (LanguageError, NoAnswerError) as error:
        return str(error)
    except Exception as error:
        logger.exception("the question %r failed", text)
        return f"{type(error).__name__}: {error}"
