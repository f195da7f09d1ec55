"""Questions and orders on zenoh: a queryable `ask` beside those of the service, in a process of the operator.

Nobody confirms here: only the commands of `language.may` are flown.
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
from companion.language.conversation import Conversation, Operator
from companion.language.endpoints import LanguageError
from companion.language.sentences import is_stop

ASK = "ask"
MAX_SENTENCE_BYTES = 2000

logger = logging.getLogger(__name__)


class _Lines:
    """Collects what an operator would read."""

    def __init__(self) -> None:
        self.text = ""

    def write(self, piece: str) -> None:
        self.text += piece

    def show(self, line: str) -> None:
        self.text = "\n".join(part for part in (self.text.rstrip("\n"), line) if part)

    async def confirm(self) -> bool:
        self.show("not flown: nobody confirms it here; language.may lists what needs no confirmation")
        return False


async def serve(session: zenoh.Session, vehicle: str, converse: Callable[[Operator], Conversation]) -> None:
    """Answer queries until cancelled, one after the other; `stop` waits for none.

    The payload is a sentence, the reply JSON: {"success": bool, "answer": str}.

    Args:
        converse: makes the conversation, whose history all queries share.
    """
    lines = _Lines()
    operator = Operator(
        lambda piece: lines.write(piece), lambda line: lines.show(line), lambda: lines.confirm()
    )
    conversation, one_by_one = converse(operator), asyncio.Lock()
    loop, tasks = asyncio.get_running_loop(), set[asyncio.Task[None]]()

    async def answer(query: zenoh.Query) -> None:
        nonlocal lines
        text = (
            ""
            if query.payload is None
            else query.payload.to_bytes()[:MAX_SENTENCE_BYTES].decode(errors="replace")
        )
        if is_stop(text):
            await reply(query, await _attempt(conversation, text), "stop")
            return
        async with one_by_one:
            lines = _Lines()
            success = await _attempt(conversation, text)
            await reply(query, success, lines.text)

    async def reply(query: zenoh.Query, outcome: bool | str, text: str) -> None:
        failed = isinstance(outcome, str)
        body = {"success": outcome is True, "answer": outcome if failed else text}
        with query, suppress(zenoh.ZError):  # the asker has gone
            query.reply(query.key_expr, json.dumps(body))

    def begin(query: zenoh.Query) -> None:
        task = loop.create_task(answer(query))
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
