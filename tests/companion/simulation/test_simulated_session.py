"""The end of a service and of the work with it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, cast

import pytest

from companion.service import Service
from companion.settings import Settings
from companion.simulation.session import SimSessionError, with_service


class EndingService:
    """A `Service` that ends with `error`, immediately or on `stop`."""

    def __init__(self, error: Exception | None, *, early: bool = False) -> None:
        self.ready = False
        self.settings, self.parts = Settings(), self
        self._error = error
        self._stopped = asyncio.Event()
        if early:
            self._stopped.set()

    async def run(self, on_ready: Callable[[], None]) -> None:
        self.ready = True
        on_ready()
        await self._stopped.wait()
        if self._error is not None:
            raise self._error

    async def complete(self, within_s: float) -> None:
        """All parts are up."""

    def stop(self) -> None:
        self._stopped.set()


async def run_with(service: EndingService, work: Callable[[], Any]) -> None:
    async with asyncio.timeout(10):
        await with_service(cast(Service, service), work)


async def test_service_error_at_its_end_is_raised() -> None:
    done: list[bool] = []

    async def work() -> None:
        done.append(True)

    with pytest.raises(OSError, match="disk 7"):
        await run_with(EndingService(OSError("disk 7")), work)
    assert done == [True]
    await run_with(EndingService(None), work)
    assert done == [True, True]


async def test_first_error_is_raised() -> None:
    async def work() -> None:
        raise SimSessionError("arming 7")

    with pytest.raises(SimSessionError, match="arming 7"):
        await run_with(EndingService(OSError("disk 7")), work)


async def test_early_end_of_service_ends_work() -> None:
    async def work() -> None:
        await asyncio.Event().wait()

    with pytest.raises(SimSessionError, match="service ended"):
        await run_with(EndingService(None, early=True), work)
    with pytest.raises(OSError, match="bus 7"):
        await run_with(EndingService(OSError("bus 7"), early=True), work)
