"""The lines that were typed in consoles, kept for the next ones: `$XDG_STATE_HOME/companion/console_history`.

All consoles of a user share the file. Each line is appended by one write, so none is broken by another's.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Sequence
from pathlib import Path

from vision.home import home_folder
from vision.redaction import redacted

KEPT_LINES = 1000
_LONGEST_FILE = 256 * 1024  # bytes; then it is shortened to the newest lines


def history_file() -> Path:
    """Return the file, by the XDG Base Directory Specification: a relative path there is ignored."""
    state = Path(os.environ.get("XDG_STATE_HOME") or "")
    return (state if state.is_absolute() else home_folder() / ".local/state") / "companion/console_history"


class CommandHistory:
    """The newest lines of the file. Its methods read and write: not for an asyncio loop.

    Where the file cannot be used, the lines are those of this console alone.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._own: list[str] = []

    def lines(self) -> Sequence[str]:
        """Return the lines, the oldest first, of other consoles too; one that was repeated only once."""
        try:
            with open(self._path, "rb") as file:
                # A first line that is cut would be another command.
                if (begin := os.fstat(file.fileno()).st_size - _LONGEST_FILE) > 0:
                    file.seek(begin)
                    file.readline()
                text = file.read().decode(errors="replace")
            lines = [line for line in text.split("\n")[:-1] if line.isprintable()]
        except OSError:
            lines = self._own
        newest = [line for line, after in zip(lines, [*lines[1:], ""], strict=False) if line != after]
        return newest[-KEPT_LINES:]

    def add(self, line: str) -> None:
        """Append a line, without secrets. Raises OSError: it is kept by this console alone."""
        line = redacted(line)
        self._own = [*self._own, line][-KEPT_LINES:]
        self._check_owner()
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK
        descriptor = os.open(self._path, flags, 0o600)
        try:
            about = os.fstat(descriptor)
            if stat.S_ISREG(about.st_mode) and stat.S_IMODE(about.st_mode) != 0o600:
                os.fchmod(descriptor, 0o600)
            os.write(descriptor, f"{line}\n".encode(errors="replace"))
        finally:
            os.close(descriptor)
        if about.st_size > _LONGEST_FILE:
            self._shorten()

    def _check_owner(self) -> None:
        """Raise PermissionError for root in a place of another user, who could lead it elsewhere by a link.

        So `sudo -E` leaves no file of root there either, which the user's own console could not write.
        """
        if os.geteuid() != 0:  # the kernel guards other users; in a user namespace `/` belongs to nobody
            return
        for each in (self._path, *self._path.parents):
            with contextlib.suppress(FileNotFoundError):
                if each.lstat().st_uid != 0:
                    raise PermissionError(errno.EPERM, "belongs to another user", str(each))

    def _shorten(self) -> None:
        """Keep the newest lines. One that another console adds at this moment may be lost."""
        lines = self.lines()[-KEPT_LINES // 2 :]
        shorter = self._path.with_name(f"{self._path.name}.{os.getpid()}")
        with open(os.open(shorter, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write("".join(f"{line}\n" for line in lines).encode(errors="replace"))
        shorter.replace(self._path)
