"""Every command ends once, with its reason, whatever ends it: guidance and the service's command handler."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from companion.bus.bodies.service import CommandStateBody
from companion.guidance.behaviour import VelocityInput
from companion.guidance.behaviours.select import Select
from companion.guidance.command import COMMANDS, BuildContext
from companion.guidance.grammar import parse
from companion.guidance.interface import CommandInput, GuidanceInput
from companion.service.command_handler import CommandHandler
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import STEP_S, GuidanceHarness, ScriptedGimbal, flying, parked
from tests.companion.guidance.kinematic_vehicle import SeenObject, look
from tests.companion.guidance.test_preconditions import CLASSES, OPTIONS, World
from vision.tracking import Selected

ENDLESS = {
    "hold": "hold",
    "velocity": "velocity",
    "follow-path": "follow-path 0,0,5;9,0,5 laps=0",
    "figure-eight": "figure-eight laps=0",
    "orbit": "orbit car",
    "follow": "follow car",
    "patrol": "patrol points=0,0;9,9 classes=person laps=0",
    "formation": "formation line alpha",
    "gimbal": "gimbal class=car",
}
FINITE = {
    "takeoff": "takeoff 20",
    "land": "land",
    "rtl": "rtl",
    "stop": "stop",
    "hold": "hold 30",
    "goto": "goto 60 0",
    "follow-path": "follow-path 0,0,5;60,0,5",
    "figure-eight": "figure-eight",
    "orbit": "orbit radius=10 laps=1",
    "seek": "seek person",
    "approach": "approach car speed=0.5",
    "follow": "follow car duration=100",
    "policy": "policy approach car",
    "patrol": "patrol points=0,0;60,0 classes=person laps=1",
    "formation": "formation line virtual points=0,0;60,0",
    "land-on-marker": "land-on-marker 3 search=30",
    "mission": "mission m",
    "gimbal": "gimbal pitch=-30",
    "select": "select x=0.4 y=0.4 width=0.1 height=0.1",
}
MISSION = '[[step]]\ndo = "hold"\ntimeout_s = 60\n'
# They fly in a mode of the autopilot.
DELEGATED = {"takeoff", "land", "rtl", "stop"}
WITHOUT_FLIGHT = {"gimbal", "select"}


class Flight:
    """Commands given to the real handler, flown by guidance in a world that has what each needs.

    Attributes:
        states: of all commands, as published. car: in front of the vehicle.
    """

    def __init__(self, *, on_ground: bool = False) -> None:
        self.vehicle = parked() if on_ground else flying()
        if not on_ground:
            self.vehicle.position[2] = -4.0
        self.car = SeenObject("car", 25.0, 0.0, track_id=7, radius_m=1.0)
        self.harness = GuidanceHarness(
            self.vehicle, class_names=CLASSES, options=OPTIONS, inputs=self._inputs
        )
        self.harness.autopilot.gimbal = ScriptedGimbal()
        self.world = World(self.harness, {})
        self.states: list[CommandStateBody] = []
        self.handler = CommandHandler(
            self._read, self._select, lambda: None, lambda *_: None,
            check_requirements=lambda _: None, on_state=self.states.append, service="s",
        )  # fmt: skip
        self._fed = 0
        self._replies: dict[str, asyncio.Task[dict[str, Any]]] = {}
        self.run(0.2)

    def _inputs(self, inputs: GuidanceInput) -> GuidanceInput:
        now_ns = inputs.state.heartbeat_ns
        seen = look(self.vehicle, [self.car], now_ns) if inputs.seen_ns is not None else ()
        moved = VelocityInput("pad", now_ns, now_ns + 10**9, 0.5)
        return replace(self.world.inputs(inputs), targets=seen, velocities=(moved,))

    def _read(self, identifier: int, text: str) -> CommandInput | Select:
        command = parse(text, CLASSES)
        if isinstance(command, Select):
            return command
        if command.aim is not None:
            return CommandInput(identifier, text, aim=command.aim)
        checked = self.harness.guidance.check_requirements
        behaviour = command.build(BuildContext(attachment=MISSION, check_requirements=checked))
        return CommandInput(identifier, text, behaviour, endless=command.endless)

    async def _select(self, _command: Select) -> Selected:
        return Selected(True, "selected", 7, "car")

    async def give(self, text: str) -> str:
        """Give a command; returns its identifier in the states."""
        task = asyncio.create_task(self.handler.execute(text))
        before = len(self.states)
        while len(self.states) == before:
            await asyncio.sleep(0)
        identifier = self.states[-1]["id"]
        self._replies[identifier] = task
        self.harness.step(*self.handler.take_commands())
        self._feed()
        return identifier

    async def reply(self, identifier: str) -> dict[str, Any]:
        async with asyncio.timeout(5.0):
            return await self._replies[identifier]

    def run(self, seconds: float) -> None:
        self.harness.run(seconds)
        self._feed()

    def close(self) -> None:
        self.harness.close()
        self._feed()

    def of(self, identifier: str) -> list[CommandStateBody]:
        return [state for state in self.states if state["id"] == identifier]

    def ended(self, identifier: str) -> bool:
        return self.of(identifier)[-1]["state"] == "ended"

    def run_until_ended(self, identifier: str, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            if self.ended(identifier):
                return
            self.run(STEP_S)

    def _feed(self) -> None:
        for output in self.harness.outputs[self._fed :]:
            self.handler.on_results(output.results, output.endings)
        self._fed = len(self.harness.outputs)


def with_autopilot(**changes: Any) -> Callable[[Flight], None]:
    def change(flight: Flight) -> None:
        for name, value in changes.items():
            setattr(flight.harness.autopilot, name, value)

    return change


def in_mode(mode: FlightMode, **changes: Any) -> Callable[[Flight], None]:
    def change(flight: Flight) -> None:
        with_autopilot(**changes)(flight)
        flight.harness.autopilot.change_mode(mode)

    return change


# What ends every command that flies by setpoints, and a word of its reason.
WAYS: dict[str, tuple[Callable[[Flight], None], str]] = {
    "pilot": (in_mode(FlightMode.POSITION), "pilot took over"),
    "failsafe": (in_mode(FlightMode.HOLD, failsafe=True), "autopilot failsafe"),
    "link lost": (with_autopilot(linked=False), "lost"),
    "standstill": (lambda flight: flight.harness.stand_still(4.0, suspended=True), "suspended"),
    "low battery": (with_autopilot(battery_fraction=0.1), "battery"),
    "position lost": (with_autopilot(position_alive=False), "position"),
    "disarmed": (lambda flight: setattr(flight.vehicle, "armed", False), "disarmed"),
    "process stopped": (lambda flight: flight.harness.stand_still(4.0, suspended=False), "for 4.0 s"),
    "shutdown": (Flight.close, "the service ends"),
}
ALL = sorted({*ENDLESS.values(), *FINITE.values()})
BY_SETPOINTS = [text for text in ALL if text.split()[0] not in DELEGATED | WITHOUT_FLIGHT]


def test_table_has_every_command() -> None:
    assert {*ENDLESS, *FINITE} == set(COMMANDS)
    endless = {word for word, text in ENDLESS.items() if word == "gimbal" or parse(text).endless}
    assert endless == set(ENDLESS)


def check_ended(flight: Flight, identifier: str, *words: str, success: bool = False) -> None:
    """One end, after everything else, with its reason."""
    states = flight.of(identifier)
    assert [state["state"] for state in states].count("ended") == 1, states
    last = states[-1]
    assert (last["state"], last["success"]) == ("ended", success), last
    assert [word for word in words if word not in last["reason"]] == [], last["reason"]
    assert all(state["success"] is None for state in states[:-1])
    assert states == sorted(states, key=lambda state: state["stamp_ns"])
    command = flight.harness.guidance.runner.command
    assert command is None or identifier != f"s-{command.identifier}"


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("text", BY_SETPOINTS)
async def test_flown_command_ends_with_its_reason(text: str, way: str) -> None:
    flight, (end, word) = Flight(), WAYS[way]
    identifier = await flight.give(text)
    flight.run(1.5)
    assert flight.of(identifier)[-1]["state"] in ("accepted", "in_progress"), flight.of(identifier)
    end(flight)
    flight.run_until_ended(identifier, 12.0)
    check_ended(flight, identifier, word)
    assert way == "low battery" or flight.harness.outputs[-1].setpoint is None
    if text in ENDLESS.values():
        assert [state["state"] for state in flight.of(identifier)] == ["accepted", "in_progress", "ended"]
        assert (await flight.reply(identifier))["success"]
    else:
        reply = await flight.reply(identifier)
        assert reply["reason"] == flight.of(identifier)[-1]["reason"]


@pytest.mark.parametrize("by", ["hold", "stop"])
@pytest.mark.parametrize(
    "text", [text for text in ALL if text.split()[0] not in WITHOUT_FLIGHT | {"takeoff"}]
)
async def test_command_is_ended_by_another_one(text: str, by: str) -> None:
    flight = Flight()
    identifier = await flight.give(text)
    if text.split()[0] in DELEGATED:
        assert not flight.ended(identifier)
    else:
        flight.run(1.5)
    await flight.give(by)
    check_ended(flight, identifier, f"replaced by {by}")


@pytest.mark.parametrize(
    ("way", "word"), [("pilot", "pilot took over"), ("link lost", "lost"), ("shutdown", "ends")]
)
@pytest.mark.parametrize("text", ["takeoff 20", "land", "rtl"])
async def test_command_in_an_autopilot_mode_ends_with_its_reason(text: str, way: str, word: str) -> None:
    flight = Flight(on_ground=text.startswith("takeoff"))
    identifier = await flight.give(text)
    flight.run(1.0)
    WAYS[way][0](flight)
    flight.run_until_ended(identifier, 12.0)
    check_ended(flight, identifier, word)


@pytest.mark.parametrize("text", [text for text in ALL if text.split()[0] not in WITHOUT_FLIGHT | DELEGATED])
async def test_refused_command_ends_at_once(text: str) -> None:
    flight = Flight(on_ground=True)
    flight.harness.autopilot.position_alive = False
    flight.run(3.0)
    identifier = await flight.give(text)
    flight.run(STEP_S)
    check_ended(flight, identifier, "needs")
    assert [state["state"] for state in flight.of(identifier)] == ["accepted", "ended"]
    assert not (await flight.reply(identifier))["success"]


FINISHING = {
    "takeoff 4": "",
    "land": "",
    "rtl": "",
    "stop": "",
    "hold 1": "held",
    "goto 4 0": "",
    "follow-path 0,0,5;3,0,5": "",
    "figure-eight radius=3": "",
    "orbit radius=3 laps=1": "",
    "seek car": "car",
    "approach car distance=15": "",
    "follow car duration=2": "",
    "patrol points=0,0;4,0 classes=person laps=1": "",
    "mission m": "",
    "gimbal pitch=-30": "points",
    "select x=0.4 y=0.4 width=0.1 height=0.1": "selected",
}


@pytest.mark.parametrize("text", FINISHING)
async def test_finished_command_ends_with_success(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "MISSION", '[[step]]\ndo = "hold 1"\n')
    flight = Flight(on_ground=text.startswith("takeoff"))
    identifier = await flight.give(text)
    flight.run_until_ended(identifier, 120.0)
    check_ended(flight, identifier, FINISHING[text], success=True)
    reply = await flight.reply(identifier)
    assert (reply["id"], reply["success"]) == (identifier, True)


def car_lost(flight: Flight) -> None:
    flight.car.visible = False


def perception_lost(flight: Flight) -> None:
    flight.harness.perception_age_s = None


@pytest.mark.parametrize("end", [car_lost, perception_lost])
@pytest.mark.parametrize(
    "text", ["follow car occlusion=1", "approach car speed=0.5 lost_timeout=1 retries=0"]
)
async def test_lost_object_or_camera_ends_the_command(text: str, end: Callable[[Flight], None]) -> None:
    flight = Flight()
    identifier = await flight.give(text)
    flight.run(2.0)
    assert not flight.ended(identifier)
    end(flight)
    flight.run_until_ended(identifier, 90.0)
    check_ended(flight, identifier)
    assert flight.of(identifier)[-1]["reason"]


@pytest.mark.parametrize(
    ("end", "word"),
    [
        (car_lost, "car"),
        (Flight.close, "the service ends"),
        (lambda flight: setattr(flight.harness.autopilot.gimbal, "primary", (255, 190)), "primary control"),
    ],
)
async def test_gimbal_kept_on_an_object_ends_with_its_reason(
    end: Callable[[Flight], None], word: str
) -> None:
    flight = Flight()
    identifier = await flight.give("gimbal class=car")
    flight.run(3.0)
    assert flight.of(identifier)[-1]["state"] == "in_progress", flight.of(identifier)
    assert (await flight.reply(identifier))["success"]
    end(flight)
    flight.run_until_ended(identifier, 30.0)
    check_ended(flight, identifier, word)
