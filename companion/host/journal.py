"""Priorities of systemd's journal: `<N>` before each line (sd-daemon(3)), where the output is the journal.

The log and `companion.operator.line_output` use this. Worker and programs beside the service print into
pipes; the service logs what it reads there.
"""

from __future__ import annotations

import logging
import os
import re
import sys
from contextlib import suppress

from companion.host.load import with_load
from vision.redaction import redacted

# syslog(3): LOG_ERR, LOG_WARNING, LOG_INFO, LOG_DEBUG; the first whose level is reached.
_PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.NOTSET, 7))
_MARKED = re.compile(r"<[0-7]>")


def is_journal(descriptor: int) -> bool:
    """Whether a descriptor is the journal's socket.

    JOURNAL_STREAM is its device and inode. What a unit starts inherits the variable, such as a terminal of
    the desktop and all of its programs, whose outputs are others.
    """
    with suppress(OSError):  # closed
        status = os.fstat(descriptor)
        return f"{status.st_dev}:{status.st_ino}" == os.environ.get("JOURNAL_STREAM")
    return False


def marked(text: str, level: int) -> str:
    """Return the text with the priority of a level of `logging` before each line that has none."""
    priority = next(number for least, number in _PRIORITIES if level >= least)
    return "\n".join(line if _MARKED.match(line) else f"<{priority}>{line}" for line in text.split("\n"))


def marked_for_journal(text: str, level: int) -> str:
    """The same if standard error is the journal, else the text as it is."""
    return marked(text, level) if is_journal(2) else text


class _Formatter(logging.Formatter):
    """Without secrets, also in tracebacks; with the load where something was too slow."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - of logging
        return with_load(super().formatMessage(record))

    def format(self, record: logging.LogRecord) -> str:
        return redacted(super().format(record))


class _MarkingFormatter(_Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return marked(super().format(record), record.levelno)


def log_to_standard_error(level: int | str, line: str) -> None:
    """Let `logging` write to standard error. `line`: format of a line; the journal has its own times."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter((_MarkingFormatter if is_journal(2) else _Formatter)(line))
    logging.basicConfig(level=level, handlers=[handler])


def redact_last_resort() -> None:
    """Let what is logged where no log was set up show no secrets either."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_Formatter())
