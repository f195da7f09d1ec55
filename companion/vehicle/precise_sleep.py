"""A sleep with microsecond accuracy.

asyncio waits in epoll_wait(2), whose timeout is in whole milliseconds, rounded up: a sleep is late by up to
one. A timerfd(2) is a file that becomes readable at its time, to the microsecond, and the loop watches it.
Without timerfd (not Linux) the loop's sleep is used.
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

logger = logging.getLogger(__name__)

Sleep = Callable[[float], Awaitable[None]]


_CLOCK_MONOTONIC = 1


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
