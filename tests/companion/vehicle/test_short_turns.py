"""Short turns on the processor: asked of the kernel, and nothing changed where there is nothing to ask."""

from __future__ import annotations

import os
import threading

import pytest

from companion.vehicle import short_turns
from companion.vehicle.short_turns import take_short_turns


def in_a_thread(turn_ns: int) -> tuple[bool, int, int]:
    """What came of it in a thread of its own, and the thread's niceness before and after."""
    told: list[tuple[bool, int, int]] = []

    def run() -> None:
        identity = threading.get_native_id()
        before = os.getpriority(os.PRIO_PROCESS, identity)
        took = take_short_turns(turn_ns)
        told.append((took, before, os.getpriority(os.PRIO_PROCESS, identity)))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return told[0]


def test_a_thread_gets_them_where_the_kernel_knows_them_and_keeps_its_niceness() -> None:
    took, before, after = in_a_thread(short_turns.SHORTEST_NS)
    assert took in (True, False)
    assert before == after


def test_what_the_kernel_refuses_is_false_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(short_turns, "_SCHED_OTHER", 99)  # no such policy
    assert in_a_thread(short_turns.SHORTEST_NS)[0] is False


def test_an_unknown_machine_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "abacus")
    assert take_short_turns() is False
