"""Tasks: background ones that do not end unseen, or end for good, and some that begin and end together."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine, Iterable
from typing import Any, TypeVar

from companion.host.restarts import Restarts

logger = logging.getLogger(__name__)

T = TypeVar("T")
# The loop itself keeps only weak references.
_running: set[asyncio.Task[Any]] = set()


def spawn(work: Coroutine[Any, Any, T], name: str) -> asyncio.Task[T]:
    """Start a task whose result nobody has to await: an error that ends it is logged with its name.

    `asyncio.create_task` is for tasks that the same function awaits.
    """
    task = asyncio.create_task(work, name=name)
    _running.add(task)
    task.add_done_callback(_on_end)
    return task


def _on_end(task: asyncio.Task[Any]) -> None:
    _running.discard(task)
    if not task.cancelled() and (error := task.exception()) is not None:
        logger.error("%s has ended: %s: %s", task.get_name(), type(error).__name__, error, exc_info=error)


async def keep_running(
    name: str,
    work: Callable[[], Coroutine[Any, Any, None]],
    on_event: Callable[[str, str], None] = lambda _level, _text: None,
) -> None:
    """Run `work` until it returns. An exception is a fault of ours: it is reported, and `work` runs again.

    For what the service can do without for a while. A fault of what steers ends the service, in HOLD.

    Args:
        name: for people. work: called for every run, after the pauses of `Restarts`.
        on_event: called with (level, text), besides the log.
    """
    restarts = Restarts()
    while True:
        begun_s = time.monotonic()
        try:
            await work()
            return
        except Exception as error:
            reason = error_text(error)
            restart = restarts.after(time.monotonic() - begun_s, reason)
            if restart.reported:
                logger.exception("%s failed; %s", name, restart)
                on_event("error", f"{name} failed: {reason}; {restart}")
        await asyncio.sleep(restart.pause_s)


def error_text(error: BaseException) -> str:
    """Return an unexpected error in one line, with its type."""
    return " ".join(f"{type(error).__name__}: {error}".split())


async def start_together(*starts: Coroutine[Any, Any, None]) -> None:
    """Run coroutines at the same time until all have ended.

    The first that fails cancels the others, and its error is raised once they have ended.
    """
    tasks = [asyncio.create_task(start) for start in starts]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def run_until(stop: asyncio.Event, tasks: Iterable[asyncio.Task[None]]) -> None:
    """Wait until `stop` is set. A task that fails ends this with its error; one may end without."""
    stopped = asyncio.create_task(stop.wait())
    waiting: set[asyncio.Task[Any]] = {stopped, *tasks}
    try:
        while not stopped.done():
            done, waiting = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
    finally:
        stopped.cancel()
