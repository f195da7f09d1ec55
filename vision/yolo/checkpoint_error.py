"""The errors of reading a checkpoint, and texts that may quote it."""

from __future__ import annotations

import reprlib


class CheckpointError(ValueError):
    """A checkpoint that cannot be read; one line with the file, the reason, and what to do."""


class UnsafeCheckpointError(CheckpointError):
    """A checkpoint that names what none needs, such as a function; the message names it."""


def one_line(message: str) -> str:
    """A message that may quote the file: control characters escaped, at most 2000 characters."""
    return "".join(
        character if character.isprintable() else repr(character)[1:-1]
        for character in message[:_LONGEST_MESSAGE]
    )


_LONGEST_MESSAGE = 2000
_SCALARS = (str, int, float, bool, type(None))


class _Excerpt(reprlib.Repr):
    """The beginning of a value's text: the whole text of a container can exceed any memory."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxstring = 3, 100
        self.maxlist = self.maxtuple = self.maxdict = self.maxset = 8

    def repr_instance(self, value: object, level: int) -> str:
        return repr(value) if isinstance(value, _SCALARS) else f"a {type(value).__name__}"


def shown(value: object) -> str:
    """A value from a file for a message: at most 200 characters, made in bounded time and memory."""
    return _Excerpt().repr(value)[:200]
