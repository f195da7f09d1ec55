"""A running service as a console reaches it from another process: over zenoh.

Ending the console ends nothing else: a command that was sent goes on.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any, TypeVar

import zenoh

from companion.bus import topics
from companion.bus.bodies.service import EventBody
from companion.bus.client import (
    SILENT_S,
    LastStatus,
    NoAnswerError,
    send_command,
    set_settings,
    subscribe_kept,
)
from companion.bus.command_order import CommandOrder, Turn
from companion.host.peer_data import PeerDataError, copy_payload, parse_object
from companion.host.tasks import spawn
from companion.operator.console import Target
from companion.operator.reply_text import printable

T = TypeVar("T")

# Longer than any command.
_COMMAND_TIMEOUT_S = 24 * 3600.0
_QUERY_S = 5.0
# The kept events arrive within this; the newest of them are shown.
_KEPT_S, _KEPT_SHOWN = 0.5, 5


async def in_thread(function: Callable[[], T]) -> T:
    """Run a function that blocks, in a thread that the end of the process does not wait for."""
    loop = asyncio.get_running_loop()
    outcome: asyncio.Future[T] = loop.create_future()

    def finish(result: T | None, error: Exception | None) -> None:
        if outcome.done():  # nobody waits any more
            return
        if error is not None:
            outcome.set_exception(error)
        else:
            outcome.set_result(result)  # type: ignore[arg-type]

    def work() -> None:
        result: T | None = None
        failure: Exception | None = None
        try:
            result = function()
        except zenoh.ZError as error:
            failure = NoAnswerError(f"zenoh: {str(error).splitlines()[0]}")
        except Exception as error:
            failure = error
        with suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(finish, result, failure)

    threading.Thread(target=work, name="console", daemon=True).start()
    return await outcome


def attached_target(session: zenoh.Session, vehicle: str, say: Callable[[str], None]) -> Target:
    """Return how a console reaches a service. Commands and settings are sent in the order of their calls,
    `stop` at once (`CommandOrder`).

    Args:
        say: gets a sentence, from any thread, if the service is silent while a command waits.
    """
    order = CommandOrder()

    async def in_turn(text: str | None, send: Callable[[Turn], T]) -> T:
        turn = order.turn(vehicle, text)
        try:
            return await in_thread(lambda: send(turn))
        except asyncio.CancelledError:
            turn.withdraw()
            raise

    async def command(text: str) -> Mapping[str, Any]:
        return await in_turn(
            text,
            lambda turn: send_command(
                session, vehicle, text, timeout_s=_COMMAND_TIMEOUT_S, on_silent=say, turn=turn
            ),
        )

    async def settings(payload: bytes) -> Mapping[str, Any]:
        values = parse_object(payload) if payload else None
        return await in_turn(
            None, lambda turn: set_settings(session, vehicle, values, timeout_s=_QUERY_S, turn=turn)
        )

    def query(path: str) -> dict[str, Any]:
        for reply in session.get(f"{topics.ROOT}/{vehicle}/{path}", timeout=_QUERY_S):
            if reply.ok is not None:
                return parse_object(copy_payload(reply.ok.payload, topics.LARGEST_JSON_BYTES))
        raise NoAnswerError(f"{path}: no answer from vehicle {vehicle!r} within {_QUERY_S:g} s")

    return Target(
        command,
        settings,
        status=lambda: in_thread(lambda: query("status")),
        commands=lambda: in_thread(lambda: query("commands")),
    )


@asynccontextmanager
async def watched(session: zenoh.Session, vehicle: str, say: Callable[[str], None]) -> AsyncIterator[None]:
    """Say the events of a service, the newest kept ones first, its end, its silence, and its return.

    Args:
        say: gets each line, in the loop.
    """
    loop = asyncio.get_running_loop()
    kept: deque[EventBody] | None = deque(maxlen=_KEPT_SHOWN)
    status = LastStatus(session, vehicle)
    gone = False

    def in_loop(function: Callable[..., None], *arguments: Any) -> None:
        with suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(function, *arguments)

    def receive(sample: zenoh.Sample) -> None:
        # Another program's message may lack the keys.
        with suppress(PeerDataError, KeyError):
            body = parse_object(copy_payload(sample.payload, topics.EVENTS.largest_bytes))
            in_loop(on_event, {key: body[key] for key in ("stamp_ns", "level", "text")})

    def on_event(event: EventBody) -> None:
        if kept is not None:
            kept.append(event)
        else:
            say(_event_line(event))

    def show_kept() -> None:
        nonlocal kept
        shown, kept = kept or (), None
        for event in shown:
            say(f"earlier: {_event_line(event)}")

    def on_alive(sample: zenoh.Sample) -> None:
        in_loop(set_gone, sample.kind == zenoh.SampleKind.DELETE)

    def set_gone(now: bool) -> None:
        nonlocal gone
        if now != gone:
            gone = now
            say(f"{status.gone_text()}; waiting for it" if now else f"the service of {vehicle!r} is back")

    async def watch_silence() -> None:
        silent = False
        while True:
            await asyncio.sleep(1.0)
            if gone or silent == (status.silent_s > SILENT_S):
                continue
            silent = not silent
            say(status.silent_text() if silent else f"the service of {vehicle!r} answers again")

    alive = session.liveliness().declare_subscriber(topics.alive_key(vehicle), on_alive, history=True)
    events = subscribe_kept(session, topics.EVENTS.key(vehicle), receive)
    timer = loop.call_later(_KEPT_S, show_kept)
    watching = spawn(watch_silence(), "watch over a silent service")
    try:
        yield
    finally:
        timer.cancel()
        watching.cancel()
        with suppress(zenoh.ZError):  # the connection is closed
            for declared in (events, alive):
                declared.undeclare()  # type: ignore[no-untyped-call]
            status.close()


def _event_line(event: EventBody) -> str:
    return printable(f"{event['level']}: {event['text']}")
