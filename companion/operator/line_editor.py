"""Editing of one line in a terminal: bytes of keys in, a view of one row out. Without input and output.

GNU readline is GPL, and it writes to the terminal itself: in the service's process that would wait for a
terminal that is not read, with the interpreter's lock.
"""

from __future__ import annotations

import codecs
import re
import unicodedata
from collections.abc import Iterator, Sequence
from enum import Enum

LONGEST_LINE = 4095
"""Characters, as in a terminal that edits by itself (termios(3)); further ones are ignored."""

_ESCAPE = "\x1b"
# ECMA-48 5.4: a control sequence ends with its first byte from 0x40 on. SS3, `ESC O`, has one more byte.
_SEQUENCE = re.compile(r"\x1b(?:\[[\x20-\x3f]*[\x40-\x7e]|O[\x20-\x7e]|[^\[O])", re.DOTALL)
_LONGEST_SEQUENCE = 32


class Key(Enum):
    """What the owner of the line has to do."""

    COMPLETE = "tab"
    OLDER = "up, at the newest line: read the history, then `older`"
    END = "ctrl-d, on an empty line"


class LineEditor:
    """The line that is being typed, with the lines before it.

    Args:
        prompt: stands before the line; printable.

    Attributes:
        text: the line. cursor: index in it. history: lines before, the oldest first.
    """

    def __init__(self, prompt: str) -> None:
        self.text, self.cursor, self._prompt = "", 0, prompt
        self.history: Sequence[str] = ()
        self._recalled = 0  # how many lines back; 0: the typed one
        self._typed = ""
        self._decoder = codecs.getincrementaldecoder("utf-8")(errors="ignore")
        self._sequence = ""

    def feed(self, data: bytes) -> Iterator[str | Key]:
        """Apply keys; yields each finished line, and keys that the caller serves before it goes on."""
        for character in self._decoder.decode(data):
            if self._sequence or character == _ESCAPE:
                self._sequence = _ESCAPE if character == _ESCAPE else self._sequence + character
                if not _SEQUENCE.fullmatch(self._sequence) and len(self._sequence) < _LONGEST_SEQUENCE:
                    continue
                key, self._sequence = _SEQUENCES.get(self._sequence, ""), ""
            else:
                key = _CONTROLS.get(character, character)
            if key in ("\n", "\r"):
                line, self.text, self.cursor, self._recalled = self.text, "", 0, 0
                yield line
            elif key == "complete":
                yield Key.COMPLETE
            elif key == "end" and not self.text:
                yield Key.END
            elif key == "older" and not self._recalled:
                yield Key.OLDER
            elif len(key) == 1:
                if key.isprintable() and len(self.text) < LONGEST_LINE:
                    self.replace(self.cursor, key)
            elif key:
                self._apply(key)

    def replace(self, start: int, text: str) -> None:
        """Put a text in place of what is between an index and the cursor."""
        self.text = self.text[:start] + text + self.text[self.cursor :]
        self.cursor = start + len(text)

    def older(self) -> None:
        """Show the line before this one in the history."""
        self._recall(self._recalled + 1)

    def view(self, columns: int) -> str:
        """Return prompt and line in one row of a terminal, the cursor in its place: a long line is cut."""
        width = max(columns - 1 - _width(self._prompt), 1)
        start, end = 0, len(self.text)
        if _width(self.text) > width:
            start = self.cursor
            while start and _width(self.text[start - 1 : self.cursor]) <= width:
                start -= 1
            end = self.cursor
            while end < len(self.text) and _width(self.text[start : end + 1]) <= width:
                end += 1
        after = _width(self.text[self.cursor : end])
        return f"{self._prompt}{self.text[start:end]}" + (f"\x1b[{after}D" if after else "")

    def _recall(self, back: int) -> None:
        back = min(max(back, 0), len(self.history))
        if not self._recalled:
            self._typed = self.text
        self._recalled = back
        self.text = self.history[-back] if back else self._typed
        self.cursor = len(self.text)

    def _apply(self, key: str) -> None:
        before, after = self.text[: self.cursor], self.text[self.cursor :]
        match key:
            case "left":
                self.cursor = max(self.cursor - 1, 0)
            case "right":
                self.cursor = min(self.cursor + 1, len(self.text))
            case "first":
                self.cursor = 0
            case "last":
                self.cursor = len(self.text)
            case "word left":
                self.cursor = _word_begin(before)
            case "word right":
                self.cursor += len(after) - len(re.sub(r"^\s*\S*", "", after))
            case "rub out":
                self.text, self.cursor = before[:-1] + after, max(self.cursor - 1, 0)
            case "rub out word":
                self.replace(_word_begin(before), "")
            case "rub out all before":
                self.replace(0, "")
            case "rub out all after":
                self.text = before
            case "delete" | "end":
                self.text = before + after[1:]
            case "older":
                self._recall(self._recalled + 1)
            case "newer" if self._recalled:
                self._recall(self._recalled - 1)


# As readline and the shells have them; of xterm, the Linux console, screen and serial terminals.
_CONTROLS = {
    "\t": "complete",
    "\x01": "first",
    "\x02": "left",
    "\x04": "end",
    "\x05": "last",
    "\x06": "right",
    "\x08": "rub out",
    "\x0b": "rub out all after",
    "\x0e": "newer",
    "\x10": "older",
    "\x15": "rub out all before",
    "\x17": "rub out word",
    "\x7f": "rub out",
}
_SEQUENCES = {
    **{f"\x1b{kind}A": "older" for kind in "[O"},
    **{f"\x1b{kind}B": "newer" for kind in "[O"},
    **{f"\x1b{kind}C": "right" for kind in "[O"},
    **{f"\x1b{kind}D": "left" for kind in "[O"},
    **dict.fromkeys(("\x1b[H", "\x1bOH", "\x1b[1~", "\x1b[7~"), "first"),
    **dict.fromkeys(("\x1b[F", "\x1bOF", "\x1b[4~", "\x1b[8~"), "last"),
    **dict.fromkeys(("\x1bb", "\x1b[1;5D", "\x1b[1;3D"), "word left"),
    **dict.fromkeys(("\x1bf", "\x1b[1;5C", "\x1b[1;3C"), "word right"),
    "\x1b[3~": "delete",
    "\x1b\x7f": "rub out word",
}


def _word_begin(before: str) -> int:
    return len(re.sub(r"\S*\s*$", "", before))


def _width(text: str) -> int:
    """Columns of a terminal (Unicode Standard Annex 11)."""
    return sum(
        0
        if unicodedata.category(each) in ("Mn", "Me", "Cf")
        else 2
        if unicodedata.east_asian_width(each) in "WF"
        else 1
        for each in text
    )


def common_beginning(texts: Sequence[str]) -> str:
    """Return what all of these begin with."""
    first, last = min(texts), max(texts)
    differing = (index for index, pair in enumerate(zip(first, last, strict=False)) if len(set(pair)) > 1)
    return first[: next(differing, min(len(first), len(last)))]
