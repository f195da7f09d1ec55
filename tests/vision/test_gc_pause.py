"""Imports without the garbage collector."""

from __future__ import annotations

import gc
import subprocess
import sys

import pytest

from vision.gc_pause import gc_paused

# Existing objects are never collected afterwards, so this is tested in a separate process.
PROGRAM = """
import gc
import weakref
from vision.gc_pause import gc_paused

class Ring:
    def __init__(self):
        self.itself = self

def dropped_ring():
    return weakref.ref(Ring())

with gc_paused():
    assert not gc.isenabled()
    ring = dropped_ring()
gc.collect()
assert ring() is not None, "collected after all"
later = dropped_ring()
gc.collect()
assert later() is None, "nothing is collected any more"
with gc_paused():
    with gc_paused():
        pass
    assert not gc.isenabled(), "an inner one ends the outer"
assert gc.isenabled()
"""


def fail_to_import() -> None:
    with gc_paused():
        raise ImportError


def test_only_later_garbage_is_collected() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr


def test_an_import_that_fails_leaves_the_collector_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gc, "freeze", lambda: None)  # keep the objects of other tests collectable
    with pytest.raises(ImportError):
        fail_to_import()
    assert gc.isenabled()
