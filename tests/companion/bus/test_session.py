"""The service's zenoh session, with real sessions over loopback."""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import os
import queue
import signal
import socket
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, Literal
from unittest.mock import Mock

import pytest
import zenoh

from companion.bus import topics
from companion.bus.client import NoAnswerError, client_settings, listen, open_client, send_command
from companion.bus.command_intake import LARGEST_COMMAND_BYTES
from companion.bus.session import Bus, BusError
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port
from tests.companion.zenoh_router import router

pytestmark = pytest.mark.realtime

WAIT_S = 20.0


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(WAIT_S):
        while not condition():
            await asyncio.sleep(0.01)


class Events(list[tuple[str, str]]):
    def __call__(self, level: str, text: str) -> None:
        self.append((level, text))

    def has(self, text: str) -> bool:
        return any(text in line for _, line in self)


async def refuse(text: str) -> dict[str, Any]:
    return {"success": False, "reason": f"no {text}"}


async def test_publication_and_command() -> None:
    settings = ZenohSection(listen=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",))
    bus = Bus(settings, "alpha", on_event=Events(), on_command=refuse)
    await bus.start()
    received: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
    try:

        def other_side() -> tuple[tuple[str, str], dict[str, Any]]:
            with open_client(client_settings(settings)) as session:
                listen(session, "labels", lambda key, text: received.put((key, text)))
                reply = send_command(session, "alpha", "dance")
                return received.get(timeout=WAIT_S), reply

        answer = asyncio.create_task(asyncio.to_thread(other_side))
        while not answer.done():
            bus.publish(topics.LABELS, "car, person")
            await asyncio.sleep(0.02)
        message, reply = await answer
    finally:
        await bus.close()
    assert message == ("companion/alpha/labels", "car, person")
    assert reply == {"success": False, "reason": "no dance"}
    assert bus.published["labels"] > 0


async def test_bad_queries_are_answered_and_stop_passes_a_flood() -> None:
    settings = ZenohSection(listen=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",))
    received: list[str] = []

    async def handle(text: str) -> dict[str, Any]:
        received.append(text[:20])
        if text == "break":
            raise ZeroDivisionError("break 1/0")
        return {"success": True, "reason": ""}

    bus = Bus(settings, "alpha", on_event=Events(), on_command=handle)
    await bus.start()
    try:

        def other_side() -> dict[str, list[str]]:
            with open_client(client_settings(settings)) as session:

                def ask(payload: bytes) -> list[str]:
                    replies = session.get(topics.command_key("alpha"), payload=payload, timeout=WAIT_S)
                    return [json.loads(r.ok.payload.to_string())["reason"] for r in replies if r.ok]

                return {
                    "warm up": ask(b"hold"),
                    "bytes": ask(b"\xff\xfe hold"),
                    "large": ask(b"x" * 10_000_000),
                    "empty": ask(b""),
                    "raises": ask(b"break"),
                    "flood": [reason for _ in range(150) for reason in ask(b"dance")],
                    "other sender": [
                        str(send_command(session, "alpha", "hold", timeout_s=WAIT_S)["success"])
                    ],
                    "stop": ask(b" Stop\n"),
                }

        answers = await asyncio.to_thread(other_side)
    finally:
        await bus.close()
    (refused_bytes,), (refused_size,) = answers["bytes"], answers["large"]
    assert answers["other sender"] == ["True"]
    assert "0xff" in refused_bytes
    assert "10000000 bytes" in refused_size
    assert f" {LARGEST_COMMAND_BYTES} " in refused_size
    assert answers["empty"] == [""]
    assert answers["raises"] == ["ZeroDivisionError: break 1/0"]
    assert len(answers["flood"]) == 150
    assert "commands a second" in answers["flood"][-1]
    assert answers["stop"] == [""]
    assert received[-1] == " Stop\n"
    assert bus.intake.refused == 2 + sum(bool(reason) for reason in answers["flood"])


async def test_busy_port_is_reported_in_one_line() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        bus = Bus(ZenohSection(listen=(endpoint,)), "alpha", on_event=Events(), on_command=refuse)
        with pytest.raises(BusError, match=endpoint) as error:
            await bus.start()
        await bus.close()
    assert "\n" not in str(error.value)


def _read(endpoint: str, ready: Connection) -> None:
    with open_client(client_settings(ZenohSection(listen=(endpoint,)))) as session:
        received = session.declare_subscriber("companion/alpha/**")
        ready.send(True)
        while True:
            received.recv()


async def test_frozen_reader_does_not_block_publishing() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    bus = Bus(ZenohSection(listen=(endpoint,)), "alpha", on_event=Events(), on_command=refuse)
    await bus.start()
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    reader = context.Process(target=_read, args=(endpoint, theirs), daemon=True)
    reader.start()
    try:
        assert await asyncio.to_thread(ours.poll, WAIT_S)
        assert reader.pid is not None
        os.kill(reader.pid, signal.SIGSTOP)
        slowest_s = 0.0
        for _ in range(2000):
            for topic in topics.TOPICS:
                started = time.perf_counter()
                bus.publish(topic, "x" * 20_000)
                slowest_s = max(slowest_s, time.perf_counter() - started)
        # With BLOCK zenoh waits five seconds for a reader; a busy machine is far below that.
        assert slowest_s < 2.0
    finally:
        reader.kill()
        reader.join()
        ours.close()
        await bus.close()


async def test_failing_command_is_sent_once() -> None:
    received: list[str] = []

    async def fail(text: str) -> dict[str, Any]:
        received.append(text)
        raise RuntimeError("fault 7")

    settings = ZenohSection(listen=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",))
    bus = Bus(settings, "alpha", on_event=Events(), on_command=fail)
    await bus.start()
    try:

        def other_side() -> dict[str, Any]:
            with open_client(client_settings(settings)) as session:
                return send_command(session, "alpha", "takeoff 5")

        reply = await asyncio.to_thread(other_side)
    finally:
        await bus.close()
    assert reply == {"command": "takeoff 5", "success": False, "reason": "RuntimeError: fault 7"}
    assert received == ["takeoff 5"]


@pytest.mark.parametrize("mode", ["peer", "client"])
async def test_killed_router_is_reported_and_reconnected(mode: Literal["peer", "client"]) -> None:
    port = free_port(socket.SOCK_STREAM)
    events = Events()
    settings = ZenohSection(mode=mode, connect=(f"tcp/127.0.0.1:{port}",), listen=())
    bus = Bus(settings, "alpha", on_event=events, on_command=refuse)
    await bus.start()
    try:
        await until(lambda: bool(events))
        assert not bus.connected
        bus.publish(topics.LABELS, "car")  # without a peer: neither blocks nor raises
        with router(port) as process:
            await until(lambda: bus.connected)
            process.kill()
            await until(lambda: not bus.connected)
            assert events.has("no connection")
        events.clear()
        with router(port):
            await until(lambda: events.has("connected to"))
            with open_client(client_settings(settings)) as session:
                reply = await asyncio.to_thread(send_command, session, "alpha", "dance")
            assert reply["reason"] == "no dance"
    finally:
        await bus.close()


async def test_publication_before_the_session_is_counted() -> None:
    settings = ZenohSection(mode="client", connect=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",))
    bus = Bus(settings, "alpha", on_event=Events(), on_command=refuse)
    bus.publish(topics.LABELS, "car")
    assert bus.publish_failed == 1
    assert bus.published["labels"] == 0


def test_client_without_a_service_fails() -> None:
    settings = client_settings(ZenohSection(listen=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",)))
    with (
        pytest.raises(NoAnswerError, match="companion run"),
        open_client(settings, timeout_s=0.5),
    ):
        pass


def test_topic_keys_are_unique() -> None:
    keys = {topic.key("v") for topic in topics.TOPICS}
    assert len(keys) == len(topics.TOPICS)


def _serve(endpoint: str, ready: Connection) -> None:
    """Run a service that receives commands and never answers."""

    async def serve() -> None:
        async def think(_text: str) -> dict[str, Any]:
            ready.send("received")
            await asyncio.Event().wait()
            return {}

        bus = Bus(ZenohSection(listen=(endpoint,)), "alpha", on_event=Events(), on_command=think)
        await bus.start()
        bus.publish(topics.STATUS, {"vehicle": {"without_service": "PX4 holds its position"}})
        ready.send("up")
        await asyncio.Event().wait()

    asyncio.run(serve())


def test_killed_service_fails_a_pending_command() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    service = context.Process(target=_serve, args=(endpoint, theirs), daemon=True)
    service.start()
    killed_s = 0.0

    def kill_when_asked() -> None:
        nonlocal killed_s
        assert ours.poll(WAIT_S)
        assert ours.recv() == "received"
        service.kill()
        killed_s = time.monotonic()

    try:
        assert ours.poll(WAIT_S)
        assert ours.recv() == "up"
        killer = threading.Thread(target=kill_when_asked)
        with open_client(client_settings(ZenohSection(listen=(endpoint,)))) as session:
            killer.start()
            with pytest.raises(NoAnswerError, match=r"has gone .*PX4"):
                send_command(session, "alpha", "orbit", timeout_s=60.0)
        assert time.monotonic() - killed_s < 2.0
        killer.join()
    finally:
        service.kill()
        service.join()
        ours.close()


async def test_silent_service_is_reported_once_and_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its loop hangs: its presence stays, and the command may still be flown."""
    monkeypatch.setattr("companion.bus.client.SILENT_S", 0.2)
    settings = ZenohSection(listen=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",))
    reported = asyncio.Queue[str]()
    loop = asyncio.get_running_loop()

    async def think(_text: str) -> dict[str, Any]:
        received.append(await reported.get())
        await asyncio.sleep(0.5)  # silent on: it is not reported again
        return {"success": True, "reason": "done"}

    received: list[str] = []
    bus = Bus(settings, "alpha", on_event=Events(), on_command=think)
    await bus.start()
    try:
        bus.publish(topics.STATUS, {"vehicle": {"without_service": "PX4 holds its position"}})

        def other_side() -> dict[str, Any]:
            with open_client(client_settings(settings)) as session:

                def report(text: str) -> None:
                    loop.call_soon_threadsafe(reported.put_nowait, text)

                return send_command(session, "alpha", "orbit", timeout_s=WAIT_S, on_silent=report)

        assert (await asyncio.to_thread(other_side))["success"]
    finally:
        await bus.close()
    assert reported.empty()
    assert "PX4" in received[0]


def test_connection_to_a_stopped_process_is_closed_quietly(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Mock()
    session.close.side_effect = zenoh.ZError("close operation timed out!")
    monkeypatch.setattr("companion.bus.client._open", lambda *_: session)
    with pytest.raises(NoAnswerError), open_client(ZenohSection()):
        raise NoAnswerError("the service is silent")
    session.close.assert_called_once()


async def test_unknown_vehicle_has_no_service() -> None:
    settings = ZenohSection(listen=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",))
    bus = Bus(settings, "alpha", on_event=Events(), on_command=refuse)
    await bus.start()
    try:

        def other_side() -> None:
            with (
                open_client(client_settings(settings)) as session,
                pytest.raises(NoAnswerError, match=r"'beta': .*vehicle\.name"),
            ):
                send_command(session, "beta", "hold")

        await asyncio.to_thread(other_side)
    finally:
        await bus.close()
