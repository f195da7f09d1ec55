"""A program at a terminal of its own, and what a person sees there."""

from __future__ import annotations

import fcntl
import os
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

ROWS, COLUMNS = 50, 100
UP, LEFT, CTRL_C, CTRL_D = "\x1b[A", "\x1b[D", "\x03", "\x04"

_TOKEN = re.compile(r"\x1b\[(\d*)([A-Za-z])|\r|\n|\x1b|[^\x1b\r\n]")


def screen(text: str) -> list[str]:
    """The rows after an output: of the control sequences, those that the console uses."""
    rows, row, column = [""], 0, 0
    for found in _TOKEN.finditer(text):
        match found[0], found[2]:
            case "\r", _:
                column = 0
            case "\n", _:
                row += 1
                rows += [""] * (row == len(rows))
            case _, "K":
                rows[row] = rows[row][:column]
            case _, "D":
                column -= int(found[1])
            case character, _:
                rows[row] = rows[row][:column].ljust(column) + character + rows[row][column + 1 :]
                column += 1
    return rows


class TerminalProcess:
    """A program whose controlling terminal this is. It is the terminal's session, as in a window."""

    def __init__(self, command: Sequence[str], cwd: Path, environment: dict[str, str]) -> None:
        self._ours, theirs = os.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        self.process = subprocess.Popen(
            command,
            cwd=cwd,
            env={**os.environ, "TERM": "xterm", **environment},
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )
        self._theirs = theirs
        self._output, self._changed = "", threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        with suppress(OSError):
            while data := os.read(self._ours, 65536):
                with self._changed:
                    self._output += data.decode(errors="replace")
                    self._changed.notify_all()

    @property
    def rows(self) -> list[str]:
        """What the terminal shows, without the rows' ends of spaces."""
        return [row.rstrip() for row in screen(self._output)]

    @property
    def edits(self) -> bool:
        """Whether the terminal itself edits lines, as it does for a shell's programs."""
        return bool(termios.tcgetattr(self._theirs)[3] & termios.ICANON)

    def type(self, keys: str) -> None:
        """Type these keys."""
        os.write(self._ours, keys.encode())

    def until(self, shown: Callable[[list[str]], object], timeout_s: float = 20.0) -> list[str]:
        """Wait until the rows are so; returns them."""
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while not shown(rows := self.rows):
                if not self._changed.wait(deadline_s - time.monotonic()):
                    raise TimeoutError("\n".join(["the terminal shows:", *rows]))
            return rows

    def until_row(self, text: str, timeout_s: float = 20.0) -> str:
        """Wait for a row with a text; returns the newest."""
        rows = self.until(lambda rows: any(text in row for row in rows), timeout_s)
        return next(row for row in reversed(rows) if text in row)

    def until_typed(self, line: str) -> None:
        """Wait until the last row is the prompt with this line."""
        self.until(lambda rows: rows[-1] == f"> {line}".rstrip())

    def close(self) -> None:
        """End the program and the terminal."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
            try:
                self.process.wait(30)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        os.close(self._theirs)
        self._reader.join(5)
        os.close(self._ours)


@contextmanager
def at_terminal(
    *words: str, cwd: Path, environment: dict[str, str] | None = None, program: Sequence[str] = ()
) -> Iterator[TerminalProcess]:
    """`companion` with these words at a terminal. `program`: the interpreter's words instead of it."""
    command = [sys.executable, *(program or ("-m", "companion.cli")), *words]
    running = TerminalProcess(command, cwd, environment or {})
    try:
        yield running
    except BaseException as error:  # a test's timeout is not an Exception
        error.add_note("\n".join(["the terminal:", *running.rows]))
        raise
    finally:
        running.close()
