"""The check of the autopilot's parameters when the link has opened."""

from __future__ import annotations

from typing import cast

import pytest

from companion.service.health import Health
from companion.service.other_commanders import OtherCommanders
from companion.service.systemd_notify import SystemdNotifier
from companion.settings.vehicle import VehicleSection
from companion.vehicle.driver import CommandRefusedError, Driver
from companion.vehicle.state import VehicleState


class FakeDriver:
    """An autopilot with one parameter, or none."""

    def __init__(self, autopilot: str | None, guided_timeout_s: float | None) -> None:
        self.state = VehicleState(autopilot=autopilot)
        self._guided_timeout_s = guided_timeout_s

    async def get_parameter(self, name: str) -> float:
        assert name == "GUID_TIMEOUT"
        if self._guided_timeout_s is None:
            raise CommandRefusedError("parameter GUID_TIMEOUT: no answer")
        return self._guided_timeout_s


@pytest.mark.parametrize(
    ("autopilot", "guided_timeout_s", "warned"),
    [
        ("ArduPilot", 3.0, ["GUID_TIMEOUT is 3 s"]),
        ("ArduPilot", 1.0, []),
        ("ArduPilot", None, ["GUID_TIMEOUT cannot"]),
        ("PX4", None, []),
    ],
)
async def test_long_guided_timeout_is_warned(
    autopilot: str, guided_timeout_s: float | None, warned: list[str]
) -> None:
    events: list[tuple[str, str]] = []
    driver = cast(Driver, FakeDriver(autopilot, guided_timeout_s))
    others = OtherCommanders(VehicleSection(), "here", 0, lambda level, text: events.append((level, text)))
    health = Health(driver, (), SystemdNotifier(), others, lambda level, text: events.append((level, text)))
    await health.check()
    assert [level for level, _ in events] == ["warning"] * len(warned)
    assert all(text.startswith(begin) for (_, text), begin in zip(events, warned, strict=True))
