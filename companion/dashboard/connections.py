"""The connections of an HTTP server: what unknown clients hold open takes nothing from those who may command.

A connection is unknown until a request of it has passed the access rules. Unknown ones, bodies that have
not arrived, and connections that wait for their next request each have a limit of their own. There the oldest
is closed, so that a new one always has its turn. Requests that are being answered have a limit too, but not
those by POST: `stop` is one of them, and they are short.
"""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

import h11
from starlette.types import Scope
from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

REQUEST_S = 5.0
"""A request whose head and body have not arrived after this is closed."""
MAX_UNKNOWN = MAX_IDLE = MAX_UNREAD = 64
MAX_ANSWERED = 100
"""Requests that are being answered, most of them streams."""
_KEY = "connection"


class ConnectionTable:
    """The connections of one server by their state. The first of each is the oldest."""

    def __init__(self) -> None:
        self._unknown: dict[Connection, None] = {}
        self._idle: dict[Connection, None] = {}
        self._unread: dict[Connection, None] = {}
        self._answered: set[Connection] = set()

    def open(self, connection: Connection) -> None:
        """Add a new connection, an unknown one."""
        _add(self._unknown, connection, MAX_UNKNOWN)

    def admit(self, connection: Connection, *, short: bool) -> bool:
        """Begin a request that passed the access rules; False: too many are being answered.

        Args:
            short: it is answered soon, and always begun.
        """
        if not short and len(self._answered) >= MAX_ANSWERED:
            return False
        self._forget(connection)
        self._answered.add(connection)
        if not connection.whole:
            _add(self._unread, connection, MAX_UNREAD)
        return True

    def read(self, connection: Connection) -> None:
        """Note that the whole request has arrived."""
        self._unread.pop(connection, None)

    def end(self, connection: Connection) -> None:
        """End a request that `admit` has begun."""
        if connection in self._answered:
            self._forget(connection)
            _add(self._idle, connection, MAX_IDLE)

    def close(self, connection: Connection) -> None:
        """Forget a closed connection."""
        self._forget(connection)

    def _forget(self, connection: Connection) -> None:
        for part in (self._unknown, self._idle, self._unread):
            part.pop(connection, None)
        self._answered.discard(connection)


def _add(part: dict[Connection, None], connection: Connection, limit: int) -> None:
    part[connection] = None
    if len(part) > limit:
        oldest = next(iter(part))
        del part[oldest]
        oldest.transport.abort()


class Connection(H11Protocol):
    """A connection with a deadline for each whole request."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
        *,
        table: ConnectionTable,
    ) -> None:
        super().__init__(config, server_state, {**app_state, _KEY: self}, _loop)
        self.table = table
        self._deadline: asyncio.TimerHandle | None = None

    @property
    def whole(self) -> bool:
        """Whether the head and the body of the request have arrived."""
        return self.conn.their_state not in (h11.IDLE, h11.SEND_BODY)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.table.open(self)
        self._watch_request()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch_request()

    def connection_lost(self, exc: Exception | None) -> None:
        self._end_deadline()
        self.table.close(self)
        super().connection_lost(exc)

    def _watch_request(self) -> None:
        if self.whole:
            self._end_deadline()
            self.table.read(self)
        elif self._deadline is None:
            self._deadline = self.loop.call_later(REQUEST_S, self.transport.abort)

    def _end_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


def connection_class() -> Any:
    """Return what uvicorn makes the connections of one server with."""
    return partial(Connection, table=ConnectionTable())


def connection_of(scope: Scope) -> Connection:
    """Return the connection of a request."""
    connection: Connection = scope["state"][_KEY]
    return connection
