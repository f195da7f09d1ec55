"""Loading what stays: without the garbage collector, which would look through all of it again and again."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def gc_paused() -> Iterator[None]:
    """Around imports: a quarter of the time that they take (of torch half a second) is the collector's.

    It passes over all that is there afterwards for good: what a module makes when it is imported is kept, and
    what is garbage by then too (after torch 7000 objects): to look for it would cost what was saved.
    """
    was_collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if was_collecting:
            gc.enable()
