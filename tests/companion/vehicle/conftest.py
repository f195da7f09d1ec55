"""A fake autopilot and a driver connected to it."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator

import pytest

from companion.vehicle import stream_requests
from companion.vehicle.driver import Driver
from companion.vehicle.drivers import DriverKind, open_driver
from mavlink_sim.testing import free_port
from tests.companion.vehicle.fake_autopilot import FakeAutopilot


@pytest.fixture(params=["mavsdk", "pymavlink"])
def kind(request: pytest.FixtureRequest) -> DriverKind:
    kind: DriverKind = request.param
    return kind


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
async def autopilot(port: int) -> AsyncIterator[FakeAutopilot]:
    fake = FakeAutopilot(port)
    fake.start()
    yield fake
    await fake.stop()


@pytest.fixture
async def driver(kind: DriverKind, port: int, autopilot: FakeAutopilot) -> AsyncIterator[Driver]:
    """Connected to the fake autopilot."""
    opened = open_driver(kind, f"udpin://127.0.0.1:{port}")
    await opened.connect(10.0)
    yield opened
    await opened.close()


@pytest.fixture
def short_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the measurement of stream rates before the first requests."""
    monkeypatch.setattr(stream_requests, "_MEASURE_S", 0.3)


@pytest.fixture(autouse=True)
def no_loop_noise(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """Fail on anything logged by asyncio's exception handler: destroyed tasks, failed callbacks."""
    yield
    noise = [
        record.getMessage() for record in caplog.records if record.name == "asyncio" and record.levelno >= 40
    ]
    assert not noise
