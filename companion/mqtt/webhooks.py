"""Events by HTTP POST, retried; a server that hangs delays no other."""

from __future__ import annotations

import asyncio
import math
import os
import socket
import ssl
import time
from collections import deque
from collections.abc import Callable
from typing import NoReturn

import httpx

from vision.redaction import redacted

MOST_EVENTS, MOST_BYTES = 100, 16 * 1024 * 1024
_TIMEOUT_S = 10.0
_PAUSES_S = (1.0, 5.0, 25.0)
_SAY_INTERVAL_S, _OTHER_FAULT_S = 600.0, 10.0
# So long without a failure, and a fault has ended.
_CALM_S = 10.0
_TOO_MANY_REQUESTS, _SERVER_ERROR = 429, 500


class Webhook:
    """Posts JSON to one address, in order. Everything is called in the asyncio loop.

    An event is posted up to four times, with one `Idempotency-Key`. Another status than 2xx, 429 and 5xx is
    final. Of events that wait the oldest are left out, and counted.

    Args:
        say: called with a line when a third attempt has failed or events were lost, every 10 minutes while
            that goes on, and when all that waited was posted.
    """

    def __init__(self, url: str, say: Callable[[str], None], pauses_s: tuple[float, ...] = _PAUSES_S) -> None:
        self._url, self._say, self._pauses_s = url, say, pauses_s
        self._events: deque[tuple[str, bytes]] = deque()
        self._waiting = asyncio.Event()
        self._fault, self._lost = "", 0  # that was said; events lost since
        self._said_s = self._failed_s = -math.inf

    def put(self, event_id: str, body: bytes) -> None:
        """Post an event as soon as possible."""
        self._events.append((event_id, body))
        while len(self._events) > MOST_EVENTS or sum(len(each) for _, each in self._events) > MOST_BYTES:
            self._events.popleft()
            self._lose(self._fault or "it answers too slowly")
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
        for number, pause_s in enumerate((*self._pauses_s, None)):
            try:
                # httpx has time-outs of single reads: this one is of the whole exchange.
                async with asyncio.timeout(_TIMEOUT_S):
                    async with client.stream("POST", self._url, content=body, headers=headers) as answer:
                        status = answer.status_code
                why, again = f"status {status}", status == _TOO_MANY_REQUESTS or status >= _SERVER_ERROR
                if answer.is_success:
                    self._recovered()
                    return
            except TimeoutError:
                why, again = f"no answer within {_TIMEOUT_S:g} s", True
            except httpx.HTTPError as error:
                why, again = _reason(error), True
            if not again or pause_s is None:
                self._lose(why)
                return
            self._failed_s = time.monotonic()
            if number == len(self._pauses_s) - 1:  # it lasts
                self._note(f"{why}; retrying", why)
            await asyncio.sleep(pause_s)

    def _lose(self, why: str) -> None:
        self._lost += 1
        self._failed_s = time.monotonic()
        self._note(f"{why}; {self._lost} events were not delivered", why)

    def _note(self, text: str, why: str) -> None:
        now_s = time.monotonic()
        if now_s - self._said_s >= (_SAY_INTERVAL_S if why == self._fault else _OTHER_FAULT_S):
            self._fault, self._said_s = why, now_s
            self._say(f"webhook {redacted(self._url)}: {text}")

    def _recovered(self) -> None:
        now_s = time.monotonic()
        if self._fault and not self._events and now_s - self._failed_s >= _CALM_S:
            self._say(f"webhook {redacted(self._url)}: posting again; {self._lost} events were not delivered")
            self._fault, self._lost, self._said_s = "", 0, now_s


def _reason(error: httpx.HTTPError) -> str:
    """Return what the operating system says, which httpx hides in the causes of its error."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno is not None and cause.strerror:
            return (
                cause.strerror
                if isinstance(cause, (socket.gaierror, ssl.SSLError))
                else os.strerror(cause.errno)
            )
        cause = cause.__cause__ or cause.__context__
    return str(error) or type(error).__name__
