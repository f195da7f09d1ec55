"""The worker's way out, so that the loop never waits for a service that reads slowly.

A result leaves at once, from the thread that found it: to wake another for it takes longer than to send it.
What the socket does not take at once, and everything else, a thread of its own sends.

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


class ResultSender:
    """Sends messages over `connection`. Its methods never block, but `close`.

    Args:
        connection: loses its time-out.
        on_lost: called once, in a thread of its own, when the other end is gone.
    """

    def __init__(self, connection: socket.socket, on_lost: Callable[[], None]) -> None:
        connection.settimeout(None)  # with one, Python waits for the socket whatever MSG_DONTWAIT says
        self._connection = connection
        self._on_lost = on_lost
        self._changed = threading.Condition()
        self._queue: deque[Message] = deque(maxlen=_QUEUED_LINES)
        self._newest: Report | Heartbeat | None = None
        self._preview: Preview | None = None
        self._replaced = 0
        self._last: Message | None = None
        self._busy = False
        self._rest = b""
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def put(self, message: Message) -> None:
        """Send this, in order with the others of its kind."""
        with self._changed:
            self._queue.append(message)
            self._changed.notify()

    def put_newest(self, message: Report | Heartbeat) -> None:
        """Send this now, or as soon as it can be, unless a newer one comes before.

        A heartbeat never replaces a result.
        """
        with self._changed:
            if isinstance(self._newest, Report):
                if isinstance(message, Heartbeat):
                    return
                self._replaced += 1
                message = _with_events_of(self._newest, message)
            self._newest = message
            if not self._send_newest():
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

    def _send_newest(self) -> bool:
        """From the thread that calls, if nothing else is under way; False leaves something to the other."""
        if self._busy or self._rest or self._queue or self._last:
            return False
        message = self._take_newest()
        data = packed(message)
        try:
            sent = self._connection.send(data, socket.MSG_DONTWAIT)
        except OSError:  # full, or the other end is gone: the thread waits for it, or finds out
            self._newest = message
            return False
        self._rest = data[sent:]
        return not self._rest

    def _take_newest(self) -> Report | Heartbeat:
        newest, self._newest = self._newest, None
        assert newest is not None
        return replace(newest, replaced=self._replaced) if isinstance(newest, Report) else newest

    def _next(self) -> Message | bytes:
        """What the thread sends now: a message, or the rest of one."""
        with self._changed:
            self._busy = False
            self._changed.wait_for(
                lambda: self._rest or self._queue or self._newest or self._preview or self._last
            )
            self._busy = True
            if self._rest:
                rest, self._rest = self._rest, b""
                return rest
            if self._queue:
                return self._queue.popleft()
            if self._newest is not None:
                return self._take_newest()
            if self._last is not None:
                return self._last
            preview, self._preview = self._preview, None
            assert preview is not None
            return preview

    def _run(self) -> None:
        try:
            message: Message | bytes = b""
            while not isinstance(message, Ended | StartFailed):
                message = self._next()
                self._connection.sendall(message if isinstance(message, bytes) else packed(message))
        except OSError:
            self._on_lost()


def _with_events_of(older: Report, newer: Report) -> Report:
    """The newer report, with the events of the older that are told once only."""
    once = tuple(event for event in older.result.track_events if event.kind is not TrackEventKind.UPDATE)
    if not once:
        return newer
    events = (once + newer.result.track_events)[-_WAITING_EVENTS:]
    return replace(newer, result=replace(newer.result, track_events=events))


class ResultLogHandler(logging.Handler):
    """Log records as lines to the service; a traceback stays on the worker's standard error."""

    def __init__(self, sender: ResultSender) -> None:
        super().__init__()
        self._outbox = sender

    def emit(self, record: logging.LogRecord) -> None:
        try:
            text = " ".join(record.getMessage().split())[:_LONGEST_LINE]
            self._outbox.put(LogLine(record.levelno, record.name, text))
            if record.exc_info:
                traceback.print_exception(record.exc_info[1])
        except Exception:  # a bad log call must not end perception; logging shows it on standard error
            self.handleError(record)
