"""Messages of the bus on their way into the loop: bounded, the newest ones."""

from __future__ import annotations

import asyncio
import queue
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from threading import Lock, Thread
from typing import Any

import zenoh

from companion.bus.child_client import ChildClient
from companion.bus.client import (
    NoAnswerError,
    SettingsRefusedError,
    message_of,
    set_settings,
    subscribe_kept,
)
from companion.bus.topics import IMAGE, LARGEST_JSON_BYTES, Topic, command_key
from companion.host.peer_data import PeerDataError, copy_payload, parse_object

OnMessage = Callable[[bytes, bytes | None], None]
"""Called in the loop with payload and attachment."""
OnBody = Callable[[Any], None]
"""Called in the loop with the body of a message, parsed."""
OnReply = Callable[[Mapping[str, Any]], None]
"""Called in the loop with a reply: `success`, and `reason` where there is none."""
OnImage = Callable[[bytes, int], None]
"""Called in the loop with a JPEG and its `captured_ns`."""

# Messages that may wait for the loop; of cached topics, each of which matters, and of others.
_CACHED_KEPT, _OTHERS_KEPT, _IMAGES_KEPT = 256, 16, 2
_POLL_S = 0.5
# A click that the service answers later flies nothing.
_ANSWER_S = 5.0
_UNREACHED = {"success": False, "refused": False, "reason": "the service is not reached"}


class BusFeed:
    """Subscriptions of one vehicle. Its methods are called in the loop, except `run`.

    Attributes:
        dropped: messages that could not be used, or for which the loop was too slow.
    """

    def __init__(self, client: ChildClient, vehicle: str) -> None:
        self.dropped = 0
        self._client, self._vehicle = client, vehicle
        self._loop = asyncio.get_running_loop()
        self._listeners: dict[str, tuple[Topic, list[OnBody]]] = {}
        self._users: dict[str | None, dict[str, OnImage]] = {}
        self._changes: queue.SimpleQueue[tuple[str | None, bool] | None] = queue.SimpleQueue()
        self._session: zenoh.Session | None = None

    def subscribe(self, topic: Topic, camera: str | None, on_body: OnBody) -> None:
        """Subscribe to a topic of JSON, before `run`."""
        self._listeners.setdefault(topic.key(self._vehicle, camera), (topic, []))[1].append(on_body)

    def want_images(self, camera: str | None, user: str, on_image: OnImage | None) -> None:
        """Begin to give the images of a camera to a user, or end it (None)."""
        users = self._users.setdefault(camera, {})
        before = bool(users)
        if on_image is None:
            users.pop(user, None)
        else:
            users[user] = on_image
        if bool(users) != before:
            self._changes.put((camera, bool(users)))

    def send_command(self, text: str, on_reply: OnReply) -> None:
        """Send a command to the service, and call back in the loop with its reply or why there is none.

        From the loop, so that the service gets commands in their order: a `hold` after its `follow`.
        """
        reason = f"no answer of the service within {_ANSWER_S:g} s: see `companion echo status`"
        replies: list[Mapping[str, Any]] = [{"success": False, "reason": reason}]

        def on_zenoh(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                with suppress(PeerDataError):
                    replies.append(parse_object(copy_payload(reply.ok.payload, LARGEST_JSON_BYTES)))

        def on_end() -> None:
            if not self._loop.is_closed():
                self._loop.call_soon_threadsafe(on_reply, replies[-1])

        if (session := self._session) is None:
            self._loop.call_soon(on_reply, _UNREACHED)
            return
        callback, sender = zenoh.handlers.Callback(on_zenoh, on_end), str(session.zid())
        session.get(command_key(self._vehicle), callback, payload=text, attachment=sender, timeout=_ANSWER_S)

    def set_settings(self, values: Mapping[str, Any] | None, on_reply: OnReply) -> None:
        """Set settings of the service (None: ask for them), and call back in the loop.

        The reply has `settings`, key → LiveSettingBody, or `reason` and whether the service has `refused`.
        """

        def ask(session: zenoh.Session) -> Mapping[str, Any]:
            given = None if values is None else dict(values)
            settings = set_settings(session, self._vehicle, given, timeout_s=_ANSWER_S)
            return {"success": True, "settings": settings}

        self._ask(ask, on_reply)

    def _ask(self, ask: Callable[[zenoh.Session], Mapping[str, Any]], on_reply: OnReply) -> None:
        """Ask the service in a thread, and call back in the loop."""
        if (session := self._session) is None:
            self._loop.call_soon(on_reply, _UNREACHED)
            return

        def run() -> None:
            try:
                reply = ask(session)
            except (SettingsRefusedError, NoAnswerError, PeerDataError, zenoh.ZError) as error:
                refused = isinstance(error, SettingsRefusedError)
                reply = {"success": False, "refused": refused, "reason": str(error)}
            if not self._loop.is_closed():
                self._loop.call_soon_threadsafe(on_reply, reply)

        Thread(target=run, name="query", daemon=True).start()

    def run(self, on_open: Callable[[], None]) -> None:
        """Open the bus, however late it comes, and keep the subscriptions until the end. In a thread."""
        with self._client.open_bus() as session:
            if session is None:
                return
            self._session = session
            kept = []
            for key, (topic, listeners) in self._listeners.items():
                most = _CACHED_KEPT if topic.cached else _OTHERS_KEPT
                kept.append(self._declare(session, topic, key, partial(self._on_json, listeners), most))
            self._loop.call_soon_threadsafe(on_open)
            images: dict[str | None, Any] = {}
            while not self._client.ending.is_set():
                try:
                    change = self._changes.get(timeout=_POLL_S)
                except queue.Empty:
                    continue
                if change is None:
                    break
                camera, wanted = change
                if wanted:
                    receive = self._image_receiver(camera)
                    key = IMAGE.key(self._vehicle, camera)
                    images[camera] = self._declare(session, IMAGE, key, receive, _IMAGES_KEPT)
                else:
                    images.pop(camera).undeclare()
            self._session = None
            kept.clear()

    def close(self) -> None:
        """End `run`."""
        self._changes.put(None)

    def _on_json(self, listeners: Sequence[OnBody], payload: bytes, _attachment: bytes | None) -> None:
        body = parse_object(payload)
        for on_body in listeners:
            try:
                on_body(body)
            except (ValueError, KeyError, TypeError):  # of another version
                self.dropped += 1

    def _image_receiver(self, camera: str | None) -> OnMessage:
        def on_message(jpeg: bytes, attachment: bytes | None) -> None:
            captured_ns = int(parse_object(attachment or b"{}")["captured_ns"])
            for on_image in tuple(self._users.get(camera, {}).values()):
                on_image(jpeg, captured_ns)

        return on_message

    def _declare(
        self, session: zenoh.Session, topic: Topic, key: str, on_message: OnMessage, kept: int
    ) -> Any:
        waiting: deque[tuple[bytes, bytes | None]] = deque()
        lock, scheduled = Lock(), False

        def on_sample(sample: zenoh.Sample) -> None:
            nonlocal scheduled
            try:
                message = message_of(sample, topic)
            except PeerDataError:
                self.dropped += 1
                return
            with lock:
                waiting.append(message)
                if len(waiting) > kept:
                    waiting.popleft()
                    self.dropped += not topic.of_camera  # of those only the newest matter
                wake, scheduled = not scheduled, True
            if wake and not self._loop.is_closed():
                self._loop.call_soon_threadsafe(drain)

        def drain() -> None:
            nonlocal scheduled
            with lock:
                messages = tuple(waiting)
                waiting.clear()
                scheduled = False
            for payload, attachment in messages:
                try:
                    on_message(payload, attachment)
                except (ValueError, KeyError, TypeError):
                    self.dropped += 1

        subscribe = subscribe_kept if topic.cached else zenoh.Session.declare_subscriber
        return subscribe(session, key, on_sample)
