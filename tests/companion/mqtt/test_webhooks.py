"""Webhooks: order, repetition, and servers that hang or refuse."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from collections.abc import Awaitable, Callable

import pytest

from companion.mqtt import webhooks
from companion.mqtt.webhooks import MOST_BYTES, MOST_EVENTS, Webhook
from mavlink_sim.testing import free_port

pytestmark = pytest.mark.realtime

WAIT_S = 20.0
QUICK = (0.01, 0.01, 0.01)
Answer = Callable[[int], int | None]
"""From the number of a request to the status, or None: no answer at all."""


class Server:
    """A server of HTTP with given answers. `requests`: Idempotency-Key and body; `said`: by the webhook."""

    def __init__(self, answer: Answer) -> None:
        self._answer, self.requests, self.said = answer, list[tuple[str, bytes]](), list[str]()
        self.changed = asyncio.Event()

    def say(self, line: str) -> None:
        self.said.append(line)
        self.changed.set()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while head := (await reader.readuntil(b"\r\n\r\n")).decode().lower():
            fields = dict(line.split(": ", 1) for line in head.split("\r\n")[1:] if line)
            body = await reader.readexactly(int(fields["content-length"]))
            assert fields["content-type"] == "application/json"
            self.requests.append((fields["idempotency-key"], body))
            status = self._answer(len(self.requests))
            self.changed.set()
            if status is None:
                await asyncio.sleep(60.0)
            writer.write(
                f"HTTP/1.1 {status} x\r\ncontent-length: 0\r\nlocation: http://127.0.0.1:1/\r\n\r\n".encode()
            )


def with_server(answer: Answer, work: Callable[[Webhook, Server], Awaitable[None]]) -> list[str]:
    """Run server and webhook meanwhile; returns what was said."""

    async def run() -> list[str]:
        server = Server(answer)
        listening = await asyncio.start_server(server.serve, "127.0.0.1", 0)
        port = listening.sockets[0].getsockname()[1]
        webhook = Webhook(f"http://127.0.0.1:{port}/?token=secret", server.say, QUICK)
        running = asyncio.create_task(webhook.run())
        async with asyncio.timeout(WAIT_S):
            await work(webhook, server)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        listening.close()
        assert not any("secret" in line for line in server.said)
        return server.said

    return asyncio.run(run())


async def wait_for(server: Server, count: int, lines: int = 0) -> None:
    while len(server.requests) < count or len(server.said) < lines:
        server.changed.clear()
        await server.changed.wait()


def test_events_are_posted_in_order_and_again_until_they_are_taken() -> None:
    async def work(webhook: Webhook, server: Server) -> None:
        webhook.put("a", b"1")
        webhook.put("b", b"2")
        await wait_for(server, 4)
        assert server.requests == [("a", b"1"), ("a", b"1"), ("a", b"1"), ("b", b"2")]

    assert with_server(lambda number: {1: 503, 2: 429}.get(number, 204), work) == []


@pytest.mark.parametrize(("status", "tries"), [(404, 1), (302, 1), (500, 4)])
def test_another_status_is_final_and_a_fault_is_tried_four_times(
    status: int, tries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webhooks, "_CALM_S", 0.0)

    async def work(webhook: Webhook, server: Server) -> None:
        webhook.put("a", b"1")
        webhook.put("b", b"2")
        await wait_for(server, tries + 1, lines=2)
        assert [key for key, _ in server.requests] == ["a"] * tries + ["b"]

    said = with_server(lambda number: 204 if number > tries else status, work)
    assert all(f"status {status}" in line for line in said[:-1])
    assert said[-1].endswith("posting again; 1 events were not delivered")
    assert len(said) == 2


def test_a_fault_is_said_when_it_begins_and_when_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhooks, "_CALM_S", 0.0)

    async def work(webhook: Webhook, server: Server) -> None:
        for number in range(4):
            webhook.put(str(number), b"{}")
        await wait_for(server, 13, lines=2)  # three events four times each

    said = with_server(lambda number: 500 if number <= 12 else 204, work)
    assert len(said) == 2
    assert said[1].endswith("posting again; 3 events were not delivered")


@pytest.mark.parametrize("status", [400, None])
def test_a_server_that_takes_every_other_event_is_said_once(
    status: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webhooks, "_TIMEOUT_S", 0.05)

    async def work(webhook: Webhook, server: Server) -> None:
        for number in range(MOST_EVENTS + 1):  # the first is too much
            webhook.put(str(number), b"{}")
        await wait_for(server, 60)

    assert len(with_server(lambda number: 204 if number % 2 else status, work)) == 1


def test_nobody_listening_is_called_so() -> None:
    async def run() -> list[str]:
        said: asyncio.Queue[str] = asyncio.Queue()
        port = free_port(socket.SOCK_STREAM)
        webhook = Webhook(f"http://127.0.0.1:{port}/", said.put_nowait, (0.0, 0.0, 1e6))
        webhook.put("a", b"{}")
        running = asyncio.create_task(webhook.run())
        async with asyncio.timeout(WAIT_S):
            lines = [await said.get()]
        for number in range(MOST_EVENTS + 1):
            webhook.put(str(number), b"{}")
        running.cancel()
        return lines + [said.get_nowait() for _ in range(said.qsize())]

    (line,) = asyncio.run(run())
    assert line.endswith(f"{os.strerror(errno.ECONNREFUSED)}; retrying")


def test_a_server_that_hangs_costs_a_bounded_queue(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhooks, "_TIMEOUT_S", 0.2)

    async def work(webhook: Webhook, server: Server) -> None:
        webhook.put("first", b"{}")
        await wait_for(server, 1)
        for number in range(3 * MOST_EVENTS):
            webhook.put(str(number), b"{}")
        await wait_for(server, 5)
        # Four times the first; then, of those that waited, the newest.
        assert [key for key, _ in server.requests] == ["first"] * 4 + [str(2 * MOST_EVENTS)]

    said = with_server(lambda number: None if number <= 4 else 204, work)
    assert "too slowly" in said[0]


def test_large_events_that_wait_are_bounded_in_bytes() -> None:
    async def work(webhook: Webhook, server: Server) -> None:
        for number in range(10):
            webhook.put(str(number), bytes(MOST_BYTES // 4))
        await wait_for(server, 4)
        assert [key for key, _ in server.requests] == ["6", "7", "8", "9"]

    with_server(lambda _: 204, work)
