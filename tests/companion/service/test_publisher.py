"""When the next `status` is due, and faults of previews."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from companion.bus import topics
from companion.service.publisher import Publisher
from companion.vehicle.state import FlightMode, VehicleState


@pytest.mark.parametrize("change", [{"armed": True}, {"mode": FlightMode.OFFBOARD}])
async def test_status_follows_arming_and_mode_at_once(
    change: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.service.publisher.topics.STATUS", replace(topics.STATUS, rate_hz=0.01))
    unused: Any = None
    driver: Any = SimpleNamespace(state=VehicleState())
    publisher = Publisher("alpha", unused, driver, unused, unused)
    due = asyncio.create_task(publisher.wait_status_due())
    await asyncio.sleep(0)
    driver.state = replace(driver.state, **change)
    await asyncio.wait_for(due, 20.0)


def test_fault_of_previews_is_logged_once_until_one_is_published(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    unused: Any = None
    faults = [True, True, False, True]

    def publish(*_: object) -> None:
        if faults.pop(0):
            raise RuntimeError("of a test")

    publisher = Publisher("alpha", unused, unused, unused, unused)
    monkeypatch.setattr(publisher, "_publish_preview", publish)
    counts = []
    for _ in range(4):
        publisher.publish_preview(unused, unused)
        counts.append(len(caplog.records))
    assert counts == [1, 1, 1, 2]
