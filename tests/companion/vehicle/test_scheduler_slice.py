"""The scheduler slice: set where the kernel supports it, unchanged otherwise."""

from __future__ import annotations

import os
import re
import threading
from pathlib import Path
from typing import NamedTuple

import pytest

from companion.vehicle.precise_sleep import SHORTEST_NS, set_scheduler_slice


class Scheduling(NamedTuple):
    """A thread's niceness, and its slice as reported by the kernel (None: not reported)."""

    nice: int
    slice_ns: int | None


def scheduling() -> Scheduling:
    identity = threading.get_native_id()
    file = Path(f"/proc/self/task/{identity}/sched")
    found = re.search(r"^se\.slice\s*:\s*(\d+)", file.read_text(), re.MULTILINE) if file.is_file() else None
    return Scheduling(os.getpriority(os.PRIO_PROCESS, identity), int(found[1]) if found else None)


def in_a_thread() -> tuple[bool, Scheduling, Scheduling]:
    """Set the slice in a new thread; returns the result and the scheduling before and after."""
    results: list[tuple[bool, Scheduling, Scheduling]] = []

    def run() -> None:
        before = scheduling()
        supported = set_scheduler_slice()
        results.append((supported, before, scheduling()))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return results[0]


def test_scheduler_slice_is_set_and_niceness_kept() -> None:
    supported, before, after = in_a_thread()
    if not supported or before.slice_ns is None:
        pytest.skip("this kernel does not support slices, or does not report them")
    assert after.nice == before.nice
    # Before 6.12 the kernel accepts the request and ignores it.
    release = tuple(int(number) for number in re.findall(r"\d+", os.uname().release)[:2])
    assert after.slice_ns == (SHORTEST_NS if release >= (6, 12) else before.slice_ns)


def test_refused_slice_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.vehicle.precise_sleep._SCHED_OTHER", 99)  # no such policy
    supported, before, after = in_a_thread()
    assert supported is False
    assert after == before


def test_unknown_machine_is_unsupported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "abacus")
    assert set_scheduler_slice() is False
