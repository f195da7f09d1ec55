"""What was tried and what came of it, for people."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Tried:
    """One place that was looked at.

    Attributes:
        where: a device, a port or a package. found: one sentence without a full stop.
        advice: the line that mends it; empty: nothing to do.
    """

    where: str
    found: str
    advice: str = ""

    def lines(self, width: int) -> Iterator[str]:
        """Yield it as lines of at most `width` columns, where no word is longer."""
        for text, first in ((self.found, f"  {self.where}: "), (self.advice, "    → ")):
            if text:
                yield from textwrap.wrap(
                    first + text,
                    max(width, 40),
                    subsequent_indent="    ",
                    break_long_words=False,
                    break_on_hyphens=False,
                    drop_whitespace=True,
                )


Report = Callable[[Tried], None]
"""Receives each result as soon as it is known, from any thread."""
