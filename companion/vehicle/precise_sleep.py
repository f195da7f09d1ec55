"""A sleep as exact as the kernel's clock: the event loop's own timers are good to a millisecond at best.

asyncio waits in epoll_wait(2), whose timeout is in whole milliseconds, rounded up: a sleep is late by up to
one. A timerfd(2) is a file that becomes readable at its moment, to the microsecond, and the loop watches
files anyway. Where there is none (not Linux) the loop's sleep is used.
"""

from __future__ import annotations

import asyncio
import ctypes
import os
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

Sleep = Callable[[float], Awaitable[None]]

_CLOCK_MONOTONIC = 1


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("interval", _Timespec), ("value", _Timespec))


@asynccontextmanager
async def precise_sleep() -> AsyncIterator[Sleep]:
    """Yields `sleep(seconds)`, for one task at a time. A time that is over returns at the loop's next turn.

    Raises:
        OSError: the kernel gives no timer.
    """
    if not sys.platform.startswith("linux"):
        yield asyncio.sleep
        return
    libc = ctypes.CDLL(None, use_errno=True)
    descriptor = libc.timerfd_create(_CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
    if descriptor < 0:
        raise _error("timerfd_create")
    loop = asyncio.get_running_loop()
    rung = asyncio.Event()

    def ring() -> None:
        os.read(descriptor, 8)
        rung.set()

    async def sleep(seconds: float) -> None:
        rung.clear()
        # All zero would stop the timer instead.
        whole, nanoseconds = divmod(max(1, round(seconds * 1e9)), 1_000_000_000)
        setting = _Itimerspec(value=_Timespec(whole, nanoseconds))
        if libc.timerfd_settime(descriptor, 0, ctypes.byref(setting), None) < 0:
            raise _error("timerfd_settime")
        await rung.wait()

    loop.add_reader(descriptor, ring)
    try:
        yield sleep
    finally:
        loop.remove_reader(descriptor)
        os.close(descriptor)


def _error(call: str) -> OSError:
    number = ctypes.get_errno()
    return OSError(number, f"{call}: {os.strerror(number)}")
