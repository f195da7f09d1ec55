"""How a service and the work with it end each other."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, cast

import pytest

from companion.service import Service
from companion.sim_session import SimSessionError, with_service


class ServiceThatEnds:
    """`Service` as `with_service` sees it; it ends by `error`, at once or when it is told to stop."""

    def __init__(self, error: Exception | None, *, early: bool = False) -> None:
        self.ready = False
        self._error = error
        self._told = asyncio.Event()
        if early:
            self._told.set()

    async def run(self, on_ready: Callable[[], None]) -> None:
        self.ready = True
        on_ready()
        await self._told.wait()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        self._told.set()


async def flown(service: ServiceThatEnds, work: Callable[[], Any]) -> None:
    async with asyncio.timeout(10):
        await with_service(cast(Service, service), work)


async def test_a_service_that_fails_while_it_ends_is_no_success() -> None:
    done: list[bool] = []

    async def work() -> None:
        done.append(True)

    with pytest.raises(OSError, match="the disk is full"):
        await flown(ServiceThatEnds(OSError("the disk is full")), work)
    assert done == [True]
    await flown(ServiceThatEnds(None), work)
    assert done == [True, True]


async def test_what_failed_first_is_what_is_told() -> None:
    async def work() -> None:
        raise SimSessionError("the vehicle was not ready to arm")

    with pytest.raises(SimSessionError, match="not ready to arm"):
        await flown(ServiceThatEnds(OSError("the disk is full")), work)


async def test_a_service_that_ends_too_early_ends_the_work() -> None:
    async def work() -> None:
        await asyncio.Event().wait()

    with pytest.raises(SimSessionError, match="service ended"):
        await flown(ServiceThatEnds(None, early=True), work)
    with pytest.raises(OSError, match="no such bus"):
        await flown(ServiceThatEnds(OSError("no such bus"), early=True), work)
