"""The service's zenoh session: publishes the topics, takes commands, says when the router is gone.

zenoh calls back on threads of its own; whatever comes in hops into the asyncio loop. A publication never
waits: `DROP` where the network is slow. While the session is not open yet, what is published is counted as
publish_failed, not queued: old detections are of no use to anybody.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import zenoh

from companion.bus.command_intake import CommandIntake
from companion.bus.topics import TOPICS, VIEW_TOPICS, Topic, alive_key, command_key, everybodys_key
from companion.settings import ZenohSection

logger = logging.getLogger(__name__)

CommandHandler = Callable[[str], Awaitable[dict[str, Any]]]

_RETRY_MIN_S, _RETRY_MAX_S = 0.5, 5.0
_WATCH_PERIOD_S = 0.25
_ANSWER_S = 0.5
# What goes wrong in a command is logged no more often than this.
_LOG_PERIOD_S = 1.0


class BusError(ConnectionError):
    """The zenoh session cannot be opened at all (a busy port, a bad endpoint)."""


def zenoh_config(settings: ZenohSection) -> zenoh.Config:
    """zenoh's own configuration for these settings."""
    config = zenoh.Config()
    values = {
        "mode": settings.mode,
        "connect/endpoints": list(settings.connect),
        "listen/endpoints": list(settings.listen) if settings.mode == "peer" else [],
        "scouting/multicast/enabled": settings.multicast_scouting,
        "timestamping/enabled": True,
    }
    if settings.mode == "peer":
        # A peer starts without its router and goes on looking for it.
        values["connect/exit_on_failure"] = False
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


class Bus:
    """One vehicle's publications and its command queryable.

    Args:
        on_event: called with (level, text) when the network is lost or found.
        on_command: answers a command's text with a JSON-able reply; called in the loop, one task each.
        views: names of the views that publish besides the first.
        listeners: topics, each with what is called in the loop with its messages, of any vehicle.

    Attributes:
        published: path of a topic (`Topic.path`) → messages handed to zenoh.
        publish_failed: messages that came while there was no session, or that zenoh refused.
        intake: which commands are taken.
    """

    def __init__(
        self,
        settings: ZenohSection,
        vehicle: str,
        *,
        on_event: Callable[[str, str], None],
        on_command: CommandHandler,
        views: Sequence[str] = (),
        listeners: Sequence[tuple[Topic, Callable[[bytes], None]]] = (),
    ) -> None:
        self._settings = settings
        self._vehicle = vehicle
        self._on_event = on_event
        self._on_command = on_command
        self._session: zenoh.Session | None = None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._sending: set[str] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._connected = False
        self._watching: asyncio.Task[None] | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._queryable: zenoh.Queryable[None] | None = None
        self._listeners = tuple(listeners)
        self._subscribers: list[zenoh.Subscriber[None]] = []
        self._streams: list[tuple[Topic, str | None]] = [(topic, None) for topic in TOPICS]
        self._streams += [(topic, view) for view in views for topic in VIEW_TOPICS]
        self.published: dict[str, int] = {topic.path(view): 0 for topic, view in self._streams}
        self.publish_failed = 0
        self.intake = CommandIntake()
        self._logged_s, self._unlogged = -_LOG_PERIOD_S, 0

    @property
    def open(self) -> bool:
        """The session is there and publications go out."""
        return self._session is not None

    @property
    def connected(self) -> bool:
        """Every endpoint in `connect` was asked for none, or at least one other node is connected."""
        return self.open and (self._connected or not self._settings.connect)

    async def start(self) -> None:
        """Open the session: at once as a peer, as soon as the router answers as a client.

        Raises:
            BusError: a peer cannot listen where it should.
        """
        self._loop = asyncio.get_running_loop()
        if self._settings.mode == "peer":
            try:
                self._adopt(await asyncio.to_thread(zenoh.open, zenoh_config(self._settings)))
            except zenoh.ZError as error:
                endpoints = ", ".join(self._settings.listen)
                raise BusError(
                    f"zenoh cannot listen on {endpoints}: {_first_line(error)}. "
                    "Is a router or another service there? Set zenoh.connect to it and zenoh.listen to none"
                ) from error
        self._watching = self._spawn(self._watch())

    async def close(self) -> None:
        """End the session; bounded in time."""
        if self._watching is not None:
            self._watching.cancel()
        # Answers that are ready go out; those that are not are told so.
        answers = self._tasks - {self._watching}
        if answers:
            await asyncio.wait(answers, timeout=_ANSWER_S)
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        session, self._session = self._session, None
        self._publishers.clear()
        if session is not None:
            with suppress(TimeoutError):
                async with asyncio.timeout(3.0):
                    await asyncio.to_thread(session.close)

    def watched(self, topic: Topic, view: str | None = None) -> bool:
        """Whether anybody subscribes to this now."""
        publisher = self._publishers.get(topic.path(view))
        # zenoh's stubs call this a bool.
        return publisher is not None and bool(publisher.matching_status.matching)  # type: ignore[attr-defined]

    def publish_picture(
        self, topic: Topic, picture: bytes, attachment: dict[str, Any], view: str | None = None
    ) -> None:
        """Publish bytes that are too large for one packet, with an attachment as JSON.

        zenoh waits a little for room for each piece of such a message, so that is done in a thread. One that
        comes while the one before is still on its way is not sent.
        """
        path = topic.path(view)
        publisher = self._publishers.get(path)
        if publisher is None or path in self._sending:
            self.publish_failed += 1
            return
        self._sending.add(path)
        self._spawn(self._send(path, publisher, picture, json.dumps(attachment)))

    async def _send(self, path: str, publisher: zenoh.Publisher, picture: bytes, attachment: str) -> None:
        try:
            await asyncio.to_thread(publisher.put, picture, attachment=attachment)
            self.published[path] += 1
        except zenoh.ZError as error:
            self.publish_failed += 1
            logger.warning("zenoh did not take a message for %s: %s", path, _first_line(error))
        finally:
            self._sending.discard(path)

    def publish(self, topic: Topic, value: Any, view: str | None = None) -> None:
        """Publish a JSON-able value, or a text as it is. Never raises for the network.

        Where a reader takes nothing zenoh drops the message, after a millisecond at most.
        """
        path = topic.path(view)
        publisher = self._publishers.get(path)
        if publisher is None:
            self.publish_failed += 1
            return
        payload = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
        try:
            publisher.put(payload)
        except zenoh.ZError as error:
            self.publish_failed += 1
            logger.warning("zenoh did not take a message for %s: %s", path, _first_line(error))
            return
        self.published[path] += 1

    def _adopt(self, session: zenoh.Session) -> None:
        self._session = session
        self._publishers = {
            topic.path(view): session.declare_publisher(
                topic.key(self._vehicle, view),
                encoding=topic.encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=topic.priority,
                express=topic.express,
            )
            for topic, view in self._streams
        }
        # Presence for free: the token goes when we go, however we go.
        self._token = session.liveliness().declare_token(alive_key(self._vehicle))
        self._queryable = session.declare_queryable(command_key(self._vehicle), self._from_zenoh_thread)
        self._subscribers = [
            session.declare_subscriber(everybodys_key(topic), partial(self._on_sample, listener))
            for topic, listener in self._listeners
        ]

    def _on_sample(self, listener: Callable[[bytes], None], sample: zenoh.Sample) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(listener, sample.payload.to_bytes())

    def _from_zenoh_thread(self, query: zenoh.Query) -> None:
        text, why = self.intake.read(*_payload(query))
        loop = self._loop
        if text is not None and loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(lambda: self._spawn(self._answer(query, text)))
            return
        with query:
            _reply(query, {"command": "", "success": False, "reason": why or "the service has ended"})

    async def _answer(self, query: zenoh.Query, text: str) -> None:
        reply: dict[str, Any] = {"command": text[:200], "success": False, "reason": "the service has ended"}
        try:
            reply = await self._on_command(text)
        except Exception as error:
            self._log_failure(text)
            reply["reason"] = f"{type(error).__name__}: {error}"
        finally:
            # Whatever happens here, the other side is not left waiting: it must not send the command again.
            with query:
                _reply(query, reply)

    def _log_failure(self, text: str) -> None:
        now_s = time.monotonic()
        if now_s - self._logged_s < _LOG_PERIOD_S:
            self._unlogged += 1
            return
        logger.exception("command %.200r failed (%d more were not logged)", text, self._unlogged)
        self._logged_s, self._unlogged = now_s, 0

    async def _watch(self) -> None:
        """Open the session if it is not (client), then tell when the nodes in `connect` come and go."""
        delay_s, told = _RETRY_MIN_S, False
        endpoints = ", ".join(self._settings.connect)
        while self._session is None:
            try:
                self._adopt(await asyncio.to_thread(zenoh.open, zenoh_config(self._settings)))
            except zenoh.ZError:
                if not told:
                    self._on_event("warning", f"zenoh: nobody answers at {endpoints}; trying on")
                    told = True
                await asyncio.sleep(delay_s)
                delay_s = min(2 * delay_s, _RETRY_MAX_S)
        if not self._settings.connect:
            return
        while True:
            info = self._session.info
            connected = bool(list(info.routers_zid()) or list(info.peers_zid()))
            if connected != self._connected or (not connected and not told):
                self._connected, told = connected, True
                if connected:
                    self._on_event("info", f"zenoh: connected to {endpoints}")
                else:
                    self._on_event(
                        "warning", f"zenoh: no connection to {endpoints}; nobody gets detections, trying on"
                    )
            await asyncio.sleep(_WATCH_PERIOD_S)

    def _spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._finished)
        return task

    def _finished(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            logger.error("zenoh task failed", exc_info=error)


def _payload(query: zenoh.Query) -> tuple[int, Callable[[], bytes]]:
    """Size and bytes of the command: the query's payload, or its parameter `text` (`…/command?text=hold`)."""
    payload = query.payload
    if payload is not None and len(payload):
        return len(payload), payload.to_bytes
    text = str(query.parameters.get("text", "")).encode("utf-8", "replace")
    return len(text), lambda: text


def _reply(query: zenoh.Query, reply: dict[str, Any]) -> None:
    query.reply(query.key_expr, json.dumps(reply), encoding=zenoh.Encoding.APPLICATION_JSON)


def _first_line(error: BaseException) -> str:
    """zenoh's errors end with a place in its source; a person needs what stands before."""
    return str(error).splitlines()[0].split(" at /")[0].strip() if str(error) else type(error).__name__
