"""Imports without the garbage collector."""

from __future__ import annotations

import gc
import weakref

import pytest

from vision.loading import uncollected


class Ring:
    """Garbage that the collector alone finds."""

    def __init__(self) -> None:
        self.itself = self


def dropped_ring() -> weakref.ref[Ring]:
    return weakref.ref(Ring())


def fail_to_import() -> None:
    with uncollected():
        raise ImportError


def test_nothing_is_collected_meanwhile_and_what_is_there_is_passed_over_afterwards() -> None:
    frozen = gc.get_freeze_count()
    with uncollected():
        assert not gc.isenabled()
        ring = dropped_ring()
    gc.collect()
    assert ring() is not None
    assert gc.get_freeze_count() > frozen
    later = dropped_ring()
    gc.collect()
    assert later() is None


def test_an_import_that_fails_leaves_the_collector_on() -> None:
    with pytest.raises(ImportError):
        fail_to_import()
    assert gc.isenabled()


def test_who_collects_nothing_goes_on_so() -> None:
    gc.disable()
    try:
        with uncollected(), uncollected():
            assert not gc.isenabled()
        assert not gc.isenabled()
    finally:
        gc.enable()
