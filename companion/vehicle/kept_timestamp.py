"""The newest timestamp of signatures, kept in a file over a restart.

A receiver refuses what is older than what it has seen, and a board without a clock starts in 1970. The
specification asks for a timestamp in persistent storage, at least once a minute
(https://mavlink.io/en/guide/message_signing.html, timestamp handling).

The file has a timestamp that is not reached yet. So a program that is killed has used none after it, and a
start goes on from there. In steady use it is written once a minute.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import tempfile
import threading
import time
from pathlib import Path

logger = logging.getLogger(__name__)

EPOCH_S = 1_420_070_400  # 2015-01-01, from which signatures count time in units of 10 us
ONE_MINUTE = 6_000_000
LATEST = 85 * 365 * 1440 * ONE_MINUTE
"""What is later, from about 2100 on, is damage: timestamps have 48 bits, and none may follow the last one."""
FILE_NAME = "signing-timestamp"
# What is written is later than the newest timestamp by no more than the minute that receivers allow.
_AHEAD = ONE_MINUTE
_LEAD = 500_000  # 5 s for writing, before the file's timestamp is reached
_FAR = 1440 * ONE_MINUTE
_MAX_BYTES = 32


def timestamp_now() -> int:
    """Return the clock's time in the unit of signatures, within 0 and `LATEST`."""
    return min(max(int((time.time() - EPOCH_S) * 1e5), 0), LATEST)


class KeptTimestamp:
    """The file of the newest timestamp, of all programs that sign with this folder.

    Attributes:
        start: read from the file, in units of 10 us since 2015; 0: there is none that can be used.
        problem: why the file could not be read or written the last time; empty: it could.
    """

    def __init__(self, folder: Path) -> None:
        """Read the file. Never raises for it: signing works without, from the clock.

        Args:
            folder: it is made when there is something to write.
        """
        self.path = folder / FILE_NAME
        self.problem = ""
        self.start = 0
        self._written = 0
        self._thread: threading.Thread | None = None
        try:
            self.start = self._written = self._read()
        except FileNotFoundError:
            pass
        except (OSError, ValueError) as error:
            self._fail("cannot be read", error)
        # It is never gone back from: the autopilot has seen later ones, and keeps them too. A clock of before
        # 2015 is none.
        now = timestamp_now()
        if now and (ahead := self.start - now) > _FAR:
            logger.warning(
                "signing timestamp %s is %.0f days ahead of this computer's clock, which is or was wrong; "
                "signing goes on from there. To start over: remove the file, companion signing new and send, "
                "and restart the autopilot",
                self.path,
                ahead / _FAR,
            )

    def passed(self, timestamp: int) -> None:
        """Note the newest timestamp. Returns at once: a thread writes, before the file's is reached."""
        if timestamp + _LEAD <= self._written or (self._thread is not None and self._thread.is_alive()):
            return
        # Also after a failure: the next attempt is due in a minute.
        self._written = min(timestamp + _AHEAD, LATEST)
        self._thread = threading.Thread(
            target=self._write, args=(self._written,), name="signing timestamp", daemon=True
        )
        self._thread.start()

    def flush(self, timeout_s: float = 5.0) -> None:
        """Wait for a write that has begun."""
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _read(self) -> int:
        with self.path.open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
        text = content.strip()
        if not text.isdigit() or len(content) > _MAX_BYTES:
            raise ValueError(f"expected one number, got {len(content)} bytes")
        if not 0 <= (timestamp := int(text)) <= LATEST:
            raise ValueError(f"expected at most {LATEST}, got {timestamp}")
        return timestamp

    def _write(self, timestamp: int) -> None:
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY)
            try:
                fcntl.flock(folder, fcntl.LOCK_EX)  # another program that signs keeps its own there
                if not self._has(timestamp):
                    self._replace(timestamp)
                    os.fsync(folder)
                self.problem = ""
            finally:
                os.close(folder)
        except OSError as error:
            self._fail("cannot be written", error)

    def _has(self, timestamp: int) -> bool:
        """Whether the file has this timestamp or a later one, of another program."""
        try:
            return self._read() >= timestamp
        except (OSError, ValueError):
            return False

    def _replace(self, timestamp: int) -> None:
        descriptor, draft = tempfile.mkstemp(prefix=f".{FILE_NAME}-", dir=self.path.parent)
        try:
            with open(descriptor, "w", encoding="ascii") as file:
                file.write(f"{timestamp}\n")
                file.flush()
                os.fsync(descriptor)
            os.replace(draft, self.path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(draft)
            raise

    def _fail(self, what: str, error: Exception) -> None:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        said, self.problem = self.problem, f"{what}: {reason}"
        if said != self.problem:
            logger.warning(
                "signing timestamp %s: %s; a start with a late clock will accept old messages",
                self.path,
                self.problem,
            )
