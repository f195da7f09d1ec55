"""The link to a broker: what it sends, what it leaves out while there is none, what it refuses."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, ExitStack, suppress
from pathlib import Path

import aiomqtt
import pytest

from companion.mqtt import MqttError, broker
from companion.mqtt.broker import MOST_EVENTS, BrokerLink, broker_of
from companion.settings.operator import MqttSection
from mavlink_sim.testing import free_port
from tests.companion.mqtt import mosquitto

pytestmark = [pytest.mark.realtime, pytest.mark.needs("mosquitto")]

AVAILABLE, STATE, EVENTS, COMMAND = "c/v/available", "c/v/state", "c/v/objects", "c/v/command"
WAIT_S = 20.0


class Said:
    """Lines of the link, to wait for."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._changed = asyncio.Event()

    def say(self, line: str) -> None:
        self.lines.append(line)
        self._changed.set()

    async def wait(self, text: str, count: int = 1) -> str:
        async with asyncio.timeout(WAIT_S):
            while len(found := [line for line in self.lines if text in line]) < count:
                self._changed.clear()
                await self._changed.wait()
        return found[-1]


async def next_of(client: aiomqtt.Client, topic: str) -> tuple[str, bool]:
    async with asyncio.timeout(WAIT_S):
        async for message in client.messages:
            if str(message.topic) == topic and isinstance(message.payload, bytes):
                return message.payload.decode(), message.retain
    raise AssertionError


def with_link(
    work: Callable[[BrokerLink, Said, list[str]], Awaitable[None]], port: int, **more: str | None
) -> list[str]:
    """Run a link meanwhile; returns its lines. The third argument gets its commands."""

    async def run() -> list[str]:
        said, commands = Said(), list[str]()
        section = MqttSection(url=f"mqtt://127.0.0.1:{port}", **more)  # type: ignore[arg-type]
        link = BrokerLink(broker_of(section), AVAILABLE, said.say, COMMAND, commands.append)
        running = asyncio.create_task(link.run())
        try:
            await work(link, said, commands)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
        return said.lines

    return asyncio.run(run())


def station(port: int, **more: str) -> aiomqtt.Client:
    return aiomqtt.Client("127.0.0.1", port, **more)  # type: ignore[arg-type]


def test_states_are_retained_events_are_not_and_the_end_is_said(tmp_path: Path) -> None:
    async def work(link: BrokerLink, said: Said, _: list[str]) -> None:
        await said.wait("open mqtt://")
        async with station(port) as before:
            await before.subscribe("c/#")
            link.state(AVAILABLE, b"online")
            link.state(STATE, b"1")
            link.event(EVENTS, "schöne Kuh".encode())
            assert await next_of(before, EVENTS) == ("schöne Kuh", False)
        after = await stack.enter_async_context(station(port))
        await after.subscribe("c/#")
        assert await next_of(after, STATE) == ("1", True)
        ended.append(after)

    async def run() -> None:
        async with stack:
            said = Said()
            link = BrokerLink(broker_of(MqttSection(url=f"mqtt://127.0.0.1:{port}")), AVAILABLE, said.say)
            running = asyncio.create_task(link.run())
            await work(link, said, [])
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            while (await next_of(ended[0], AVAILABLE))[0] != "offline":
                pass

    port, stack, ended = free_port(socket.SOCK_STREAM), AsyncExitStack(), list[aiomqtt.Client]()
    with mosquitto.broker(port, tmp_path):
        asyncio.run(run())


@pytest.mark.parametrize("how", ["killed", "stopped"])
def test_events_without_a_broker_are_counted_not_queued(
    how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(broker, "_ANSWER_S", 1.0)
    port, processes = free_port(socket.SOCK_STREAM), list[subprocess.Popen[bytes]]()

    async def work(link: BrokerLink, said: Said, _: list[str]) -> None:
        await said.wait("open mqtt://")
        if how == "killed":
            processes[0].kill()
        else:
            os.kill(processes[0].pid, signal.SIGSTOP)
            for number in range(3 * MOST_EVENTS):  # what can wait is bounded
                link.event(EVENTS, str(number).encode())
        assert f"mqtt://127.0.0.1:{port}" in await said.wait("paused: ")
        for number in range(500):
            link.event(EVENTS, str(number).encode())
            link.state(STATE, str(number).encode())
        with ExitStack() as stack:
            if how == "killed":
                stack.enter_context(mosquitto.broker(port, tmp_path))
            else:
                os.kill(processes[0].pid, signal.SIGCONT)
            line = await said.wait("open mqtt://", 2)
            # Of those in time some were on the way.
            lost = int(line.split("(")[1].split()[0])
            assert lost == 500 if how == "killed" else 500 + 2 * MOST_EVENTS < lost <= 500 + 3 * MOST_EVENTS
            async with station(port) as client:
                await client.subscribe(STATE)
                assert await next_of(client, STATE) == ("499", True)

    with mosquitto.broker(port, tmp_path) as process:
        processes.append(process)
        lines = with_link(work, port)
    assert sum("paused: " in line for line in lines) <= 3  # the same reason is said once


def test_a_retained_or_large_message_is_no_command(tmp_path: Path) -> None:
    port = free_port(socket.SOCK_STREAM)

    async def work(_: BrokerLink, said: Said, commands: list[str]) -> None:
        await said.wait("open mqtt://")
        async with station(port) as client:
            await client.publish(COMMAND, "x" * 5000)
            await said.wait(COMMAND, 2)
            await client.publish(COMMAND, "stop")
            async with asyncio.timeout(WAIT_S):
                while not commands:
                    await asyncio.sleep(0.01)
        assert commands == ["stop"]

    with mosquitto.broker(port, tmp_path):

        async def retain() -> None:
            async with station(port) as client:
                await client.publish(COMMAND, "takeoff", qos=1, retain=True)

        asyncio.run(retain())
        with_link(work, port)


def test_a_fault_of_ours_is_followed_by_offline(tmp_path: Path) -> None:
    def fail(_: str) -> None:
        raise ArithmeticError

    async def run() -> None:
        said, broker = Said(), broker_of(MqttSection(url=f"mqtt://127.0.0.1:{port}"))
        link = BrokerLink(broker, AVAILABLE, said.say, COMMAND, fail)
        running = asyncio.create_task(link.run())
        await said.wait("open mqtt://")
        async with station(port) as client:
            await client.subscribe(AVAILABLE)
            link.state(AVAILABLE, b"online")
            assert (await next_of(client, AVAILABLE))[0] == "online"
            await client.publish(COMMAND, "stop")
            assert (await next_of(client, AVAILABLE))[0] == "offline"
        (error,) = await asyncio.gather(running, return_exceptions=True)
        assert isinstance(error, ExceptionGroup)

    port = free_port(socket.SOCK_STREAM)
    with mosquitto.broker(port, tmp_path):
        asyncio.run(run())


def test_a_refused_subscription_is_said_by_its_topic() -> None:
    port = free_port(socket.SOCK_STREAM)

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while head := await reader.read(2):  # type and length, of packets below 128 bytes
            body = await reader.readexactly(head[1])
            if head[0] == 0x10:  # CONNECT
                writer.write(b"\x20\x02\x00\x00")
            if head[0] == 0x82:  # SUBSCRIBE
                writer.write(b"\x90\x03" + body[:2] + b"\x80")

    async def work(_: BrokerLink, said: Said, __: list[str]) -> None:
        async with await asyncio.start_server(serve, "127.0.0.1", port):
            assert COMMAND in await said.wait("commands: ")

    with_link(work, port)


def test_a_slow_network_is_used_by_several_messages_at_once(tmp_path: Path) -> None:
    port, far = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_STREAM)

    async def forward(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        loop = asyncio.get_running_loop()
        while data := await reader.read(65536):
            loop.call_later(0.1, writer.write, data)

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", port)
        with suppress(OSError):
            await asyncio.gather(forward(reader, far_writer), forward(far_reader, writer))

    async def work(link: BrokerLink, said: Said, _: list[str]) -> None:
        async with await asyncio.start_server(serve, "127.0.0.1", far):
            await said.wait("open mqtt://")
            async with station(port) as client:
                await client.subscribe(EVENTS)
                begun_s = time.monotonic()
                for number in range(100):
                    link.event(EVENTS, str(number).encode())
                received = [(await next_of(client, EVENTS))[0] for _ in range(100)]
            assert received == [str(number) for number in range(100)]
            assert time.monotonic() - begun_s < 10.0  # one after another: 20 s

    with mosquitto.broker(port, tmp_path):
        with_link(work, far)


CERTIFICATE = (
    "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj /CN={name} "
    "-addext subjectAltName=IP:127.0.0.1 -keyout {name}.key -out {name}.pem"
)


@pytest.mark.needs("openssl")
@pytest.mark.parametrize(
    ("password", "authority", "line"),
    [
        ("propeller", "broker", "open mqtts://"),
        ("a wrong password", "broker", "uthori"),
        ("propeller", "other", "certificate verify failed"),
    ],
)
def test_a_broker_with_tls_and_a_password(password: str, authority: str, line: str, tmp_path: Path) -> None:
    port, secret, users = free_port(socket.SOCK_STREAM), tmp_path / "secret", tmp_path / "users"
    for name in ("broker", "other"):
        subprocess.run(CERTIFICATE.format(name=name).split(), check=True, capture_output=True, cwd=tmp_path)
    subprocess.run(["mosquitto_passwd", "-c", "-b", users, "drone", "propeller"], check=True)
    secret.write_text(f"{password}\n")
    secret.chmod(0o600)
    more = f"allow_anonymous false\npassword_file {users}\n"
    more += f"certfile {tmp_path}/broker.pem\nkeyfile {tmp_path}/broker.key"

    async def run() -> list[str]:
        said = Said()
        section = MqttSection(
            url=f"mqtts://127.0.0.1:{port}",
            username="drone",
            password_file=str(secret),
            ca_file=str(tmp_path / f"{authority}.pem"),
        )
        running = asyncio.create_task(BrokerLink(broker_of(section), AVAILABLE, said.say).run())
        await said.wait(line)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        return said.lines

    with mosquitto.broker(port, tmp_path, more):
        lines = asyncio.run(run())
    assert not any(password in line for line in lines)


@pytest.mark.parametrize("name", ["password_file", "ca_file"])
def test_a_missing_file_is_refused_by_its_setting(name: str, tmp_path: Path) -> None:
    with pytest.raises(MqttError, match=f"mqtt.{name} .*/none: "):
        broker_of(MqttSection(url="mqtts://broker", **{name: str(tmp_path / "none")}))  # type: ignore[arg-type]
