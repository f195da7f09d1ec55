"""Sends the worker's messages without ever blocking its loop on a slow service.

A result is sent at once from the thread that produced it: waking another thread takes longer than sending it.
What the socket does not accept at once, and everything else, is sent by a separate thread.

Of results and heartbeats only the newest waits; an older one is replaced and counted, but its track events
(new, lost, end) are merged into the newer one. Everything else waits in a bounded queue.
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
# Limit of merged track events, which bounds the memory if the service does not read.
_WAITING_EVENTS = 1000


class ResultSender:
    """Sends messages over `connection`. Only `close` blocks.

    Args:
        connection: its timeout is removed.
        on_lost: called once, in the sender's thread, when the other end is gone.
    """

    def __init__(self, connection: socket.socket, on_lost: Callable[[], None]) -> None:
        connection.settimeout(None)  # with a timeout, Python ignores MSG_DONTWAIT and waits
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
        self._thread = threading.Thread(target=self._run, name="perception sender", daemon=True)
        self._thread.start()

    def put(self, message: Message) -> None:
        """Send a message, in order with the others of its kind."""
        with self._changed:
            self._queue.append(message)
            self._changed.notify()

    def put_newest(self, message: Report | Heartbeat) -> None:
        """Send a message now, or as soon as possible unless a newer one replaces it.

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
        """Send a preview when nothing else waits, unless a newer one replaces it."""
        with self._changed:
            self._preview = preview
            self._changed.notify()

    def close(self, last: Ended | StartFailed, timeout_s: float) -> None:
        """Send the queued messages and then `last`, for at most `timeout_s`."""
        with self._changed:
            self._last = last
            self._changed.notify()
        self._thread.join(timeout_s)

    def _send_newest(self) -> bool:
        """Send from the calling thread if nothing else is in progress; False if the sender's thread must."""
        if self._busy or self._rest or self._queue or self._last:
            return False
        message = self._take_newest()
        data = packed(message)
        try:
            sent = self._connection.send(data, socket.MSG_DONTWAIT)
        except OSError:  # full, or the other end is gone: left to the sender's thread
            self._newest = message
            return False
        self._rest = data[sent:]
        return not self._rest

    def _take_newest(self) -> Report | Heartbeat:
        newest, self._newest = self._newest, None
        assert newest is not None
        return replace(newest, replaced=self._replaced) if isinstance(newest, Report) else newest

    def _next(self) -> Message | bytes:
        """Wait for what to send next: a message, or the rest of one."""
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
    """Return the newer report with the older one's events, except updates."""
    once = tuple(event for event in older.result.track_events if event.kind is not TrackEventKind.UPDATE)
    if not once:
        return newer
    events = (once + newer.result.track_events)[-_WAITING_EVENTS:]
    return replace(newer, result=replace(newer.result, track_events=events))


class ResultLogHandler(logging.Handler):
    """Sends log records to the service; a traceback goes only to the worker's standard error."""

    def __init__(self, sender: ResultSender) -> None:
        super().__init__()
        self._sender = sender

    def emit(self, record: logging.LogRecord) -> None:
        try:
            text = " ".join(record.getMessage().split())[:_LONGEST_LINE]
            self._sender.put(LogLine(record.levelno, record.name, text))
            if record.exc_info:
                traceback.print_exception(record.exc_info[1])
        except Exception:  # a bad log call must not end perception; logging prints it to standard error
            self.handleError(record)
