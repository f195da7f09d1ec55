"""Background tasks."""

from __future__ import annotations

import asyncio
import gc

import pytest

from companion.host.tasks import spawn


async def test_error_that_ends_a_task_is_logged_with_its_name(caplog: pytest.LogCaptureFixture) -> None:
    async def fail() -> None:
        raise KeyError("metadataTypes")

    task = spawn(fail(), "events of a link")
    await asyncio.wait((task,))
    (record,) = [each for each in caplog.records if each.name == "companion.host.tasks"]
    assert record.levelname == "ERROR"
    assert "events of a link" in record.getMessage()
    assert record.exc_info is not None
    assert record.exc_info[0] is KeyError


async def test_cancelled_and_completed_tasks_are_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    tasks = [spawn(asyncio.sleep(0), "done"), spawn(asyncio.sleep(60), "cancelled")]
    tasks[1].cancel()
    await asyncio.wait(tasks)
    assert not caplog.records


async def test_task_without_another_reference_is_kept() -> None:
    ended = asyncio.Event()

    async def wait() -> None:
        await asyncio.sleep(0)
        gc.collect()
        ended.set()

    spawn(wait(), "kept")
    async with asyncio.timeout(10):
        await ended.wait()
