"""A running server of the page on loopback, and plain HTTP requests to it."""

from __future__ import annotations

import asyncio
import http.client
import json
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

from anyio.from_thread import start_blocking_portal

from companion.dashboard.access import HEADER
from companion.dashboard.server import DashboardOptions, serve
from companion.settings import LanguageSection, ZenohSection
from mavlink_sim.testing import free_port
from tests.companion.service_process import ServiceProcess

NAME = "vehicle1"
POST = {HEADER: "1", "content-type": "application/json"}


@asynccontextmanager
async def serving(
    endpoint: str = "tcp/127.0.0.1:9",
    *,
    listen: str = "127.0.0.1",
    port: int | None = None,
    token_file: Path | None = None,
    language: LanguageSection | None = None,
    hosts: tuple[str, ...] = (),
) -> AsyncIterator[int]:
    """Serve the page of the service at a zenoh endpoint; yields the port."""
    port = free_port(socket.SOCK_STREAM) if port is None else port
    zenoh = ZenohSection(mode="client", connect=(endpoint,), listen=())
    token = None if token_file is None else str(token_file)
    options = DashboardOptions(
        f"{listen}:{port}", token, zenoh, NAME, language or LanguageSection(), hosts=hosts
    )
    ready = asyncio.Event()
    running = asyncio.create_task(serve(options, lambda _url: ready.set(), "--listen"))
    starting = asyncio.create_task(ready.wait())
    await asyncio.wait({running, starting}, return_when=asyncio.FIRST_COMPLETED)
    if running.done():
        starting.cancel()
        running.result()
    try:
        yield port
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def request(
    port: int, method: str, path: str, headers: dict[str, str] | None = None, body: Any = None
) -> tuple[int, http.client.HTTPMessage, bytes]:
    """Send a request from a thread; returns status, headers and body."""

    def send() -> tuple[int, http.client.HTTPMessage, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        try:
            data = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
            connection.request(method, path, body=data, headers=headers or {})
            response = connection.getresponse()
            return response.status, response.headers, response.read()
        finally:
            connection.close()

    return await asyncio.to_thread(send)


@contextmanager
def dashboard_here(endpoint: str) -> Iterator[str]:
    """`serving` in a thread; yields the page's address."""
    with start_blocking_portal() as portal, portal.wrap_async_context_manager(serving(endpoint)) as port:
        yield f"http://127.0.0.1:{port}/"


@contextmanager
def dashboard_command(endpoint: str, cwd: Path | None = None) -> Iterator[str]:
    """Run `companion view`; yields the page's address. It is ended by Ctrl-C, with exit code 0."""
    command = [
        "view",
        "--connect",
        endpoint,
        "--dashboard-listen",
        f"127.0.0.1:{free_port(socket.SOCK_STREAM)}",
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "companion.cli", *command],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    running = ServiceProcess(process, endpoint)
    try:
        line = running.wait_for_line("http://", 60.0)
        yield line[line.index("http://") :].strip()
        running.signal(signal.SIGINT)
        assert process.wait(15) == 0
    finally:
        running.stop()
        assert process.stdout is not None
        process.stdout.close()


class EventStream:
    """An open stream of the page's state."""

    def __init__(self, port: int, query: str, headers: dict[str, str]) -> None:
        self.connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        self.connection.request("GET", f"/events{query}", headers=headers)
        self.response = self.connection.getresponse()

    @classmethod
    async def open(cls, port: int, query: str = "", headers: dict[str, str] | None = None) -> EventStream:
        return await asyncio.to_thread(cls, port, query, headers or {})

    async def next(self) -> dict[str, Any] | None:
        """Return the next event's data; None at the end of the stream."""

        def read() -> dict[str, Any] | None:
            while line := self.response.readline():
                if line.startswith(b"data: "):
                    value: dict[str, Any] = json.loads(line[6:])
                    return value
            return None

        return await asyncio.to_thread(read)

    def close(self) -> None:
        self.response.close()
        self.connection.close()
