"""Imports without the garbage collector, which would repeatedly scan objects that are kept anyway."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def gc_paused() -> Iterator[None]:
    """Pause garbage collection around imports: it takes a quarter of their time (for torch half a second).

    Everything allocated is then frozen (`gc.freeze`): modules are kept, and collecting the garbage of an
    import (7000 objects for torch) would cost the time that was saved.
    """
    was_collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if was_collecting:
            gc.enable()
