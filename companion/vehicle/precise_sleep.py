"""A sleep as exact as the kernel's clock: the event loop's own timers are good to a millisecond at best.

asyncio waits in epoll_wait(2), whose timeout is in whole milliseconds, rounded up: a sleep is late by up to
one. A timerfd(2) is a file that becomes readable at its moment, to the microsecond, and the loop watches
files anyway. Where there is none (not Linux) the loop's sleep is used.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import logging
import os
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

Sleep = Callable[[float], Awaitable[None]]

logger = logging.getLogger(__name__)

_CLOCK_MONOTONIC = 1


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("interval", _Timespec), ("value", _Timespec))


@asynccontextmanager
async def precise_sleep() -> AsyncIterator[Sleep]:
    """Yields `sleep(seconds)`, for one task at a time. A time that is over returns at the next turn."""
    try:
        timer = _Timer()
    except (OSError, AttributeError) as error:
        if sys.platform.startswith("linux"):
            logger.warning("no timerfd (%s): setpoints leave by the event loop's coarser timers", error)
        yield asyncio.sleep
        return
    try:
        asyncio.get_running_loop().add_reader(timer.descriptor, timer.ring)
        yield timer.sleep
    finally:
        asyncio.get_running_loop().remove_reader(timer.descriptor)
        os.close(timer.descriptor)


class _Timer:
    """A timerfd. Raises OSError where the kernel gives none, AttributeError where the C library has none."""

    def __init__(self) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)
        self.descriptor: int = self._libc.timerfd_create(_CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self.descriptor < 0:
            raise _error("timerfd_create")
        self._rung = asyncio.Event()
        self._asleep = False

    def ring(self) -> None:
        """The file is readable."""
        # Armed anew in the same turn of the loop, it is not any more.
        with contextlib.suppress(BlockingIOError):
            os.read(self.descriptor, 8)
            self._rung.set()

    async def sleep(self, seconds: float) -> None:
        """Return when they are over. Raises RuntimeError: another task sleeps on this timer."""
        if self._asleep:
            raise RuntimeError("this timer is for one task at a time")
        self._asleep = True
        try:
            self._rung.clear()
            # All zero would stop the timer instead.
            whole, nanoseconds = divmod(max(1, round(seconds * 1e9)), 1_000_000_000)
            setting = _Itimerspec(value=_Timespec(whole, nanoseconds))
            if self._libc.timerfd_settime(self.descriptor, 0, ctypes.byref(setting), None) < 0:
                raise _error("timerfd_settime")
            await self._rung.wait()
        finally:
            self._asleep = False


def _error(call: str) -> OSError:
    number = ctypes.get_errno()
    return OSError(number, f"{call}: {os.strerror(number)}")
