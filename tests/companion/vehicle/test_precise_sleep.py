"""The sleep of the setpoint stream: never too short, always ends, releases its timer."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time

import pytest

from companion.vehicle.precise_sleep import precise_sleep

pytestmark = pytest.mark.realtime


@pytest.mark.parametrize("seconds", [0.02, 0.0005, 1e-9, 0.0, -1.0])
async def test_sleep_is_never_too_short(seconds: float) -> None:
    async with precise_sleep() as sleep, asyncio.timeout(20):
        for _ in range(3):
            started = time.monotonic()
            await sleep(seconds)
            assert time.monotonic() - started >= seconds


async def test_sleep_works_after_a_hang_of_the_loop() -> None:
    turns = 0

    async def count() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    counting = asyncio.create_task(count())
    async with precise_sleep() as sleep, asyncio.timeout(20):
        await sleep(0.02)
        assert turns > 1
        waiting = asyncio.ensure_future(sleep(0.01))
        await asyncio.sleep(0)
        time.sleep(0.05)  # noqa: ASYNC251  (the loop hangs while the timer expires)
        await waiting
        await sleep(0.01)
    counting.cancel()


def timers() -> int:
    """Count the open timer files of this process."""
    count = 0
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # another thread may close a file meanwhile
            count += os.readlink(f"/proc/self/fd/{name}") == "anon_inode:[timerfd]"
    return count


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs Linux's /proc")
async def test_timer_file_is_closed_after_cancellation() -> None:
    before = timers()

    async def use() -> None:
        async with precise_sleep() as sleep:
            await sleep(60)

    task = asyncio.create_task(use())
    await asyncio.sleep(0)
    assert timers() == before + 1
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert timers() == before


async def test_timer_is_for_one_task() -> None:
    async with precise_sleep() as sleep:
        first = asyncio.ensure_future(sleep(30))
        await asyncio.sleep(0)
        with pytest.raises(RuntimeError, match="another task"):
            await sleep(0.001)
        first.cancel()


async def test_cancelled_sleep_does_not_shorten_the_next(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with precise_sleep() as sleep, asyncio.timeout(20):
        first = asyncio.ensure_future(sleep(0.005))
        await asyncio.sleep(0)
        time.sleep(0.02)  # noqa: ASYNC251  (it expires while the loop hangs)
        first.cancel()
        started = time.monotonic()
        second = asyncio.ensure_future(sleep(0.05))
        await asyncio.gather(first, return_exceptions=True)
        await second
        assert time.monotonic() - started >= 0.05
    assert not caplog.records


async def test_without_timerfd_the_loop_sleep_is_used(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class NoTimers:
        def __init__(self, *_: object, **__: object) -> None: ...

    monkeypatch.setattr("companion.vehicle.precise_sleep.ctypes.CDLL", NoTimers)
    async with precise_sleep() as sleep:
        await sleep(0.001)
    assert "no timerfd" in caplog.text
