"""Short turns on the processor: asked of the kernel, and nothing changed where there is nothing to ask."""

from __future__ import annotations

import os
import re
import threading
from pathlib import Path
from typing import NamedTuple

import pytest

from companion.vehicle import scheduler_slice
from companion.vehicle.scheduler_slice import SHORTEST_NS, set_scheduler_slice


class Turns(NamedTuple):
    """A thread's niceness, and the length of its turns as the kernel tells it (None: it does not)."""

    nice: int
    turn_ns: int | None


def turns() -> Turns:
    identity = threading.get_native_id()
    told = Path(f"/proc/self/task/{identity}/sched")
    found = re.search(r"^se\.slice\s*:\s*(\d+)", told.read_text(), re.MULTILINE) if told.is_file() else None
    return Turns(os.getpriority(os.PRIO_PROCESS, identity), int(found[1]) if found else None)


def in_a_thread() -> tuple[bool, Turns, Turns]:
    """What came of it in a thread of its own, with what was before and after."""
    told: list[tuple[bool, Turns, Turns]] = []

    def run() -> None:
        before = turns()
        took = set_scheduler_slice()
        told.append((took, before, turns()))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return told[0]


def test_a_threads_turns_are_as_short_as_asked_and_its_niceness_is_kept() -> None:
    took, before, after = in_a_thread()
    if not took or before.turn_ns is None:
        pytest.skip("this kernel does not give short turns, or does not tell them")
    assert after.nice == before.nice
    # Before 6.12 the kernel takes the wish and does nothing.
    release = tuple(int(number) for number in re.findall(r"\d+", os.uname().release)[:2])
    assert after.turn_ns == (SHORTEST_NS if release >= (6, 12) else before.turn_ns)


def test_what_the_kernel_refuses_is_false_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler_slice, "_SCHED_OTHER", 99)  # no such policy
    took, before, after = in_a_thread()
    assert took is False
    assert after == before


def test_an_unknown_machine_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "abacus")
    assert set_scheduler_slice() is False
