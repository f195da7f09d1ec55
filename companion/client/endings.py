"""How commands have ended: the messages of the topic `command_state`."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from contextlib import suppress
from typing import cast

import zenoh

from companion.bus import topics
from companion.bus.bodies.service import CommandStateBody
from companion.bus.client import SILENT_S, LastStatus, NoAnswerError, subscribe_kept
from companion.host.peer_data import PeerDataError, copy_payload, parse_object

_KEPT = 1000

logger = logging.getLogger(__name__)


class Endings:
    """Keeps the last message of the newest commands of one vehicle, of any sender.

    Subscribed before a command is sent, so none of its messages is missed. Used in one asyncio loop.
    """

    def __init__(self, session: zenoh.Session, vehicle: str) -> None:
        self._loop = asyncio.get_running_loop()
        self._ended: OrderedDict[str, CommandStateBody] = OrderedDict()
        self._waiting: dict[str, asyncio.Future[CommandStateBody]] = {}
        self._gone = False
        self._status = LastStatus(session, vehicle)
        self._alive = session.liveliness().declare_subscriber(topics.alive_key(vehicle), self._on_alive)
        self._states = subscribe_kept(session, topics.COMMAND_STATE.key(vehicle), self._on_state)

    def of(self, identifier: str) -> CommandStateBody | None:
        """Return how a command has ended; None: it has not."""
        return self._ended.get(identifier)

    async def wait(self, identifier: str) -> CommandStateBody:
        """Wait until a command has ended; see `Drone.ended`."""
        if (ended := self.of(identifier)) is not None:
            return ended
        if self._gone:
            raise self._no_answer(identifier)
        waiting = self._waiting.setdefault(identifier, self._loop.create_future())
        reported = False
        while not waiting.done():
            # Until the status may be silent, or, before the first one has come, it is looked again.
            look_s = None if reported else max(SILENT_S - self._status.silent_s, 0.0) + 0.1
            await asyncio.wait({waiting}, timeout=look_s)
            if not reported and self._status.silent_s > SILENT_S:
                reported = True
                logger.warning("command %s: %s", identifier, self._status.silent_text())
        return waiting.result()

    def _no_answer(self, identifier: str) -> NoAnswerError:
        return NoAnswerError(f"command {identifier}: {self._status.gone_text('its end')}")

    # --- in the loop

    def _take(self, body: CommandStateBody) -> None:
        self._ended[body["id"]] = body
        if len(self._ended) > _KEPT:
            self._ended.popitem(last=False)
        waiting = self._waiting.pop(body["id"], None)
        if waiting is not None and not waiting.done():
            waiting.set_result(body)

    def _set_gone(self, gone: bool) -> None:
        self._gone = gone
        for identifier in list(self._waiting) if gone else ():
            waiting = self._waiting.pop(identifier)
            if not waiting.done():
                waiting.set_exception(self._no_answer(identifier))
                waiting.exception()  # it may not be awaited any more

    # --- on zenoh's threads

    def _on_state(self, sample: zenoh.Sample) -> None:
        # Another program's message may lack the keys; the loop may be closed.
        with suppress(PeerDataError, KeyError, RuntimeError):
            body = parse_object(copy_payload(sample.payload, topics.COMMAND_STATE.largest_bytes))
            if body["state"] == "ended" and isinstance(body["id"], str):
                self._loop.call_soon_threadsafe(self._take, cast(CommandStateBody, body))

    def _on_alive(self, sample: zenoh.Sample) -> None:
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._set_gone, sample.kind == zenoh.SampleKind.DELETE)
