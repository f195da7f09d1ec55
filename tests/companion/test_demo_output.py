"""What the demonstration does when its mission fails."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from companion import demo
from companion.service import Service
from companion.vehicle.state import LandedState, VehicleState

FLYING = VehicleState(armed=True, ready_to_arm=True, landed=LandedState.IN_AIR)
LANDED = VehicleState(ready_to_arm=True, landed=LandedState.ON_GROUND)


class Driver:
    """A vehicle that is ready to be armed."""

    state = FLYING

    def subscribe(self, callback: Callable[[VehicleState], None]) -> Callable[[], None]:
        callback(self.state)
        return lambda: None


class FailingService:
    """Its missions fail in the air; a return lands."""

    def __init__(self, *, in_command: bool) -> None:
        self.driver, self.guidance = Driver(), SimpleNamespace(in_command=in_command)
        self.commands: list[str] = []

    async def command(self, text: str) -> dict[str, Any]:
        self.commands.append(text)
        if text == "rtl":
            self.driver.state = LANDED
        return {"success": text == "rtl", "reason": "the battery has 14%", "steps": []}


@pytest.mark.parametrize("in_command", [True, False])
async def test_a_failed_demo_returns_unless_the_pilot_flies(in_command: bool) -> None:
    service, flight = FailingService(in_command=in_command), demo._Flight()
    await demo._mission(cast(Service, service), flight)
    assert service.commands[1:] == (["rtl"] if in_command else [])
    assert flight.failure is not None
    assert flight.failure.startswith("the battery has 14%")
    assert flight.on_ground is flight.ended is in_command
