"""Reads text files that people write: UTF-8, with or without a byte order mark."""

from __future__ import annotations

import codecs
import errno
import os
import stat
from pathlib import Path

_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


class NotUtf8Error(UnicodeDecodeError):
    """Bytes that are not UTF-8; `str()` is one line with what they are, and what to do."""

    def __str__(self) -> str:
        if self.object.startswith(_UTF_16):
            return "is UTF-16 text; save it as UTF-8"
        line = self.object[: self.start].count(b"\n") + 1
        return f"is not UTF-8 text (line {line}, byte {self.start}); save it as UTF-8"


def read_text(path: Path) -> str:
    """The text of a file, without its byte order mark.

    Raises:
        OSError: it cannot be read, or is a pipe without a writer. NotUtf8Error.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with open(descriptor, "rb", buffering=0) as file:
        if not stat.S_ISFIFO(os.fstat(descriptor).st_mode):
            return decode_text(file.readall())
        # `<(…)` of a shell is a pipe with a writer; one without a writer would be waited for forever.
        if (first := file.read(1)) == b"":
            raise OSError(errno.EPIPE, "is a pipe that nobody writes to", str(path))
        os.set_blocking(descriptor, True)
        return decode_text((first or b"") + file.readall())


def decode_text(data: bytes) -> str:
    """The text of a file's bytes, without its byte order mark; raises NotUtf8Error."""
    try:
        return data.decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        raise NotUtf8Error(error.encoding, error.object, error.start, error.end, error.reason) from None
