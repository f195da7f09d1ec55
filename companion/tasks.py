"""Background tasks: none ends unseen."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine
from typing import Any, TypeVar

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
