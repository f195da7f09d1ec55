"""A sleep with microsecond accuracy, and a thread that runs at once when it wakes up.

asyncio waits in epoll_wait(2), whose timeout is in whole milliseconds, rounded up: a sleep is late by up to
one. A timerfd(2) is a file that becomes readable at its time, to the microsecond, and the loop watches it.
Without timerfd (not Linux) the loop's sleep is used.

Linux's scheduler (EEVDF, since 6.6) lets a running thread finish its slice of some 3 ms before a thread that
has just woken up, unless the latter has a shorter slice: then its deadline is earlier. Since 6.12 a thread
can set its slice (sched_setattr(2), `sched_runtime` under SCHED_OTHER, 0.1 to 100 ms). This needs no
privilege and gives no larger share of the processor. New threads and processes inherit it.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import logging
import os
import platform
import struct
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

logger = logging.getLogger(__name__)

Sleep = Callable[[float], Awaitable[None]]


_CLOCK_MONOTONIC = 1
SHORTEST_NS = 100_000
# The kernel's own slice: 0.7 to 2.8 ms, by the number of cores.
DEFAULT_NS = 0
# System call numbers: the C library has no wrapper.
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274, "armv7l": 380, "riscv64": 274}
_SCHED_OTHER = 0
_REAL_TIME = (1, 2)  # SCHED_FIFO, SCHED_RR
# struct sched_attr, first version: size, policy, flags, nice, priority, runtime, deadline, period.
_SCHED_ATTR = struct.Struct("=IIQiIQQQ")


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("interval", _Timespec), ("value", _Timespec))


@asynccontextmanager
async def precise_sleep() -> AsyncIterator[Sleep]:
    """Yield `sleep(seconds)`, for one task at a time. A past time returns in the next loop iteration."""
    try:
        timer = _Timer()
    except (OSError, AttributeError) as error:
        if sys.platform.startswith("linux"):
            logger.warning("no timerfd (%s): using the event loop's coarser timers for setpoints", error)
        yield asyncio.sleep
        return
    try:
        asyncio.get_running_loop().add_reader(timer.descriptor, timer.on_readable)
        yield timer.sleep
    finally:
        asyncio.get_running_loop().remove_reader(timer.descriptor)
        os.close(timer.descriptor)


class _Timer:
    """A timerfd. Raises OSError if the kernel refuses it, AttributeError if the C library lacks it."""

    def __init__(self) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)
        self.descriptor: int = self._libc.timerfd_create(_CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self.descriptor < 0:
            raise _error("timerfd_create")
        self._expired = asyncio.Event()
        self._asleep = False

    def on_readable(self) -> None:
        """Handle the expiry of the timer."""
        # Rearmed in the same loop iteration, the file is no longer readable.
        with contextlib.suppress(BlockingIOError):
            os.read(self.descriptor, 8)
            self._expired.set()

    async def sleep(self, seconds: float) -> None:
        """Sleep. Raises RuntimeError if another task sleeps on this timer."""
        if self._asleep:
            raise RuntimeError("another task already sleeps on this timer")
        self._asleep = True
        try:
            self._expired.clear()
            # All zero would stop the timer instead.
            whole, nanoseconds = divmod(max(1, round(seconds * 1e9)), 1_000_000_000)
            setting = _Itimerspec(value=_Timespec(whole, nanoseconds))
            if self._libc.timerfd_settime(self.descriptor, 0, ctypes.byref(setting), None) < 0:
                raise _error("timerfd_settime")
            await self._expired.wait()
        finally:
            self._asleep = False


def _error(call: str) -> OSError:
    number = ctypes.get_errno()
    return OSError(number, f"{call}: {os.strerror(number)}")


def set_scheduler_slice(slice_ns: int = SHORTEST_NS, thread: int = 0) -> bool:
    """Set the slice of a thread (0: this one). False: not supported by this system, nothing has changed.

    A thread of a real-time policy needs no short slice, and keeps its policy; `DEFAULT_NS` ends it.
    """
    number = _SCHED_SETATTR.get(platform.machine())
    if not sys.platform.startswith("linux") or number is None:
        return False
    if slice_ns != DEFAULT_NS and os.sched_getscheduler(thread) in _REAL_TIME:
        return True
    nice = os.getpriority(os.PRIO_PROCESS, thread)
    attributes = _SCHED_ATTR.pack(_SCHED_ATTR.size, _SCHED_OTHER, 0, nice, 0, slice_ns, 0, 0)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.syscall(number, thread, ctypes.create_string_buffer(attributes, _SCHED_ATTR.size), 0) == 0:
        return True
    logger.debug("scheduler slice not set: %s", os.strerror(ctypes.get_errno()))
    return False


def lower_priority(niceness: int) -> None:
    """Lower the priority of this process: of its threads, and of those they start.

    Policy and slice become those of any program; they were inherited from the thread that started it.
    """
    os.nice(niceness)
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    for thread in _threads():
        os.setpriority(os.PRIO_PROCESS, thread, nice)
        set_scheduler_slice(DEFAULT_NS, thread)


def run_when_idle() -> None:
    """Let every other program interrupt the threads of this process (SCHED_IDLE, sched(7)).

    A program that wakes up waits for the slice of a process of low priority, with 250 ticks a second up to
    4 ms, but never for one of this policy. A busy program on the same core leaves it almost no time.
    """
    for thread in _threads():
        os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))


def _threads() -> list[int]:
    """This process's threads: libraries start some as they are imported."""
    return [int(name) for name in os.listdir("/proc/self/task")] if sys.platform.startswith("linux") else [0]
