"""The worker's way out: a thread that sends, so that the loop never waits for a service that reads slowly.

Of results and heartbeats only the newest waits; an older one is replaced and counted, but what it told of
tracks that began, got lost or ended goes with the newer. Everything else waits in a queue, bounded too.
"""

from __future__ import annotations

import logging
import socket
import threading
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from companion.perception.messages import (
    Ended,
    Heartbeat,
    LogLine,
    Message,
    Preview,
    Report,
    StartFailed,
    packed,
)
from vision.tracking import TrackEventKind

_QUEUED_LINES = 1000
_LONGEST_LINE = 2000
# A service that has not read for so many is no more; what it would be told is not worth all memory.
_WAITING_EVENTS = 1000


class Outbox:
    """Sends messages over `connection` in a thread of its own. Its methods never block, but `close`.

    Args:
        on_lost: called once, in that thread, when the other end is gone.
    """

    def __init__(self, connection: socket.socket, on_lost: Callable[[], None]) -> None:
        self._connection = connection
        self._on_lost = on_lost
        self._changed = threading.Condition()
        self._queue: deque[Message] = deque(maxlen=_QUEUED_LINES)
        self._newest: Report | Heartbeat | None = None
        self._preview: Preview | None = None
        self._replaced = 0
        self._last: Message | None = None
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def put(self, message: Message) -> None:
        """Send this, in order with the others of its kind."""
        with self._changed:
            self._queue.append(message)
            self._changed.notify()

    def put_newest(self, message: Report | Heartbeat) -> None:
        """Send this unless a newer one comes before it can be sent. A heartbeat never replaces a result."""
        with self._changed:
            if isinstance(self._newest, Report):
                if isinstance(message, Heartbeat):
                    return
                self._replaced += 1
                message = _with_events_of(self._newest, message)
            self._newest = message
            self._changed.notify()

    def put_preview(self, preview: Preview) -> None:
        """Send this when nothing else waits, unless a newer one comes before."""
        with self._changed:
            self._preview = preview
            self._changed.notify()

    def close(self, last: Ended | StartFailed, timeout_s: float) -> None:
        """Send what waits and then `last`, for at most `timeout_s`."""
        with self._changed:
            self._last = last
            self._changed.notify()
        self._thread.join(timeout_s)

    def _next(self) -> Message:
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._newest or self._preview or self._last)
            if self._queue:
                return self._queue.popleft()
            newest, self._newest = self._newest, None
            if isinstance(newest, Report):
                return replace(newest, replaced=self._replaced)
            if newest is not None:
                return newest
            if self._last is not None:
                return self._last
            preview, self._preview = self._preview, None
            assert preview is not None
            return preview

    def _run(self) -> None:
        try:
            message = self._next()
            while True:
                self._connection.sendall(packed(message))
                if isinstance(message, Ended | StartFailed):
                    return
                message = self._next()
        except OSError:
            self._on_lost()


def _with_events_of(older: Report, newer: Report) -> Report:
    """The newer report, with the events of the older that are told once only."""
    once = tuple(event for event in older.result.track_events if event.kind is not TrackEventKind.UPDATE)
    if not once:
        return newer
    events = (once + newer.result.track_events)[-_WAITING_EVENTS:]
    return replace(newer, result=replace(newer.result, track_events=events))


class OutboxHandler(logging.Handler):
    """Log records as lines to the service; a traceback stays on the worker's standard error."""

    def __init__(self, outbox: Outbox) -> None:
        super().__init__()
        self._outbox = outbox

    def emit(self, record: logging.LogRecord) -> None:
        try:
            text = " ".join(record.getMessage().split())[:_LONGEST_LINE]
            self._outbox.put(LogLine(record.levelno, record.name, text))
            if record.exc_info:
                traceback.print_exception(record.exc_info[1])
        except Exception:  # a bad log call must not end perception; logging shows it on standard error
            self.handleError(record)
