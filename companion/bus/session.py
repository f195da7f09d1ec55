"""The service's zenoh session: publishes the topics, receives commands, reports the loss of the router.

zenoh calls back on its own threads; received data is passed into the asyncio loop. A publication never waits:
`DROP` if the network is slow. Before the session is open, publications are counted as publish_failed, not
queued: old detections are useless.
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
from companion.bus.topics import TOPICS, VIEW_TOPICS, Topic, alive_key, all_vehicles_key, command_key
from companion.settings import ZenohSection

logger = logging.getLogger(__name__)

CommandHandler = Callable[[str], Awaitable[dict[str, Any]]]

_RETRY_MIN_S, _RETRY_MAX_S = 0.5, 5.0
_WATCH_PERIOD_S = 0.25
_ANSWER_S = 0.5
# Minimum interval of logged command failures.
_LOG_PERIOD_S = 1.0


class BusError(ConnectionError):
    """The zenoh session cannot be opened (a busy port, a bad endpoint)."""


def zenoh_config(settings: ZenohSection) -> zenoh.Config:
    """Convert settings into zenoh's configuration."""
    config = zenoh.Config()
    values = {
        "mode": settings.mode,
        "connect/endpoints": list(settings.connect),
        "listen/endpoints": list(settings.listen) if settings.mode == "peer" else [],
        "scouting/multicast/enabled": settings.multicast_scouting,
        "timestamping/enabled": True,
    }
    if settings.mode == "peer":
        # A peer starts without its router and keeps retrying.
        values["connect/exit_on_failure"] = False
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


class Bus:
    """One vehicle's publications and its command queryable.

    Args:
        on_event: called with (level, text) when the network is lost or found.
        on_command: returns a command's JSON-able reply; called in the loop, one task each.
        views: names of the views that publish besides the first.
        listeners: topics, each with a callback in the loop for its messages, of any vehicle.

    Attributes:
        published: path of a topic (`Topic.path`) → messages passed to zenoh.
        publish_failed: messages without a session, or refused by zenoh.
        intake: accepts or refuses commands.
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
        """Whether the session is open."""
        return self._session is not None

    @property
    def connected(self) -> bool:
        """Whether at least one other node is connected, or `connect` is empty."""
        return self.open and (self._connected or not self._settings.connect)

    async def start(self) -> None:
        """Open the session: at once as a peer, when the router answers as a client.

        Raises:
            BusError: a peer cannot listen on its endpoints.
        """
        self._loop = asyncio.get_running_loop()
        if self._settings.mode == "peer":
            try:
                self._adopt(await asyncio.to_thread(zenoh.open, zenoh_config(self._settings)))
            except zenoh.ZError as error:
                endpoints = ", ".join(self._settings.listen)
                raise BusError(
                    f"zenoh cannot listen on {endpoints}: {_first_line(error)}. "
                    "If a router or another service uses it, set zenoh.connect to it and zenoh.listen to none"
                ) from error
        self._watching = self._spawn(self._watch())

    async def close(self) -> None:
        """Close the session; bounded in time."""
        if self._watching is not None:
            self._watching.cancel()
        # Ready answers are sent; pending ones get a failure.
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
        """Whether the topic has a subscriber now."""
        publisher = self._publishers.get(topic.path(view))
        # zenoh's stubs call this a bool.
        return publisher is not None and bool(publisher.matching_status.matching)  # type: ignore[attr-defined]

    def publish_image(
        self, topic: Topic, image: bytes, attachment: dict[str, Any], view: str | None = None
    ) -> None:
        """Publish bytes that are too large for one packet, with an attachment as JSON.

        zenoh waits for buffer space for each fragment of such a message, so it is sent in a thread. An
        image that arrives while the previous one is being sent is dropped.
        """
        path = topic.path(view)
        publisher = self._publishers.get(path)
        if publisher is None or path in self._sending:
            self.publish_failed += 1
            return
        self._sending.add(path)
        self._spawn(self._send(path, publisher, image, json.dumps(attachment)))

    async def _send(self, path: str, publisher: zenoh.Publisher, image: bytes, attachment: str) -> None:
        try:
            await asyncio.to_thread(publisher.put, image, attachment=attachment)
            self.published[path] += 1
        except zenoh.ZError as error:
            self.publish_failed += 1
            logger.warning("zenoh refused a message on %s: %s", path, _first_line(error))
        finally:
            self._sending.discard(path)

    def publish(self, topic: Topic, value: Any, view: str | None = None) -> None:
        """Publish a JSON-able value, or a text unchanged. Never raises for the network.

        For a blocked reader zenoh drops the message, after a millisecond at most.
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
            logger.warning("zenoh refused a message on %s: %s", path, _first_line(error))
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
        # zenoh removes the token when this process ends, in any way.
        self._token = session.liveliness().declare_token(alive_key(self._vehicle))
        self._queryable = session.declare_queryable(command_key(self._vehicle), self._from_zenoh_thread)
        self._subscribers = [
            session.declare_subscriber(all_vehicles_key(topic), partial(self._on_sample, listener))
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
            # The sender always gets a reply, since it must not send the command again.
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
        """Open the session if needed (client), then report connection and loss of the nodes in `connect`."""
        delay_s, reported = _RETRY_MIN_S, False
        endpoints = ", ".join(self._settings.connect)
        while self._session is None:
            try:
                self._adopt(await asyncio.to_thread(zenoh.open, zenoh_config(self._settings)))
            except zenoh.ZError:
                if not reported:
                    self._on_event("warning", f"zenoh: no peer at {endpoints}, retrying")
                    reported = True
                await asyncio.sleep(delay_s)
                delay_s = min(2 * delay_s, _RETRY_MAX_S)
        if not self._settings.connect:
            return
        while True:
            info = self._session.info
            connected = bool(list(info.routers_zid()) or list(info.peers_zid()))
            if connected != self._connected or (not connected and not reported):
                self._connected, reported = connected, True
                if connected:
                    self._on_event("info", f"zenoh: connected to {endpoints}")
                else:
                    self._on_event(
                        "warning",
                        f"zenoh: no connection to {endpoints}: messages are not delivered, retrying",
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
    """Return size and bytes of a command: the query's payload, or its parameter `text` (`…?text=hold`)."""
    payload = query.payload
    if payload is not None and len(payload):
        return len(payload), payload.to_bytes
    text = str(query.parameters.get("text", "")).encode("utf-8", "replace")
    return len(text), lambda: text


def _reply(query: zenoh.Query, reply: dict[str, Any]) -> None:
    query.reply(query.key_expr, json.dumps(reply), encoding=zenoh.Encoding.APPLICATION_JSON)


def _first_line(error: BaseException) -> str:
    """Return the text of an error without the source location that zenoh appends."""
    return str(error).splitlines()[0].split(" at /")[0].strip() if str(error) else type(error).__name__
