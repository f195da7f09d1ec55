"""The service's zenoh session: publishes the topics, receives commands, reports the loss of the router.

zenoh calls back on its own threads; received data is passed into the asyncio loop. A publication never waits:
`DROP` if the network is slow. Before the session is open, publications are counted as publish_failed, not
queued: old detections are useless.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from types import MappingProxyType
from typing import Any

import zenoh
from pydantic_core import to_json
from zenoh import ext

from companion.bus.bodies.frames import CloudBody, DepthImageBody, ImageBody
from companion.bus.command_intake import COMMANDS_PER_S, MAX_SENDER_BYTES, Allowance, CommandIntake
from companion.bus.config import BusError, EndpointTakenError, first_line, service_config, zenoh_config
from companion.bus.listeners import Listener, ListenerQueue
from companion.bus.topics import (
    RECORDER_TOPICS,
    ROOT,
    SETTINGS,
    TOPICS,
    VIEW_TOPICS,
    Topic,
    alive_key,
    client_key,
    command_key,
    settings_key,
)
from companion.host.peer_data import Payload, PeerDataError, copy_payload
from companion.host.scheduling import set_scheduler_slice
from companion.host.tasks import error_text, keep_running, spawn
from companion.settings import ZenohSection
from vision.redaction import redacted

__all__ = ["Bus", "BusError", "encode", "zenoh_config"]

logger = logging.getLogger(__name__)

CommandHandler = Callable[[str], Awaitable[dict[str, Any]]]
QueryHandler = Callable[[], Awaitable[Any]]
PayloadHandler = Callable[[bytes], Awaitable[Any]]
_Publisher = zenoh.Publisher | ext.AdvancedPublisher

LARGEST_SETTINGS_BYTES = 8 * 1024

_RETRY_MIN_S, _RETRY_MAX_S = 0.5, 5.0
_WATCH_PERIOD_S = 0.25
_ANSWER_S = 0.5
# Interval in which a subscriber notices the loss of the newest message of a cached topic.
_MISS_HEARTBEAT_S = 1.0
# Messages of cached topics that wait for their thread.
# Larger messages are sent in fragments of zenoh's batch of 64 KiB.
LARGE_BYTES = 48_000
_MOST_UNSENT = 1000
_LONGEST_NAME = 64  # of a client
# Minimum interval of logged command failures.
_LOG_PERIOD_S = 1.0


def encode(body: Any) -> bytes:
    """Encode a body as JSON, without secrets. JSON lacks NaN and infinity: they become null.

    A message with ten detections takes 28 µs, with `json.dumps` 114.
    """
    data = to_json(body, inf_nan_mode="null")
    # Where no address is, there is no secret of one.
    return redacted(data.decode()).encode() if b"://" in data or b"@" in data else data


class Bus:
    """One vehicle's publications and its queryables.

    Args:
        on_event: called with (level, text) when the network is lost or found, or a client with a token
            (`client_key`) has gone.
        on_command: returns a command's JSON-able reply; called in the loop, one task each.
        queries: path of a queryable → function that returns its reply, a body or a JPEG; called as
            `on_command`. A TimeoutError or KeyError is replied as an error.
        on_settings: the same for `settings`, with the query's payload, of at most `LARGEST_SETTINGS_BYTES`. A
            PeerDataError is replied as an error.
        views: names of the views that publish besides the first.
        listeners: to topics of other programs.

    Attributes:
        published: path of a topic (`Topic.path`) → messages so far. Without a subscriber they are neither
            encoded nor sent, unless they are kept for a later one (`Topic.cached`).
        publish_failed: messages without a session, or refused by zenoh.
        intake: accepts or refuses commands. listeners: to other programs.
    """

    def __init__(
        self,
        settings: ZenohSection,
        vehicle: str,
        *,
        on_event: Callable[[str, str], None],
        on_command: CommandHandler,
        queries: Mapping[str, QueryHandler] = MappingProxyType({}),
        on_settings: PayloadHandler | None = None,
        views: Sequence[str] = (),
        listeners: Sequence[Listener] = (),
    ) -> None:
        self._settings = settings
        self._vehicle = vehicle
        self._on_event = on_event
        self._on_command = on_command
        self._session: zenoh.Session | None = None
        self._queries, self._on_settings = dict(queries), on_settings
        self._publishers: dict[str, _Publisher] = {}
        self._watched: dict[str, bool] = {}
        self._matching: list[zenoh.MatchingListener[None]] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._sending: set[str] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._connected = False
        self._watching: asyncio.Task[None] | None = None
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._queryables: list[zenoh.Queryable[None]] = []
        self._query_allowance = Allowance()
        # While zenoh sends kept messages to a frozen reader, a put of that topic waits for seconds, as does a
        # reply to one. So neither is sent by the loop, and the reader of an image delays no command's result.
        self._kept_puts = ThreadPoolExecutor(1, "zenoh kept messages")
        self._kept_slots = threading.Semaphore(_MOST_UNSENT)
        self._command_replies = ThreadPoolExecutor(1, "zenoh command replies")
        self._query_replies = ThreadPoolExecutor(1, "zenoh query replies")
        self.listeners = tuple(listeners)
        self._received: list[ListenerQueue] = []
        self._subscribers: list[zenoh.Subscriber[None]] = []
        self._token: zenoh.LivelinessToken | None = None
        self._streams: list[tuple[Topic, str | None]] = [
            (topic, None) for topic in (*TOPICS, *RECORDER_TOPICS)
        ]
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
    def ignored(self) -> dict[str, int]:
        """Topic that is listened to → messages that were not used."""
        return {queue.topic.name: queue.ignored for queue in self._received}

    @property
    def connected(self) -> bool:
        """Whether at least one other node is connected, or `connect` is empty."""
        return self.open and (self._connected or not self._settings.connect)

    @property
    def missing(self) -> str:
        """Why nothing is delivered to `connect`; empty: it is, or none is set."""
        return "" if self.connected else f"no connection to {', '.join(self._settings.connect)}"

    async def start(self) -> None:
        """Open the session: at once as a peer, when the router answers as a client.

        Raises:
            EndpointTakenError: a peer cannot listen on its endpoints now. BusError: nor ever.
        """
        self._loop = asyncio.get_running_loop()
        config = service_config(self._settings)
        if json.loads(config.get_json("mode")) != "client":
            try:
                await self._adopt(await asyncio.to_thread(_open, config))
            except zenoh.ZError as error:
                endpoints = ", ".join(self._settings.listen)
                # An error of the system may pass, one of zenoh is of the settings.
                kind = EndpointTakenError if "os error" in str(error) else BusError
                raise kind(
                    f"zenoh cannot listen on {endpoints}: {first_line(error)}. "
                    "If a router or another service uses it, set zenoh.connect to it and zenoh.listen to none"
                ) from error
        self._watching = self._spawn(keep_running("zenoh", self._watch, self._on_event))

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
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=_ANSWER_S)
        session, self._session = self._session, None
        self._publishers.clear()
        with suppress(TimeoutError):
            async with asyncio.timeout(_ANSWER_S):
                await asyncio.to_thread(self._kept_puts.shutdown)  # the last events are sent
        self._tokens.clear()
        if session is not None:
            with suppress(TimeoutError):
                async with asyncio.timeout(3.0):
                    await asyncio.to_thread(session.close)
        for executor in (self._kept_puts, self._command_replies, self._query_replies):
            executor.shutdown(wait=False, cancel_futures=True)

    def watched(self, topic: Topic, view: str | None = None) -> bool:
        """Whether the topic has a subscriber now. Not known for a cached topic."""
        return self._watched.get(topic.path(view), False)

    def set_alive(self, parts: Set[str]) -> None:
        """Show these parts as alive and no others: a liveliness token `…/alive/PART` each."""
        session = self._session
        if session is None:
            return
        for part in self._tokens.keys() - parts:
            self._tokens.pop(part).undeclare()  # type: ignore[no-untyped-call]
        for part in parts - self._tokens.keys():
            key = f"{alive_key(self._vehicle)}/{part}"
            self._tokens[part] = session.liveliness().declare_token(key)

    def publish_large(
        self,
        topic: Topic,
        data: bytes,
        attachment: ImageBody | DepthImageBody | CloudBody,
        view: str | None = None,
    ) -> None:
        """Publish bytes that are too large for one packet, with an attachment as JSON.

        zenoh waits for buffer space for each fragment of such a message, so it is sent in a thread. One
        that arrives while the topic's previous one is being sent is dropped.
        """
        path = topic.path(view)
        publisher = self._publishers.get(path)
        if publisher is None or path in self._sending:
            self.publish_failed += 1
            return
        if not self._watched[path]:
            return  # it was made for a query
        self._sending.add(path)
        self._spawn(self._send(path, publisher, data, json.dumps(attachment)))

    async def _send(self, path: str, publisher: _Publisher, data: bytes, attachment: str) -> None:
        try:
            await asyncio.to_thread(publisher.put, data, attachment=attachment)
            self.published[path] += 1
        except zenoh.ZError as error:
            self.publish_failed += 1
            logger.warning("zenoh refused a message on %s: %s", path, first_line(error))
        finally:
            self._sending.discard(path)

    def publish(self, topic: Topic, value: Any, view: str | None = None) -> None:
        """Publish a body, or a text or bytes unchanged. Never raises for the network.

        Args:
            value: the body, or a function that returns it; None: nothing is published.

        For a blocked reader zenoh drops the message, after a millisecond at most. A large one waits longer,
        for each of its fragments, so a thread sends it.
        """
        path = topic.path(view)
        publisher = self._publishers.get(path)
        if publisher is None:
            self.publish_failed += 1
            return
        if not topic.cached and not self._watched[path]:
            self.published[path] += 1
            return
        body = value() if callable(value) else value
        if body is None:
            return
        payload = body if isinstance(body, str | bytes) else encode(body)
        if not topic.cached and len(payload) <= LARGE_BYTES:
            self._put(path, publisher, payload)
        elif self._kept_slots.acquire(blocking=False):
            self._kept_puts.submit(self._put_kept, path, publisher, payload)
        else:
            self.publish_failed += 1

    def _put_kept(self, path: str, publisher: _Publisher, payload: str | bytes) -> None:
        try:
            self._put(path, publisher, payload)
        finally:
            self._kept_slots.release()

    def _put(self, path: str, publisher: _Publisher, payload: str | bytes) -> None:
        try:
            publisher.put(payload)
        except zenoh.ZError as error:
            self.publish_failed += 1
            logger.warning("zenoh refused a message on %s: %s", path, first_line(error))
            return
        self.published[path] += 1

    async def _adopt(self, session: zenoh.Session) -> None:
        """Use a session. One on which not everything can be declared is closed."""
        try:
            self._declare_all(session)
        except Exception:
            for declared in (self._matching, self._queryables, self._received, self._subscribers):
                declared.clear()
            self._publishers.clear()
            await asyncio.to_thread(session.close)
            raise
        self._session = session

    def _declare_all(self, session: zenoh.Session) -> None:
        for topic, view in self._streams:
            self._declare(session, topic, view)
        # zenoh removes the token when this process ends, in any way.
        self._token = session.liveliness().declare_token(alive_key(self._vehicle))
        self._queryables = [session.declare_queryable(command_key(self._vehicle), self._from_zenoh_thread)]
        self._queryables += [
            session.declare_queryable(f"{ROOT}/{self._vehicle}/{path}", partial(self._on_query, path))
            for path in self._queries
        ]
        clients = client_key(self._vehicle, "*")
        self._subscribers = [session.liveliness().declare_subscriber(clients, self._on_client)]
        if self._on_settings is not None:
            answer = partial(self._on_settings_query, self._on_settings)
            self._queryables.append(session.declare_queryable(settings_key(self._vehicle), answer))
        for listener in self.listeners:
            queue = ListenerQueue(listener, self._call_soon, self._on_event)
            self._received.append(queue)
            key = listener.topic.key(listener.vehicle)
            self._subscribers.append(session.declare_subscriber(key, partial(self._on_sample, queue)))

    def _declare(self, session: zenoh.Session, topic: Topic, view: str | None) -> None:
        path, key = topic.path(view), topic.key(self._vehicle, view)
        drop = zenoh.CongestionControl.DROP
        # Our own subscribers, for other vehicles' poses, do not count and get nothing.
        remote = zenoh.Locality.REMOTE
        if topic.cached:
            self._publishers[path] = ext.declare_advanced_publisher(
                session,
                key,
                encoding=topic.encoding,
                congestion_control=drop,
                priority=topic.priority,
                express=topic.express,
                allowed_destination=remote,
                cache=ext.CacheConfig(
                    topic.cached, replies_config=ext.RepliesConfig(congestion_control=drop)
                ),
                # The sporadic heartbeat is sent with BLOCK.
                sample_miss_detection=ext.MissDetectionConfig(
                    heartbeat=_MISS_HEARTBEAT_S, sporadic_heartbeat=None
                ),
                publisher_detection=True,
            )
            return
        publisher = session.declare_publisher(
            key,
            encoding=topic.encoding,
            congestion_control=drop,
            priority=topic.priority,
            express=topic.express,
            allowed_destination=remote,
        )

        def on_matching(status: zenoh.MatchingStatus) -> None:
            self._watched[path] = bool(status.matching)

        self._publishers[path] = publisher
        self._watched[path] = False
        self._matching.append(publisher.declare_matching_listener(on_matching))
        if publisher.matching_status.matching:  # type: ignore[attr-defined]
            self._watched[path] = True

    def _call_soon(self, call: Callable[..., None], *arguments: Any) -> None:
        """Schedule a call in the loop, from any thread; nothing once the loop has ended."""
        if self._loop is not None:
            with suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(call, *arguments)

    def _on_client(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE and self._query_allowance.take():
            name = str(sample.key_expr).rpartition("/")[2][:_LONGEST_NAME]
            self._call_soon(self._on_event, "warning", f"{name} has gone: it has ended, or was cut off")

    @staticmethod
    def _on_sample(queue: ListenerQueue, sample: zenoh.Sample) -> None:
        queue.offer(sample.payload, time.monotonic_ns())

    def _from_zenoh_thread(self, query: zenoh.Query) -> None:
        sender = query.attachment
        known = sender is not None and len(sender) <= MAX_SENDER_BYTES
        stated = copy_payload(sender, MAX_SENDER_BYTES) if known and sender else b""
        text, why = self.intake.read(_payload(query), stated)
        loop = self._loop
        if text is not None and loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(lambda: self._spawn(self._answer(query, text)))
            return
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
            await self._in(self._command_replies, _reply, query, reply)

    def _on_settings_query(self, handler: PayloadHandler, query: zenoh.Query) -> None:
        payload = query.payload
        try:
            data = b"" if payload is None else copy_payload(payload, LARGEST_SETTINGS_BYTES)
        except PeerDataError as error:
            _reply_error(query, f"{SETTINGS}: {error}")
            return
        self._accept_query(SETTINGS, partial(handler, data), query)

    def _on_query(self, path: str, query: zenoh.Query) -> None:
        self._accept_query(path, self._queries[path], query)

    def _accept_query(self, path: str, handler: QueryHandler, query: zenoh.Query) -> None:
        loop = self._loop
        if not self._query_allowance.take():
            _reply_error(query, f"more than {COMMANDS_PER_S:g} queries a second; send it again later")
        elif loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(lambda: self._spawn(self._answer_query(path, handler, query)))

    async def _answer_query(self, path: str, handler: QueryHandler, query: zenoh.Query) -> None:
        try:
            body = await handler()
        except (TimeoutError, KeyError, PeerDataError) as error:
            await self._in(self._query_replies, _reply_error, query, f"{path}: {error}")
            return
        except Exception as error:  # else its sender would wait until its own time-out
            logger.exception("the query %s failed", path)
            await self._in(self._query_replies, _reply_error, query, f"{path}: {error_text(error)}")
            return
        key = f"{ROOT}/{self._vehicle}/{path}"
        await self._in(self._query_replies, _reply_body, query, key, body)

    async def _in(self, executor: ThreadPoolExecutor, send: Callable[..., None], *arguments: Any) -> None:
        with suppress(zenoh.ZError):  # the sender has gone
            await asyncio.get_running_loop().run_in_executor(executor, send, *arguments)

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
                await self._adopt(await asyncio.to_thread(_open, service_config(self._settings)))
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
        task = spawn(work, "zenoh task")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


def _open(config: zenoh.Config) -> zenoh.Session:
    """Open a session. Its threads inherit the short slice, so that they run at once on a busy computer."""
    set_scheduler_slice()
    return zenoh.open(config)


def _payload(query: zenoh.Query) -> Payload:
    """Return a command: the query's payload, or its parameter `text` (`…?text=hold`)."""
    payload = query.payload
    if payload is not None and len(payload):
        return payload
    return zenoh.ZBytes(str(query.parameters.get("text", "")).encode("utf-8", "replace"))


def _reply(query: zenoh.Query, reply: dict[str, Any]) -> None:
    with query:
        query.reply(query.key_expr, redacted(json.dumps(reply)), encoding=zenoh.Encoding.APPLICATION_JSON)


def _reply_body(query: zenoh.Query, key: str, body: Any) -> None:
    jpeg = isinstance(body, bytes)
    encoding = zenoh.Encoding.IMAGE_JPEG if jpeg else zenoh.Encoding.APPLICATION_JSON
    with query:
        query.reply(key, body if jpeg else encode(body), encoding=encoding)


def _reply_error(query: zenoh.Query, reason: str) -> None:
    with query:
        query.reply_err(redacted(json.dumps({"reason": reason})), encoding=zenoh.Encoding.APPLICATION_JSON)
