"""A standard error that never blocks the program.

A pipe holds 64 KiB, then a write waits for its reader; a terminal stopped with Ctrl-S holds less. So lines
are queued, and one thread writes them, above the line that is being typed. In systemd's journal a line
without a priority, such as one of a traceback, is an error.
"""

from __future__ import annotations

import atexit
import io
import logging
import os
import select
import sys
import threading
import time
from collections import deque

from companion.host.journal import is_journal, marked

QUEUED_BYTES = 256 * 1024
"""Capacity of the queue; further lines are dropped and counted."""
EXIT_TIMEOUT_S = 1.0
LONGEST_LINE = 16 * 1024
"""Characters; a longer text without a line end is written as a line."""
# Size of one write: with a slow reader, the queue empties in small steps.
_WRITE_BYTES = 4096
# ECMA-48: to the first column, and erase to the end of the line.
_ERASE = b"\r\x1b[K"


class LineOutput(io.TextIOBase):
    """A text stream with a queue. Thread-safe; a write never waits.

    Args:
        descriptor: the output; it stays open.
        capacity_bytes: of the queue.

    Attributes:
        dropped: lines not written: the queue was full, or the descriptor refused them.
        queued_bytes: bytes in the queue.
    """

    def __init__(self, descriptor: int, capacity_bytes: int = QUEUED_BYTES) -> None:
        self.dropped = 0
        self._descriptor, self._capacity_bytes = descriptor, capacity_bytes
        self._changed = threading.Condition()
        self._lines: deque[bytes] = deque()
        self.queued_bytes = self._unreported = 0
        self._partial = ""
        self._prompt = self._drawn = b""
        self._to_journal = is_journal(descriptor)
        self._writing = self._ended = False
        self._thread = threading.Thread(target=self._run, name="line output", daemon=True)
        self._thread.start()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """UTF-8; characters that cannot be encoded are escaped."""
        return "utf-8"

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def write(self, text: str) -> int:
        """Queue the complete lines in `text` and keep the rest. Never waits, never fails."""
        with self._changed:
            *lines, partial = (self._partial + text).split("\n")
            if len(partial) > LONGEST_LINE:
                lines, partial = [*lines, partial], ""
            self._partial = partial
            for line in lines:
                self._put(line)
            self._changed.notify_all()
        return len(text)

    def print(self, line: str) -> None:
        """Queue one line."""
        self.write(f"{line}\n")

    def show(self, prompt: str) -> None:
        """Keep a text of one row below the lines, from now on; empty: none. Never waits.

        Only the newest is drawn, however slow the terminal is. Control sequences may move the cursor in it.
        """
        with self._changed:
            self._prompt = prompt.encode("utf-8", "backslashreplace")
            self._changed.notify_all()

    def redraw(self) -> None:
        """Draw the text below the lines again: something else has written to the terminal."""
        with self._changed:
            self._drawn = b""
            self._changed.notify_all()

    def _put(self, line: str) -> None:
        text = marked(line, logging.ERROR) if self._to_journal else line
        data = f"{text}\n".encode("utf-8", "backslashreplace")
        if self._ended or self.queued_bytes + len(data) > self._capacity_bytes:
            self._drop(1)
            return
        self._lines.append(data)
        self.queued_bytes += len(data)

    def _drop(self, count: int) -> None:
        self.dropped += count
        self._unreported += count

    def end(self, timeout_s: float = EXIT_TIMEOUT_S) -> bool:
        """Write the queued lines within `timeout_s`; returns whether all were written.

        Later writes are dropped.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            if self._partial:
                self._put(self._partial)
                self._partial = ""
            self._ended, self._prompt = True, b""
            self._changed.notify_all()
            while self._unwritten and (left_s := deadline_s - time.monotonic()) > 0:
                self._changed.wait(left_s)
            return not self._unwritten

    @property
    def _unwritten(self) -> bool:
        return bool(self._lines or self._drawn or self._writing)

    def _run(self) -> None:
        written = True
        while (data := self._next(report=written)) is not None:
            written = self._written(data)
            if not written:
                with self._changed:
                    self._drop(1)

    def _next(self, *, report: bool) -> bytes | None:
        """Wait for a line or a prompt; None at the end. `report`: report dropped lines after the last one."""
        with self._changed:
            self._writing = False
            self._changed.notify_all()
            while not self._lines:
                if self._prompt != self._drawn and not (self._unreported and report):
                    self._drawn, self._writing = self._prompt, True
                    return _ERASE + self._prompt
                if self._unreported and report:
                    count, self._unreported = self._unreported, 0
                    self._writing = True
                    text = f"companion: {count} lines dropped: the output was not read"
                    return self._above(
                        f"{marked(text, logging.WARNING) if self._to_journal else text}\n".encode()
                    )
                if self._ended:
                    return None
                self._changed.wait()
            data = self._lines.popleft()
            self.queued_bytes -= len(data)
            self._writing = True
            return self._above(data)

    def _above(self, line: bytes) -> bytes:
        """Return what writes a line where the prompt is; the prompt is drawn again after the last line."""
        drawn, self._drawn = self._drawn, b""
        return _ERASE + line if drawn else line

    def _written(self, data: bytes) -> bool:
        while data:
            try:
                data = data[os.write(self._descriptor, data[:_WRITE_BYTES]) :]
            except BlockingIOError:  # another process has made it non-blocking
                select.select([], [self._descriptor], [])
            except OSError:  # its reader has gone, or the disk is full
                return False
        return True


def use_for_standard_error() -> LineOutput | None:
    """Replace standard error by a `LineOutput`.

    The exit of the program waits for the reader a second at most. Returns the one that is in use, if any;
    None, and changes nothing, if standard error has no descriptor.
    """
    if isinstance(sys.stderr, LineOutput):
        return sys.stderr
    try:
        descriptor = sys.stderr.fileno()
    except (AttributeError, OSError):  # closed, or a buffer in a test
        return None
    sys.stderr.flush()
    output = LineOutput(descriptor)
    sys.stderr = output
    atexit.register(output.end)
    return output
