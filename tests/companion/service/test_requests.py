"""Each request to the vehicle is answered once, however it ends; a cancelled one is not."""

from __future__ import annotations

import asyncio
from typing import cast

from companion.guidance.interface import Arm, FindGimbal, Request, SetMode
from companion.host.clock import StandstillWatch
from companion.service.requests import RequestRunner
from companion.vehicle.driver import CommandRefusedError, Driver
from companion.vehicle.state import FlightMode, VehicleState

UNTIL_NS = 2**62


class FakeDriver:
    """Raises a given exception, or waits forever."""

    state = VehicleState()

    def __init__(self, fault: BaseException | None = None) -> None:
        self.fault = fault
        self.watch = StandstillWatch()
        self.asked: list[str] = []
        self.until_ns = 0

    async def set_mode(self, mode: FlightMode, *, since: VehicleState, valid_until_ns: int) -> None:
        self.asked.append(mode.value)
        if self.fault is not None:
            raise self.fault
        await asyncio.Event().wait()

    async def arm(self, *, since: VehicleState, valid_until_ns: int) -> None:
        self.asked.append("arm")
        self.until_ns = valid_until_ns

    async def find_gimbal(self) -> bool:
        return False


def runner_of(driver: FakeDriver) -> tuple[RequestRunner, asyncio.Event]:
    answered = asyncio.Event()
    return RequestRunner(cast(Driver, driver), answered.set), answered


async def failure_of(driver: FakeDriver, request: Request) -> str | None:
    runner, answered = runner_of(driver)
    runner.start(request)
    async with asyncio.timeout(10):
        await answered.wait()
    (answer,) = runner.take_answers()
    assert answer.identifier == request.identifier
    assert runner.take_answers() == ()
    return answer.refused


async def test_request_is_answered_with_its_result() -> None:
    hold = Request(7, SetMode(FlightMode.HOLD), UNTIL_NS)
    assert await failure_of(FakeDriver(), Request(1, Arm(), UNTIL_NS)) is None
    assert await failure_of(FakeDriver(CommandRefusedError("denied")), hold) == "denied"
    assert await failure_of(FakeDriver(ZeroDivisionError("a bug")), hold) == "ZeroDivisionError: a bug"
    refused = await failure_of(FakeDriver(), Request(2, FindGimbal(), UNTIL_NS))
    assert refused is not None
    assert refused.startswith("gimbal manager ")
    assert "not responding" in refused


async def test_driver_gets_the_validity_of_the_request() -> None:
    driver = FakeDriver()
    await failure_of(driver, Request(1, Arm(), 1234))
    assert driver.until_ns == 1234


async def test_internal_cancellation_is_answered() -> None:
    hold = Request(7, SetMode(FlightMode.HOLD), UNTIL_NS)
    assert "was cancelled" in (await failure_of(FakeDriver(asyncio.CancelledError()), hold) or "")


async def test_cancelled_request_is_not_answered() -> None:
    driver = FakeDriver()
    runner, answered = runner_of(driver)
    runner.start(Request(7, SetMode(FlightMode.HOLD), UNTIL_NS))
    while not driver.asked:
        await asyncio.sleep(0)
    runner.cancel(7)
    await runner.close()
    assert runner.take_answers() == ()
    assert not answered.is_set()


async def test_requests_that_move_are_abandoned_with_an_answer() -> None:
    driver = FakeDriver()
    runner, _ = runner_of(driver)
    runner.start(Request(7, SetMode(FlightMode.OFFBOARD), UNTIL_NS))
    runner.start(Request(8, FindGimbal(), UNTIL_NS))
    runner.start(Request(9, Arm(), UNTIL_NS))  # has not begun yet
    runner.abandon_motion("suspended")
    await asyncio.sleep(0)
    await runner.close()
    answers = runner.take_answers()
    assert [(answer.identifier, answer.refused) for answer in answers[:2]] == [
        (7, "suspended"),
        (9, "suspended"),
    ]
    assert driver.asked == []
