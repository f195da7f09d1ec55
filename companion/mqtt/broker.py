"""The connection to an MQTT broker: kept, opened again, and nothing queued without bound."""

from __future__ import annotations

import asyncio
import ssl
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn
from urllib.parse import urlsplit

import aiomqtt

from companion.bus.child_client import LISTENING, PAUSED
from companion.host.restarts import Restarts
from companion.mqtt import MqttError
from companion.settings.key_files import KeyFileError, read_secret
from companion.settings.operator import MqttSection
from vision.file_kinds import explained
from vision.text_file import NotUtf8Error, read_text

ONLINE, OFFLINE = "online", "offline"
MOST_EVENTS = 200
LARGEST_COMMAND_BYTES = 4096
_KEEPALIVE_S = 15
_ANSWER_S = 10.0
_AT_ONCE = 10  # states, and events: over a slow network each takes its time to be acknowledged
_REFUSED = 0x80  # MQTT 3.1.1, 3.9.3
_PORTS = {"mqtt": 1883, "mqtts": 8883}


@dataclass(frozen=True, slots=True)
class Broker:
    """Where the broker is, and how it is reached. `tls`: None without."""

    host: str
    port: int
    username: str | None
    password: str | None
    tls: ssl.SSLContext | None

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'mqtt' if self.tls is None else 'mqtts'}://{host}:{self.port}"


def broker_of(section: MqttSection) -> Broker:
    """Return the broker of the settings. Raises MqttError: a file or the address cannot be used."""
    assert section.url is not None
    parts = urlsplit(section.url)
    try:
        port = parts.port or _PORTS[parts.scheme]
        password = section.password_file and read_secret(Path(section.password_file), "mqtt.password_file")
    except KeyFileError as error:
        raise MqttError(str(error)) from error
    except ValueError as error:
        raise MqttError(f"mqtt.url {section.url}: {error}") from error
    tls = _tls(section.ca_file) if parts.scheme == "mqtts" else None
    return Broker(parts.hostname or "", port, section.username, password, tls)


def _tls(ca_file: str | None) -> ssl.SSLContext:
    if ca_file is None:
        return ssl.create_default_context()
    path = Path(ca_file)
    try:
        text = read_text(path)
    except NotUtf8Error:
        text = ""
    except OSError as error:
        raise MqttError(f"mqtt.ca_file {path}: cannot be read: {error.strerror}") from error
    wrong = f"mqtt.ca_file {explained(path, f'{path}: expected certificates of TLS, PEM')}"
    if "BEGIN CERTIFICATE" not in text:  # without one the system's would be used
        raise MqttError(wrong)
    try:
        return ssl.create_default_context(cadata=text)
    except (ssl.SSLError, ValueError) as error:
        raise MqttError(wrong) from error


class BrokerLink:
    """Sends what is put into it while there is a broker. Everything is called in the asyncio loop.

    Of states the newest of each topic waits; of events `MOST_EVENTS`, while connected only: an event is not
    reported minutes late. What is left out is counted, and said at the next connection.

    Args:
        available: topic of `online` and `offline`; the latter is the last will.
        command: topic to subscribe to; None: none. `on_command` is called with a text that was not retained.
        say: called with a line.
    """

    def __init__(
        self,
        broker: Broker,
        available: str,
        say: Callable[[str], None],
        command: str | None = None,
        on_command: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._broker, self._available, self._say = broker, available, say
        self._command, self._on_command = command, on_command
        self._states: dict[str, bytes] = {}  # all that are retained, for a broker that has lost them
        self._unsent: dict[str, None] = {}
        self._events: deque[tuple[str, bytes]] = deque()
        self._sending: list[tuple[str, bytes]] = []
        self._connected = False
        self._left_out = 0
        self._waiting = asyncio.Event()

    def state(self, topic: str, payload: bytes) -> None:
        """Publish a retained message; an unsent one of the same topic is replaced."""
        self._states[topic] = payload
        self._unsent[topic] = None
        self._waiting.set()

    def event(self, topic: str, payload: bytes) -> None:
        """Publish a message that is not retained, or count it."""
        if not self._connected:
            self._left_out += 1
            return
        self._events.append((topic, payload))
        while len(self._events) > MOST_EVENTS:
            self._events.popleft()
            self._left_out += 1
        self._waiting.set()

    async def run(self) -> NoReturn:
        """Keep the connection until cancelled, then say `offline`."""
        restarts, said, loop = Restarts(), "", asyncio.get_running_loop()
        while True:
            since_s = loop.time()
            try:
                async with self._connection() as client:
                    said = ""
                    self._say(f"{LISTENING}{self._broker}{self._losses()}")
                    await self._work(client)
            except* (aiomqtt.MqttError, OSError) as errors:
                why = str(errors.exceptions[0]).strip() or type(errors.exceptions[0]).__name__
                if why != said:
                    self._say(f"{PAUSED}MQTT broker {self._broker}: {why}; retrying")
                said = why
            self._left_out += len(self._events) + len(self._sending)
            self._events.clear()
            self._sending.clear()
            await asyncio.sleep(restarts.after(loop.time() - since_s).pause_s)

    @asynccontextmanager
    async def _connection(self) -> AsyncIterator[aiomqtt.Client]:
        broker = self._broker
        client = aiomqtt.Client(
            broker.host,
            broker.port,
            username=broker.username,
            password=broker.password,
            will=aiomqtt.Will(self._available, OFFLINE, qos=1, retain=True),
            keepalive=_KEEPALIVE_S,
            timeout=_ANSWER_S,
            tls_context=broker.tls,
            max_queued_incoming_messages=MOST_EVENTS,
        )
        client.pending_calls_threshold = 2 * _AT_ONCE
        async with client:
            self._unsent = dict.fromkeys(self._states)
            self._connected = True
            self._waiting.set()
            try:
                yield client
            finally:  # an orderly end revokes the will
                self._connected = False
                with suppress(aiomqtt.MqttError, TimeoutError):
                    async with asyncio.timeout(1.0):
                        await client.publish(self._available, OFFLINE, qos=1, retain=True)

    async def _work(self, client: aiomqtt.Client) -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(self._send(client))
            if self._command is not None:
                (granted,) = await client.subscribe(self._command, qos=0)  # never delivered twice
                if getattr(granted, "value", granted) >= _REFUSED:
                    self._say(f"commands: the broker does not let its user subscribe to {self._command}")
            async for message in client.messages:
                payload = message.payload
                if message.retain or not isinstance(payload, bytes) or len(payload) > LARGEST_COMMAND_BYTES:
                    self._say(f"{message.topic}: a message that is retained or too large is no command")
                    continue
                self._on_command(payload.decode(errors="replace"))

    async def _send(self, client: aiomqtt.Client) -> None:
        while True:
            await self._waiting.wait()
            self._waiting.clear()
            while self._unsent or self._events:
                states = list(self._unsent)[:_AT_ONCE]
                for topic in states:
                    del self._unsent[topic]
                self._sending = [self._events.popleft() for _ in range(min(len(self._events), _AT_ONCE))]
                await asyncio.gather(
                    *(client.publish(topic, self._states[topic], qos=1, retain=True) for topic in states),
                    *(client.publish(topic, payload, qos=1) for topic, payload in self._sending),
                )
                self._sending.clear()

    def _losses(self) -> str:
        count, self._left_out = self._left_out, 0
        return f" ({count} events were not sent)" if count else ""
