"""Faults from the simulator's console: one line of the grammar each, answered by one or more lines.

The simulator's loop polls the descriptor, so it never blocks. It is not read while the program is in a
terminal's background, where reading would stop the process.
"""

from __future__ import annotations

import contextlib
import os
import selectors
from collections.abc import Callable

from mavlink_sim.faults.schedule import Outcome

LONGEST_LINE_BYTES = 4096


class FaultConsole:
    """Passes lines from a descriptor (a terminal, a pipe, a file) to a vehicle's faults.

    Args:
        descriptor: to read; usually 0.
        command: executes one line.
        report: prints one line of an answer.
    """

    def __init__(
        self, descriptor: int, command: Callable[[str], Outcome], report: Callable[[str], None]
    ) -> None:
        self._descriptor = descriptor
        self._command = command
        self._report = report
        self._partial = b""
        self._open = True
        self._selector = selectors.DefaultSelector()
        self._always_ready = False
        try:
            self._selector.register(descriptor, selectors.EVENT_READ)
        except PermissionError:
            self._always_ready = True  # a regular file: readable without polling

    def poll(self) -> None:
        """Execute the lines received since the last call."""
        if not self._open or not (self._always_ready or self._selector.select(0)):
            return
        if in_background(self._descriptor):
            return
        try:
            data = os.read(self._descriptor, LONGEST_LINE_BYTES)
        except BlockingIOError:
            return
        except OSError:  # the terminal was closed
            data = b""
        if not data:
            self._open = False
        lines = (self._partial + data).split(b"\n")
        self._partial = lines.pop()[:LONGEST_LINE_BYTES]
        if not self._open and self._partial:
            lines.append(self._partial)
        for line in lines:
            text = line.decode(errors="replace").strip()
            if text and not text.startswith("#"):
                self._answer(self._command(text))

    def _answer(self, outcome: Outcome) -> None:
        for line in outcome.text.splitlines():
            self._report(line if outcome.ok else f"not done: {line}")

    def close(self) -> None:
        """Stop reading. The descriptor stays open: its owner closes it."""
        self._open = False
        self._selector.close()


def in_background(descriptor: int) -> bool:
    """Whether the descriptor is a terminal whose foreground belongs to another program."""
    with contextlib.suppress(OSError):
        return os.tcgetpgrp(descriptor) != os.getpgrp()
    return False
