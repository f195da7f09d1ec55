"""The check of the autopilot's parameters when the link has opened or returned."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from companion.bench.lockstep_flight import plain_settings
from companion.guidance.core import Guidance
from companion.perception.cameras import PerceptionCamera
from companion.service.factory import guidance_options
from companion.service.health import Health
from companion.service.inputs import InputAssembler
from companion.service.other_commanders import FOREIGN_OFFBOARD, OtherCommanders
from companion.service.systemd_notify import SystemdNotifier
from companion.settings.vehicle import VehicleSection
from companion.vehicle.autopilot_parameters import NOTHING_READ, AutopilotParameters, FirmwareVersion
from companion.vehicle.driver import CommandRefusedError, Driver, SystemStatus
from companion.vehicle.state import FlightMode, VehicleState
from companion.vehicle.vehicle_type import ARDUPILOT, PX4, VtolState


class FakeDriver:
    """An autopilot with some parameters."""

    library = "fake"
    own_address = (1, 191)

    def __init__(
        self, autopilot: str | None, parameters: dict[str, float], version: FirmwareVersion | None
    ) -> None:
        self.state = VehicleState(autopilot=autopilot)
        self.link_count = 1
        self.on_read: Callable[[], object] = lambda: None
        self._parameters, self._version = parameters, version
        self.changes = 0

    async def firmware_version(self) -> FirmwareVersion:
        if self._version is None:
            raise CommandRefusedError("firmware version: no AUTOPILOT_VERSION")
        return self._version

    async def get_parameter(self, name: str) -> float:
        self.on_read()
        if name not in self._parameters:
            raise CommandRefusedError(f"parameter {name}: no answer")
        return self._parameters[name]

    def change_address(self) -> bool:
        self.changes += 1
        return True

    def send_heartbeat(self, *_: Any, **__: Any) -> None:
        pass


def guidance() -> Guidance:
    return Guidance(guidance_options(plain_settings()))


def health_of(
    autopilot: str | None, parameters: dict[str, float], version: FirmwareVersion | None
) -> tuple[Health, FakeDriver, InputAssembler, list[tuple[str, str]]]:
    """The check, its driver, what guidance gets, and the events."""
    events: list[tuple[str, str]] = []

    def on_event(level: str, text: str) -> None:
        events.append((level, text))

    settings = plain_settings()
    inputs = InputAssembler(settings, [PerceptionCamera(settings.of_camera(None))], on_event)
    driver = FakeDriver(autopilot, parameters, version)
    others = OtherCommanders(VehicleSection(), "here", 0, on_event)
    health = Health(cast(Driver, driver), inputs, (), SystemdNotifier({}), others, on_event)
    return health, driver, inputs, events


async def check(
    autopilot: str | None, parameters: dict[str, float], version: FirmwareVersion | None
) -> tuple[InputAssembler, list[tuple[str, str]]]:
    """Run the check; returns what guidance gets, and the events."""
    health, _, inputs, events = health_of(autopilot, parameters, version)
    await health.check()
    return inputs, events


V1_16, V1_18 = FirmwareVersion(1, 16), FirmwareVersion(1, 18)
PX4_VALUES = {
    "COM_OF_LOSS_T": 1.0,
    "COM_OBL_RC_ACT": 0.0,
    "COM_RC_IN_MODE": 3.0,
    "NAV_RCL_ACT": 2.0,
    "NAV_MC_ALT_RAD": 0.8,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MAN_OVERRIDE_SPD": 1.0,  # since v1.18
}
PX4_VALUES_BEFORE = {**PX4_VALUES, "COM_RC_OVERRIDE": 1.0}
del PX4_VALUES_BEFORE["MAN_OVERRIDE_SPD"]
COPTER_VALUES = {
    "GUID_TIMEOUT": 1.0,
    "GUID_OPTIONS": 0.0,
    "FS_GCS_ENABLE": 0.0,
    "FS_GCS_TIMEOUT": 5.0,
    "MAV_GCS_SYSID": 255.0,
}


@pytest.mark.parametrize("kind", [128, 255])
@pytest.mark.parametrize(
    ("minor", "values"),
    [*((minor, PX4_VALUES_BEFORE) for minor in (14, 15, 16, 17)), (18, PX4_VALUES), (19, PX4_VALUES)],
)
async def test_everything_is_read_once_for_guidance(minor: int, values: dict[str, float], kind: int) -> None:
    version = FirmwareVersion(1, minor, 0, kind)
    inputs, events = await check("PX4", values, version)
    assert inputs.parameters == AutopilotParameters("PX4", version, 1, tuple(values.items()))
    assert "warning" not in [level for level, _ in events]


async def test_what_cannot_be_read_is_reported_by_name() -> None:
    inputs, events = await check("PX4", {"COM_OF_LOSS_T": 1.0}, None)
    warned = [text for level, text in events if level == "warning"]
    assert len(warned) == len(PX4_VALUES_BEFORE)  # all but one, and the version
    named = sum(name in text for name in PX4_VALUES_BEFORE for text in warned)
    assert named == len(PX4_VALUES_BEFORE) - 1
    assert inputs.parameters.get("NAV_MC_ALT_RAD") is None


def said(events: list[tuple[str, str]], *, about: str) -> list[tuple[str, str]]:
    return [(level, text) for level, text in events if about in text]


@pytest.mark.parametrize(
    ("autopilot", "version", "values", "level", "words"),
    [
        ("PX4", FirmwareVersion(1, 16, 2), {}, "warning", "1.16.2 changes to position mode and sinks"),
        ("PX4", FirmwareVersion(1, 16, 2), {"COM_OBL_RC_ACT": 5.0}, "info", "holds its position after 1.1 s"),
        ("PX4", FirmwareVersion(1, 18), {}, "info", "1.18.0 returns home after 1.1 s"),
        ("PX4", FirmwareVersion(1, 18), {"COM_OF_LOSS_T": 5.0}, "warning", "after 5.1 s"),
        ("PX4", None, {}, "warning", "not known"),
        ("ArduPilot", FirmwareVersion(4, 7), {}, "info", "GUID_TIMEOUT is 1 s"),
        ("ArduPilot", FirmwareVersion(4, 7), {"GUID_TIMEOUT": 3.0}, "warning", "GUID_TIMEOUT is 3 s"),
    ],
)
async def test_effect_of_silence_is_reported_at_connect(
    autopilot: str, version: FirmwareVersion | None, values: dict[str, float], level: str, words: str
) -> None:
    defaults = PX4_VALUES if autopilot == "PX4" else COPTER_VALUES
    health, _, _, events = health_of(autopilot, {**defaults, **values}, version)
    health.after_step(0, guidance())
    await health.check()
    health.after_step(1, guidance())
    health.after_step(2, guidance())
    (line,) = said(events, about="without setpoints")
    assert line[0] == level
    assert words in line[1]


async def test_effect_of_silence_is_reported_again_when_sticks_come() -> None:
    health, driver, _, events = health_of("PX4", PX4_VALUES, FirmwareVersion(1, 16))
    health.after_step(0, guidance())
    await health.check()
    health.after_step(1, guidance())
    driver.state = replace(driver.state, sticks_present=True)
    health.after_step(2, guidance())
    assert [level for level, _ in said(events, about="without setpoints")] == ["warning", "info"]


@pytest.mark.parametrize(
    ("version", "values", "words"),
    [
        (V1_16, {"COM_RC_OVERRIDE": 1.0}, "do nothing in OFFBOARD (COM_RC_OVERRIDE 1)"),
        (V1_16, {"COM_RC_OVERRIDE": 3.0}, "takes over from OFFBOARD (COM_RC_OVERRIDE 3)"),
        (V1_16, {"COM_RC_OVERRIDE": 3.0, "COM_RC_IN_MODE": 4.0}, "ignores all sticks"),
        (V1_16, {}, "COM_RC_OVERRIDE could not"),
        (
            V1_18,
            {"MAN_OVERRIDE_SPD": 1.0},
            "quickly takes over from OFFBOARD (MAN_OVERRIDE",
        ),
        (
            V1_18,
            {"MAN_OVERRIDE_SPD": 0.0},
            "quickly takes over from OFFBOARD (MAN_OVERRIDE",
        ),
        (V1_18, {"MAN_OVERRIDE_SPD": -1.0}, "do nothing in OFFBOARD (MAN_OVERRIDE_SPD -1)"),
        (V1_18, {"COM_RC_OVERRIDE": 3.0}, "MAN_OVERRIDE_SPD could not"),
        (V1_18, {"MAN_OVERRIDE_SPD": 1.0, "COM_RC_IN_MODE": 4.0}, "ignores all sticks"),
        (None, {}, "COM_RC_OVERRIDE could not"),
    ],
)
async def test_effect_of_sticks_on_px4_is_reported_at_connect(
    version: FirmwareVersion | None, values: dict[str, float], words: str
) -> None:
    inputs, events = await check("PX4", values, version)
    assert words in (inputs.parameters.sticks_text or "")
    assert ("info", inputs.parameters.sticks_text) in events


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({}, "do nothing in GUIDED, the yaw stick turns"),
        ({"GUID_OPTIONS": 4.0}, "do nothing in GUIDED, the yaw stick too"),
    ],
)
async def test_effect_of_sticks_on_copter_is_reported_at_connect(
    values: dict[str, float], words: str
) -> None:
    _, events = await check("ArduPilot", {**COPTER_VALUES, **values}, FirmwareVersion(4, 7))
    (line,) = said(events, about="sticks")
    assert line[0] == "info"
    assert words in line[1]


async def test_parameter_changed_between_links_is_read_again() -> None:
    values = dict(PX4_VALUES)
    health, driver, inputs, events = health_of("PX4", values, FirmwareVersion(1, 18))

    async def step_and_read() -> None:
        health.after_step(0, guidance())
        assert inputs.parameters is NOTHING_READ  # nothing stale is kept until the answer
        for _ in range(5):
            await asyncio.sleep(0)

    running = asyncio.create_task(health.run())
    await step_and_read()
    assert inputs.parameters.altitude_acceptance_m == 0.8
    values["NAV_MC_ALT_RAD"] = 0.5
    health.after_step(0, guidance())
    assert inputs.parameters.altitude_acceptance_m == 0.8  # the link has not changed
    driver.link_count += 1
    await step_and_read()
    health.after_step(0, guidance())
    assert inputs.parameters.altitude_acceptance_m == 0.5
    assert len(said(events, about="without setpoints")) == 2  # of each connection
    del values["NAV_MC_ALT_RAD"]
    driver.link_count += 1
    await step_and_read()
    assert inputs.parameters.altitude_acceptance_m is None
    running.cancel()


def test_vehicle_that_is_not_flown_is_reported_once_per_change() -> None:
    health, driver, _, events = health_of("PX4", {}, None)

    def step(mav_type: int | None, vtol_state: VtolState | None) -> list[str]:
        autopilot = None if mav_type is None else PX4
        driver.state = VehicleState(
            autopilot="PX4", mav_type=mav_type, mav_autopilot=autopilot, vtol_state=vtol_state
        )
        events.clear()
        health.after_step(0, guidance())
        health.after_step(0, guidance())
        return [level for level, _ in events]

    tiltrotor, fixed_wing = 21, 1
    assert step(None, None) == []
    assert step(tiltrotor, None) == []  # not known yet
    assert step(tiltrotor, VtolState.FW) == ["error"]
    assert step(tiltrotor, VtolState.MC) == ["info"]
    assert step(fixed_wing, VtolState.UNDEFINED) == ["error"]


def test_ardupilot_that_does_not_say_what_it_is_is_reported() -> None:
    health, driver, _, events = health_of("ArduPilot", {}, None)
    unknown = VehicleState(autopilot="ArduPilot", mav_type=2, mav_autopilot=ARDUPILOT)
    for vtol_state, level in ((None, []), (VtolState.MC, ["error"])):
        driver.state = replace(unknown, vtol_state=vtol_state)
        health.after_step(0, guidance())
        assert [level for level, _ in events] == level
    driver.state = replace(driver.state, is_plane=False)
    health.after_step(0, guidance())
    assert [level for level, _ in events] == ["error", "info"]


async def test_answers_of_an_earlier_link_are_not_used() -> None:
    health, driver, inputs, _ = health_of("PX4", PX4_VALUES, FirmwareVersion(1, 18))
    driver.on_read = lambda: setattr(driver, "link_count", 2)
    await health.check()
    assert inputs.parameters is NOTHING_READ


@pytest.mark.parametrize("in_command", [False, True])
def test_shared_address_is_changed_only_while_not_in_command(in_command: bool) -> None:
    health, driver, _, _ = health_of("PX4", {}, None)
    health.after_step(0, guidance())
    assert driver.changes == 0
    driver.state = VehicleState(address_shared_ns=1)
    health.after_step(10**9, cast(Guidance, SimpleNamespace(in_command=in_command, status="")))
    assert driver.changes == (0 if in_command else 1)


@pytest.mark.parametrize(("lost", "counts"), [(2.0, True), (0.0, False)])
async def test_offboard_counts_as_anothers_by_the_parameters(lost: float, counts: bool) -> None:
    health, driver, _, events = health_of("PX4", {**PX4_VALUES, "NAV_RCL_ACT": lost}, FirmwareVersion(1, 18))
    health.after_step(0, guidance())
    await health.check()
    for second in range(1, 12):
        driver.state = VehicleState(
            autopilot="PX4", mode=FlightMode.OFFBOARD, armed=True, heartbeat_ns=second * 10**9
        )
        health.after_step(second * 10**9, guidance())
    assert bool(said(events, about=FOREIGN_OFFBOARD)) is counts


async def test_unknown_autopilot_is_asked_for_no_parameter() -> None:
    assert (await check(None, {}, None))[1] == []


class Watched(PerceptionCamera):
    """A camera that is blind for a reason."""

    def __init__(self, name: str | None, why: str) -> None:
        super().__init__(plain_settings(), name)
        self._why = why

    def blind(self, now_ns: int) -> str:
        return self._why


@pytest.mark.parametrize(
    ("heartbeat_ns", "cameras", "reasons"),
    [
        (1, {None: ""}, []),
        (0, {None: ""}, ["autopilot: no heartbeat yet"]),
        (1 - 4 * 10**9, {None: ""}, ["autopilot: no heartbeat for 4 s"]),
        (1, {None: "no result yet", "down": ""}, ["camera: no result yet"]),
        (-9 * 10**9, {None: "", "down": "gone"}, ["autopilot: no heartbeat for 9 s", "camera down: gone"]),
    ],
)
def test_unhealthy_has_its_reasons_and_so_has_the_heartbeat(
    heartbeat_ns: int, cameras: dict[str | None, str], reasons: list[str]
) -> None:
    driver = FakeDriver("PX4", {}, None)
    driver.state = VehicleState(heartbeat_ns=heartbeat_ns)
    sent: list[SystemStatus] = []
    driver.send_heartbeat = lambda status, **_: sent.append(status)  # type: ignore[method-assign]
    seen = [Watched(name, why) for name, why in cameras.items()]
    inputs = InputAssembler(plain_settings(), [PerceptionCamera(plain_settings())], lambda *_: None)
    others = OtherCommanders(VehicleSection(), "s", 0, lambda *_: None)
    health = Health(cast(Driver, driver), inputs, cast(Any, seen), SystemdNotifier(), others, lambda *_: None)
    assert health.unhealthy(1) == reasons
    health._send_heartbeat(1, Guidance())
    assert sent == [SystemStatus.CRITICAL if reasons else SystemStatus.ACTIVE]
