"""Foxglove live: a client of the bus that serves what a recording has as Foxglove's WebSocket protocol."""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from threading import Event, Lock

import foxglove
import zenoh
from foxglove.websocket import ChannelView, Client, ServerListener

from companion.bus.client import message_of, open_client
from companion.bus.topics import LARGE_TOPICS, ROOT, RUN, TOPICS, Topic
from companion.host.passing import AddressTakenError
from companion.recording import RecordingError
from companion.recording.convert import Converter, large_channel
from companion.recording.files import Channel, Recorded
from companion.recording.recorder import subscribe_all
from companion.settings import ZenohSection
from companion.settings.key_files import is_loopback

MAX_KEPT_CHANNELS = 64
"""A camera has up to three, and each name on the bus may be a camera's."""
MAX_KEPT_BYTES = 1024 * 1024
"""Of one channel, besides `Topic.cached` messages."""


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """What to serve, and where. `listen`: HOST:PORT. `zenoh`: settings of a client."""

    zenoh: ZenohSection
    vehicle: str
    listen: str


class Kept:
    """The newest messages of one channel, oldest first, for viewers that come later.

    Args:
        messages: most of them. They have at most `MAX_KEPT_BYTES` together.
    """

    def __init__(self, messages: int) -> None:
        self._messages: deque[Recorded] = deque()
        self._most, self._bytes = messages, 0

    def add(self, message: Recorded) -> None:
        """Keep a message, and drop the oldest of too many."""
        self._messages.append(message)
        self._bytes += len(message.data)
        while len(self._messages) > self._most or self._bytes > MAX_KEPT_BYTES:
            self._bytes -= len(self._messages.popleft().data)

    def __iter__(self) -> Iterator[Recorded]:
        return iter(self._messages)


class Live(ServerListener):
    """Sends messages to viewers. Images and point clouds are subscribed to only while a viewer shows them.

    A viewer that comes later begins with the messages that the service keeps (`Topic.cached`). One that is
    sent in the instant between its subscription and `on_subscribe` it gets before them, and again with them.
    """

    def __init__(self, options: LiveOptions, session: zenoh.Session) -> None:
        self._vehicle, self._session = options.vehicle, session
        self._converter = Converter(options.vehicle)
        self._channels: dict[str, foxglove.Channel] = {}
        self._viewers: Counter[str] = Counter()
        self._large: dict[str, zenoh.Subscriber[None]] = {}
        self._kept: dict[str, Kept] = {}
        # zenoh's threads, and the server's. A message is kept and sent under it: a viewer that comes between
        # the two would not get it, or get it before older ones.
        self._lock = Lock()
        host, _, port = options.listen.rpartition(":")
        for topic in LARGE_TOPICS:
            self._channel(large_channel(topic))
        try:
            self._server = foxglove.start_server(
                name=f"companion {options.vehicle}", host=host, port=int(port), server_listener=self
            )
        except Exception as error:  # of the SDK, without a common base
            raise AddressTakenError(f"foxglove.listen: {options.listen} cannot be served: {error}") from error
        topics = [topic for topic in (*TOPICS, RUN) if topic not in LARGE_TOPICS]
        self._subscribers = subscribe_all(session, options.vehicle, topics, self._on_sample)

    @property
    def port(self) -> int:
        """The port that is served."""
        return self._server.port

    def close(self) -> None:
        """Stop serving."""
        for subscriber in (*self._subscribers, *self._large.values()):
            subscriber.undeclare()
        self._server.stop()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Called by the server: a viewer shows a topic."""
        with self._lock:
            self._viewers[channel.topic] += 1
            name = channel.topic.rpartition("/")[2]
            large = next((topic for topic in LARGE_TOPICS if topic.name == name), None)
            if self._viewers[channel.topic] == 1 and large is not None:
                key = f"{ROOT}/{self._vehicle}{channel.topic}"
                receive = partial(self._on_sample, large)
                self._large[channel.topic] = self._session.declare_subscriber(key, receive)
            for message in self._kept.get(channel.topic, ()):
                # A viewer's sink has the number of its client: nothing else in this process is a sink.
                self._log(message, sink_id=client.id)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Called by the server: a viewer shows a topic no more."""
        with self._lock:
            self._viewers[channel.topic] -= 1
            unused = None if self._viewers[channel.topic] else self._large.pop(channel.topic, None)
        if unused is not None:
            unused.undeclare()  # type: ignore[no-untyped-call]

    def _on_sample(self, topic: Topic, sample: zenoh.Sample) -> None:
        path = str(sample.key_expr).removeprefix(f"{ROOT}/{self._vehicle}/")
        try:
            payload, attachment = message_of(sample, topic)
            with self._lock:
                messages = list(self._converter.convert(path, payload, attachment))
                if path == RUN.name:
                    for camera in json.loads(messages[0].data)["settings"]["cameras"]:
                        for large in LARGE_TOPICS:
                            self._channel(large_channel(large, f"cameras/{camera}"))
                for message in messages:
                    if topic.cached:
                        self._keep(message, topic.cached)
                    self._log(message)
        except (ValueError, KeyError, TypeError):
            return  # of another version, another program's, or too large

    def _keep(self, message: Recorded, most: int) -> None:
        name = message.channel.topic
        if name not in self._kept and len(self._kept) < MAX_KEPT_CHANNELS:
            self._kept[name] = Kept(most)
        if name in self._kept:
            self._kept[name].add(message)

    def _log(self, message: Recorded, sink_id: int | None = None) -> None:
        """Send to all viewers of the channel, or to one."""
        channel = self._channel(message.channel)
        channel.log(message.data, log_time=message.log_time_ns, sink_id=sink_id)

    def _channel(self, channel: Channel) -> foxglove.Channel:
        found = self._channels.get(channel.topic)
        if found is None:
            schema = foxglove.Schema(name=channel.schema_name, encoding="jsonschema", data=channel.schema)
            found = foxglove.Channel(channel.topic, schema=schema, message_encoding=channel.encoding)
            self._channels[channel.topic] = found
        return found


def serve(options: LiveOptions, ending: Event, say: Callable[[str], None]) -> None:
    """Serve until `ending` is set.

    Raises:
        RecordingError: the address is not one of this computer alone. AddressTakenError: it is taken.
        NoAnswerError: no service at the endpoint.
    """
    host = options.listen.rpartition(":")[0].strip("[]")
    if not is_loopback(host):
        raise RecordingError(
            f"foxglove.listen: expected a loopback address, since there is no authentication, got {host}; "
            "from another computer use ssh -L"
        )
    with open_client(options.zenoh, timeout_s=10.0) as session:
        live = Live(options, session)
        say(f"open ws://{options.listen.rpartition(':')[0]}:{live.port} in Foxglove")
        ending.wait()
        live.close()
