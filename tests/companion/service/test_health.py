"""The check of the autopilot's parameters when the link has opened or returned."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest

from companion.bench.lockstep_flight import plain_settings
from companion.guidance.core import Guidance
from companion.perception.cameras import PerceptionCamera
from companion.service.factory import guidance_options
from companion.service.health import Health
from companion.service.inputs import InputAssembler
from companion.service.other_commanders import OtherCommanders
from companion.service.systemd_notify import SystemdNotifier
from companion.settings.vehicle import VehicleSection
from companion.vehicle.driver import CommandRefusedError, Driver
from companion.vehicle.state import VehicleState
from companion.vehicle.vehicle_type import PX4, VtolState


class FakeDriver:
    """An autopilot with some parameters."""

    def __init__(self, autopilot: str | None, parameters: dict[str, float]) -> None:
        self.state = VehicleState(autopilot=autopilot)
        self.link_count = 1
        self._parameters = parameters

    async def get_parameter(self, name: str) -> float:
        if name not in self._parameters:
            raise CommandRefusedError(f"parameter {name}: no answer")
        return self._parameters[name]

    def send_heartbeat(self, *_: Any, **__: Any) -> None:
        pass


def health_of(
    autopilot: str | None, parameters: dict[str, float]
) -> tuple[Health, FakeDriver, InputAssembler, list[tuple[str, str]]]:
    """The check, its driver, what guidance gets, and the events."""
    events: list[tuple[str, str]] = []

    def on_event(level: str, text: str) -> None:
        events.append((level, text))

    settings = plain_settings()
    inputs = InputAssembler(settings, [PerceptionCamera(settings.of_camera(None))], on_event)
    driver = FakeDriver(autopilot, parameters)
    others = OtherCommanders(VehicleSection(), "here", 0, on_event)
    health = Health(cast(Driver, driver), inputs, (), SystemdNotifier({}), others, on_event)
    return health, driver, inputs, events


async def check(
    autopilot: str | None, parameters: dict[str, float]
) -> tuple[InputAssembler, list[tuple[str, str]]]:
    """Run the check; returns what guidance gets, and the events."""
    health, _, inputs, events = health_of(autopilot, parameters)
    await health.check()
    return inputs, events


@pytest.mark.parametrize(
    ("guided_timeout_s", "warned"),
    [(3.0, ["GUID_TIMEOUT is 3 s"]), (1.0, []), (None, ["parameter GUID_TIMEOUT: no answer: check"])],
)
async def test_long_guided_timeout_is_warned(guided_timeout_s: float | None, warned: list[str]) -> None:
    parameters = {} if guided_timeout_s is None else {"GUID_TIMEOUT": guided_timeout_s}
    inputs, events = await check("ArduPilot", parameters)
    assert [level for level, _ in events] == ["warning"] * len(warned)
    assert all(text.startswith(begin) for (_, text), begin in zip(events, warned, strict=True))
    assert inputs.altitude_acceptance_m is None


@pytest.mark.parametrize(
    ("parameters", "read", "warned"),
    [({"NAV_MC_ALT_RAD": 1.6}, 1.6, 0), ({}, None, 1)],
)
async def test_guidance_gets_px4s_altitude_acceptance(
    parameters: dict[str, float], read: float | None, warned: int
) -> None:
    inputs, events = await check("PX4", parameters)
    assert inputs.altitude_acceptance_m == read
    assert [level for level, _ in events] == ["warning"] * warned
    for _, text in events:
        assert text.startswith("parameter NAV_MC_ALT_RAD: ")
        assert "no answer: 0.8 m " in text


async def test_parameter_changed_between_links_is_read_again() -> None:
    parameters = {"NAV_MC_ALT_RAD": 1.6}
    health, driver, inputs, events = health_of("PX4", parameters)
    guidance = Guidance(guidance_options(plain_settings(), (1, 191)))

    async def step_and_read() -> None:
        health.after_step(0, guidance)
        assert inputs.altitude_acceptance_m is None  # nothing stale is kept until the answer
        for _ in range(5):
            await asyncio.sleep(0)

    running = asyncio.create_task(health.run())
    await step_and_read()
    assert inputs.altitude_acceptance_m == 1.6
    parameters["NAV_MC_ALT_RAD"] = 0.5
    health.after_step(0, guidance)
    assert inputs.altitude_acceptance_m == 1.6  # the link has not changed
    driver.link_count += 1
    await step_and_read()
    assert inputs.altitude_acceptance_m == 0.5
    parameters.clear()
    driver.link_count += 1
    await step_and_read()
    assert inputs.altitude_acceptance_m is None
    assert [level for level, _ in events] == ["warning"]
    running.cancel()


def test_vehicle_that_is_not_flown_is_reported_once_per_change() -> None:
    health, driver, _, events = health_of("PX4", {})
    guidance = Guidance(guidance_options(plain_settings(), (1, 191)))

    def step(mav_type: int | None, vtol_state: VtolState | None) -> list[str]:
        autopilot = None if mav_type is None else PX4
        driver.state = VehicleState(
            autopilot="PX4", mav_type=mav_type, mav_autopilot=autopilot, vtol_state=vtol_state
        )
        events.clear()
        health.after_step(0, guidance)
        health.after_step(0, guidance)
        return [level for level, _ in events]

    tiltrotor, fixed_wing = 21, 1
    assert step(None, None) == []
    assert step(tiltrotor, None) == []  # not known yet
    assert step(tiltrotor, VtolState.FW) == ["error"]
    assert step(tiltrotor, VtolState.MC) == ["info"]
    assert step(fixed_wing, VtolState.UNDEFINED) == ["error"]


async def test_unknown_autopilot_is_asked_for_no_parameter() -> None:
    assert (await check(None, {}))[1] == []
