"""The scheduler slice: set where the kernel supports it, unchanged otherwise; a program has its own."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import NamedTuple

import pytest

from companion.host.scheduling import SHORTEST_NS, schedule_as_any_program, set_scheduler_slice
from tests.companion.vehicle.thread_slice import slice_of

needs_slices = pytest.mark.skipif(slice_of(0) is None, reason="this system has no slices")


class Scheduling(NamedTuple):
    nice: int
    slice_ns: int | None


def scheduling(thread: int) -> Scheduling:
    return Scheduling(os.getpriority(os.PRIO_PROCESS, thread), slice_of(thread))


def in_a_thread(action: Callable[[], bool]) -> tuple[bool, Scheduling, Scheduling]:
    """Act in a new thread; returns the result and the scheduling before and after."""
    results: list[tuple[bool, Scheduling, Scheduling]] = []

    def run() -> None:
        before = scheduling(0)
        results.append((action(), before, scheduling(0)))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return results[0]


@needs_slices
def test_scheduler_slice_is_set_and_niceness_kept() -> None:
    supported, before, after = in_a_thread(set_scheduler_slice)
    assert supported is True
    assert after == (before.nice, SHORTEST_NS)


def test_refused_slice_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.host.scheduling._SCHED_OTHER", 99)  # no such policy
    supported, before, after = in_a_thread(set_scheduler_slice)
    assert supported is False
    assert after == before


def test_unknown_machine_is_unsupported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "abacus")
    assert set_scheduler_slice() is False


REAL_TIME = """
import os
import threading
from companion.host.scheduling import lower_priority, set_scheduler_slice
try:
    os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
except PermissionError:
    print("not permitted")
else:
    print(set_scheduler_slice(), os.sched_getscheduler(0) & os.SCHED_RR)
    os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    end = threading.Event()
    thread = threading.Thread(target=end.wait)
    thread.start()
    print(os.sched_getscheduler(thread.native_id))
    lower_priority(3)
    print(os.sched_getscheduler(0), os.sched_getscheduler(thread.native_id))
    end.set()
"""


def test_real_time_policy_is_kept_by_the_service_and_left_by_its_programs() -> None:
    printed = subprocess.run([sys.executable, "-c", REAL_TIME], capture_output=True, text=True, check=True)
    if printed.stdout == "not permitted\n":
        pytest.skip("this user may not use a real-time policy")
    assert printed.stdout == f"True {os.SCHED_RR}\n{os.SCHED_RR}\n0 0\n"


def test_a_program_that_is_started_is_no_part_of_the_service() -> None:
    """Its parent says so, before the program can."""
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        os.sched_setscheduler(process.pid, os.SCHED_BATCH, os.sched_param(0))
        schedule_as_any_program(process.pid)
        assert os.sched_getscheduler(process.pid) == os.SCHED_OTHER
    finally:
        process.communicate(b"\n")
    schedule_as_any_program(process.pid)  # it has ended: nothing to do


PROGRAM = """
from companion.host.scheduling import lower_priority
lower_priority(3)
print(flush=True)
input()
"""


@needs_slices
def test_program_of_lower_priority_has_not_its_parents_slice() -> None:
    programs: list[Scheduling] = []

    def start() -> bool:
        set_scheduler_slice()
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert process.stdout is not None
        process.stdout.readline()
        programs.append(scheduling(process.pid))
        process.communicate(b"\n")
        return process.returncode == 0

    ended, before, _ = in_a_thread(start)
    assert ended
    (program,) = programs
    assert program.nice == min(before.nice + 3, 19)
    assert program.slice_ns is not None
    assert program.slice_ns > SHORTEST_NS
