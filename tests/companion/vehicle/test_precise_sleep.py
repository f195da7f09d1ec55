"""The sleep of the setpoint stream: never too short, never without an end, nothing left behind."""

from __future__ import annotations

import asyncio
import os
import time

import pytest

from companion.vehicle.precise_sleep import precise_sleep


@pytest.mark.parametrize("seconds", [0.02, 0.0005, 1e-9, 0.0, -1.0])
async def test_it_lasts_as_long_as_asked_and_what_is_over_returns(seconds: float) -> None:
    async with precise_sleep() as sleep, asyncio.timeout(20):
        for _ in range(3):
            started = time.monotonic()
            await sleep(seconds)
            assert time.monotonic() - started >= seconds


async def test_others_run_meanwhile_and_a_hang_does_not_cost_the_next_one() -> None:
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
        waiting = asyncio.create_task(sleep(0.01))
        await asyncio.sleep(0)
        time.sleep(0.05)  # noqa: ASYNC251  (the loop hangs while the timer rings)
        await waiting
        await sleep(0.01)
    counting.cancel()


async def test_cancelled_or_not_its_file_is_closed() -> None:
    before = set(os.listdir("/proc/self/fd"))

    async def use() -> None:
        async with precise_sleep() as sleep:
            await sleep(60)

    task = asyncio.create_task(use())
    await asyncio.sleep(0)
    assert set(os.listdir("/proc/self/fd")) > before
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert set(os.listdir("/proc/self/fd")) == before
