"""Events by HTTP POST, retried; a server that hangs delays no other."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable
from typing import NoReturn

import httpx

from vision.redaction import redacted

MOST_EVENTS, MOST_BYTES = 100, 16 * 1024 * 1024
_TIMEOUT_S = 10.0
_PAUSES_S = (1.0, 5.0, 25.0)
_SAY_INTERVAL_S = 10.0
_TOO_MANY_REQUESTS, _SERVER_ERROR = 429, 500


class Webhook:
    """Posts JSON to one address, in order. Everything is called in the asyncio loop.

    An event is posted up to four times, with one `Idempotency-Key`. Another status than 2xx, 429 and 5xx is
    final. Of events that wait the oldest are left out, and counted.

    Args:
        say: called with a line, at most every 10 s.
    """

    def __init__(self, url: str, say: Callable[[str], None], pauses_s: tuple[float, ...] = _PAUSES_S) -> None:
        self._url, self._say, self._pauses_s = url, say, pauses_s
        self._events: deque[tuple[str, bytes]] = deque()
        self._waiting = asyncio.Event()
        self._left_out, self._said_s = 0, -_SAY_INTERVAL_S

    def put(self, event_id: str, body: bytes) -> None:
        """Post an event as soon as possible."""
        self._events.append((event_id, body))
        while len(self._events) > MOST_EVENTS or sum(len(each) for _, each in self._events) > MOST_BYTES:
            self._events.popleft()
            self._lose("it answers too slowly")
        self._waiting.set()

    async def run(self) -> NoReturn:
        """Post until cancelled."""
        async with httpx.AsyncClient(timeout=_TIMEOUT_S, follow_redirects=False) as client:
            while True:
                await self._waiting.wait()
                self._waiting.clear()
                while self._events:
                    await self._post(client, *self._events.popleft())

    async def _post(self, client: httpx.AsyncClient, event_id: str, body: bytes) -> None:
        headers = {"content-type": "application/json", "idempotency-key": event_id}
        for pause_s in (*self._pauses_s, None):
            try:
                # httpx has time-outs of single reads: this one is of the whole exchange.
                async with asyncio.timeout(_TIMEOUT_S):
                    async with client.stream("POST", self._url, content=body, headers=headers) as answer:
                        status = answer.status_code
                why, again = f"status {status}", status == _TOO_MANY_REQUESTS or status >= _SERVER_ERROR
                if answer.is_success:
                    return
            except TimeoutError:
                why, again = f"no answer within {_TIMEOUT_S:g} s", True
            except httpx.HTTPError as error:
                why, again = str(error) or type(error).__name__, True
            if not again or pause_s is None:
                self._lose(why)
                return
            await asyncio.sleep(pause_s)

    def _lose(self, why: str) -> None:
        self._left_out += 1
        if time.monotonic() - self._said_s >= _SAY_INTERVAL_S:
            self._say(f"webhook {redacted(self._url)}: {self._left_out} events not delivered: {why}")
            self._said_s, self._left_out = time.monotonic(), 0
