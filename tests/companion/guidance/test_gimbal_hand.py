"""What the hand asks of a driver, in which order, and what it does with a driver that fails."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest
from kinematic_vehicle import KinematicVehicle

from companion.guidance.gimbal_hand import GimbalHand, direction_text
from companion.guidance.gimbal_pointing import PointGimbalBehaviour
from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.gimbal import NOBODY, GimbalAim, GimbalState
from companion.vehicle.state import VehicleState


class RecordingDriver:
    """Does what it is told, and remembers it."""

    own_address = (1, 191)

    def __init__(self, fault: Exception | None = None) -> None:
        self.asked: list[str] = []
        self.fault = fault
        self.state = VehicleState()
        self.answers: asyncio.Event | None = None
        self.kept: Exception | None = None

    async def find_gimbal(self) -> bool:
        return True

    async def take_gimbal(self) -> None:
        self.asked.append("take")
        if self.answers is not None:
            await self.answers.wait()

    async def point_gimbal(self, aim: GimbalAim) -> None:
        self.asked.append(f"point {direction_text(aim)}")
        if self.fault is not None:
            raise self.fault

    async def give_gimbal_back(self) -> None:
        self.asked.append("give back")
        if self.kept is not None:
            raise self.kept


class Desk:
    """The hand's turns, by a clock that tests turn."""

    def __init__(self, fault: Exception | None = None) -> None:
        self.driver = RecordingDriver(fault)
        self.events: list[str] = []
        self.vehicle = KinematicVehicle()
        self.hand = GimbalHand(
            self.driver,
            lambda level, text: self.events.append(text),
            clock_ns=lambda: self.vehicle.now_ns,
        )
        self.began_ns = self.vehicle.now_ns

    @property
    def state(self) -> VehicleState:
        """With a gimbal of which only is known that nobody has it: what is shown later is not tested here."""
        gimbal = GimbalState(1, status_ns=self.began_ns, primary_control=NOBODY)
        return replace(self.vehicle.state, gimbal=gimbal)

    async def turn(self, behaviour: PointGimbalBehaviour | None, count: int = 5) -> None:
        for _ in range(count):
            self.vehicle.now_ns += 50_000_000
            self.hand.update(self.vehicle.now_ns, self.state, behaviour)
            await asyncio.sleep(0)
            await asyncio.sleep(0)


DOWN = PointGimbalBehaviour(GimbalAim(-0.5, 0.3))


async def test_for_a_behaviour_it_is_taken_pointed_and_given_back() -> None:
    desk = Desk()
    await desk.turn(None)
    assert desk.driver.asked == []
    await desk.turn(DOWN)
    assert desk.driver.asked == ["take", "point 29° down, 17° to the right"]
    await desk.turn(None)
    assert desk.driver.asked[2:] == ["give back"]
    await desk.hand.close()
    assert len(desk.driver.asked) == 3, "what was given back is not given back again"


async def test_what_is_held_when_the_service_ends_is_given_back() -> None:
    desk = Desk()
    await desk.turn(DOWN)
    await desk.hand.close()
    assert desk.driver.asked[-1] == "give back"


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (CommandRefusedError("the vehicle refused to point the gimbal (denied)"), "(denied)"),
        (ZeroDivisionError("a fault of ours"), "ZeroDivisionError: a fault of ours"),
    ],
)
async def test_what_goes_wrong_is_said_once_and_nothing_more_is_asked(fault, words) -> None:
    desk = Desk(fault)
    await desk.turn(DOWN, 40)
    assert desk.driver.asked == ["take", "point 29° down, 17° to the right"]
    (event,) = desk.events
    assert event.startswith("the gimbal is not moved: ")
    assert words in event
    assert words in desk.hand.sight(desk.vehicle.now_ns, desk.state).problem


async def test_what_is_refused_is_said_though_the_behaviour_ends_by_it_first() -> None:
    desk = Desk(CommandRefusedError("command 1000: denied"))
    while "point" not in " ".join(desk.driver.asked):
        await desk.turn(DOWN, 1)
    # The pilot comes first in a turn: what it ended for this reason is not there when the hand looks.
    assert desk.hand.sight(desk.vehicle.now_ns, desk.state).problem == "command 1000: denied"
    await desk.turn(None)
    assert desk.events == ["the gimbal is not moved: command 1000: denied"]


async def test_who_took_it_is_named_before_the_next_turn_too() -> None:
    desk = Desk()
    await desk.turn(DOWN)
    now_ns = desk.vehicle.now_ns
    taken = GimbalState(1, status_ns=now_ns, primary_control=(245, 190))
    assert desk.hand.sight(now_ns, replace(desk.state, gimbal=taken)).elsewhere == "245/190"
    assert desk.hand.sight(now_ns, desk.state).elsewhere == ""


async def test_a_gimbal_is_found_when_it_is_known_where_it_looks_and_who_has_it() -> None:
    desk = Desk()
    now_ns = desk.vehicle.now_ns
    looking = GimbalState(1, attitude_ns=now_ns, attitude=(1.0, 0.0, 0.0, 0.0))
    desk.driver.state = replace(desk.state, gimbal=looking)
    finding = asyncio.create_task(desk.hand.find())
    await asyncio.sleep(0)
    desk.hand.update(now_ns, desk.driver.state, None)
    await asyncio.sleep(0)
    assert not finding.done(), "its manager has not told who has it"
    told = replace(looking, status_ns=now_ns, primary_control=NOBODY)
    desk.hand.update(now_ns, replace(desk.state, gimbal=told), None)
    await finding


async def test_of_a_gimbal_that_was_not_found_in_time_nothing_is_left(monkeypatch) -> None:
    monkeypatch.setattr("companion.guidance.gimbal_hand.FIND_TIMEOUT_S", 0.0)
    desk = Desk()
    desk.driver.state = desk.state
    await desk.hand.find()
    assert desk.hand._heard == []


async def test_what_is_granted_while_the_service_ends_is_given_back() -> None:
    desk = Desk()
    desk.driver.answers = asyncio.Event()
    await desk.turn(DOWN)
    closing = asyncio.create_task(desk.hand.close())
    await asyncio.sleep(0)
    await desk.turn(DOWN)
    assert desk.driver.asked == ["take"], "closed, it is moved no more, and the answer is waited for"
    desk.driver.answers.set()
    await closing
    assert desk.driver.asked == ["take", "give back"]


@pytest.mark.parametrize(("shown", "asked"), [((1, 191), ["take", "give back"]), ((245, 190), ["take"])])
async def test_what_is_never_answered_is_given_back_if_the_manager_shows_it_to_be_ours(
    monkeypatch, shown, asked
) -> None:
    monkeypatch.setattr("companion.guidance.gimbal_hand.CLOSE_TIMEOUT_S", 0.01)
    desk = Desk()
    desk.driver.answers = asyncio.Event()
    await desk.turn(DOWN)
    gimbal = GimbalState(1, status_ns=desk.vehicle.now_ns + 1, primary_control=shown)
    desk.driver.state = replace(desk.state, gimbal=gimbal)
    await desk.hand.close()
    assert desk.driver.asked == asked


async def test_an_operators_word_that_still_waits_when_the_service_ends_is_answered() -> None:
    desk = Desk()
    pointing = asyncio.create_task(desk.hand.point(GimbalAim(-0.5), None))
    await asyncio.sleep(0)
    await desk.hand.close()
    assert not (await pointing).success
    assert desk.driver.asked == []


async def test_that_it_could_not_be_given_back_is_said() -> None:
    desk = Desk()
    desk.driver.kept = CommandRefusedError("the vehicle refused to give the gimbal back (failed)")
    await desk.turn(DOWN)
    await desk.turn(None)
    assert desk.events == [
        "the gimbal could not be given back: the vehicle refused to give the gimbal back (failed)"
    ]
