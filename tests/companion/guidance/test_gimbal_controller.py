"""Gimbal requests of guidance: their order, rejected requests, and missing answers."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.guidance.behaviour import BehaviourContext
from companion.guidance.behaviours.gimbal_pointing import PointGimbalBehaviour
from companion.guidance.gimbal.controller import (
    FIND_TIMEOUT_S,
    RELEASE_TIMEOUT_S,
    GimbalController,
    GimbalMounting,
    direction_text,
)
from companion.guidance.interface import (
    Answer,
    FindGimbal,
    OutputCollector,
    PointGimbal,
    ReleaseGimbal,
    TakeGimbal,
)
from companion.vehicle.gimbal import NOBODY, GimbalAim, GimbalState
from companion.vehicle.state import VehicleState
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle

DOWN = PointGimbalBehaviour(GimbalAim(-0.5, 0.3))
OWN, STATION = (1, 191), (245, 190)


class ControllerHarness:
    """A controller stepped every 50 ms; requests are answered at the next step, refused as in `refuse`."""

    def __init__(self, mounting: GimbalMounting = GimbalMounting()) -> None:  # noqa: B008 - frozen
        self.controller = GimbalController(mounting)
        self.out = OutputCollector()
        self.vehicle = KinematicVehicle()
        self.began_ns = self.vehicle.now_ns
        # Only the control status is known: no owner.
        self.gimbal: GimbalState | None = GimbalState(1, status_ns=self.began_ns, primary_control=NOBODY)
        self.refuse: dict[type, str] = {}
        self.answering = True
        self.asked: list[str] = []
        self.messages: list[str] = []
        self._answers: list[Answer] = []

    @property
    def state(self) -> VehicleState:
        return replace(self.vehicle.state, gimbal=self.gimbal)

    def run(self, behaviour: PointGimbalBehaviour | None, count: int = 5, *, ending: bool = False) -> None:
        for _ in range(count):
            self.vehicle.now_ns += 50_000_000
            now_ns = self.vehicle.now_ns
            self.out.now_ns, self.out.requests, self.out.events = now_ns, [], []
            answers, self._answers = self._answers, []
            for answer in answers:
                self.controller.take_answer(answer, now_ns, self.out)
            if ending:
                self.controller.end(now_ns, self.state, self.out)
            else:
                self.controller.update(BehaviourContext(now_ns, self.state), behaviour, self.out)
            self.messages += [event.message for event in self.out.events]
            for request in self.out.requests:
                self.asked.append(_words(request.action))
                if self.answering:
                    refused = self.refuse.get(type(request.action))
                    self._answers.append(Answer(request.identifier, refused))

    def problem(self) -> str:
        return self.controller.snapshot(self.vehicle.now_ns, self.state).problem


def _words(action: object) -> str:
    match action:
        case TakeGimbal():
            return "take"
        case PointGimbal(aim):
            return f"point {direction_text(aim)}"
        case ReleaseGimbal():
            return "release"
        case FindGimbal():
            return "find"
    raise AssertionError(action)


def test_control_is_taken_pointed_and_released() -> None:
    harness = ControllerHarness()
    harness.run(None)
    assert harness.asked == []
    harness.run(DOWN)
    taken, pointed = harness.asked
    assert taken == "take"
    assert pointed.startswith("point 29° down, 17° ")
    assert pointed.endswith("right")
    harness.run(None)
    assert harness.asked[2:] == ["release"]
    harness.run(None, ending=True)
    assert len(harness.asked) == 3, "released once"
    assert harness.controller.released


def test_held_control_is_released_when_the_service_ends() -> None:
    harness = ControllerHarness()
    harness.run(DOWN)
    harness.run(DOWN, 2, ending=True)
    assert harness.asked[-1] == "release"
    assert harness.controller.released


def test_refused_aim_is_logged_once_and_not_repeated() -> None:
    harness = ControllerHarness()
    harness.refuse[PointGimbal] = "pointing denied"
    harness.run(DOWN, 40)
    taken, pointed = harness.asked
    assert taken == "take"
    assert pointed.startswith("point 29° down, 17° ")
    assert pointed.endswith("right")
    assert len(harness.messages) == 1
    assert "denied" in harness.messages[0]
    assert "denied" in harness.problem()


def test_client_that_took_control_is_named() -> None:
    harness = ControllerHarness()
    harness.run(DOWN)
    now_ns = harness.vehicle.now_ns
    taken = replace(harness.state, gimbal=GimbalState(1, status_ns=now_ns, primary_control=STATION))
    assert harness.controller.snapshot(now_ns, taken).controlled_by == "245/190"
    assert harness.controller.snapshot(now_ns, harness.state).controlled_by == ""


def test_control_granted_while_ending_is_released() -> None:
    harness = ControllerHarness()
    harness.answering = False
    harness.run(DOWN)
    harness.run(DOWN, 3, ending=True)
    assert harness.asked == ["take"]
    assert not harness.controller.released
    harness._answers.append(Answer(1))
    harness.answering = True
    harness.run(DOWN, 2, ending=True)
    assert harness.asked == ["take", "release"]
    assert harness.controller.released


@pytest.mark.parametrize(("shown", "asked"), [(OWN, ["take", "release"]), (STATION, ["take"])])
def test_unanswered_request_is_released_if_shown_as_ours(shown: tuple[int, int], asked: list[str]) -> None:
    harness = ControllerHarness()
    harness.answering = False
    harness.run(DOWN)
    steps = round(RELEASE_TIMEOUT_S / 0.05) + 2
    for _ in range(2 * steps):
        harness.gimbal = GimbalState(1, status_ns=harness.vehicle.now_ns, primary_control=shown)
        harness.run(DOWN, 1, ending=True)
    assert harness.asked == asked
    assert harness.controller.released


def test_failed_release_is_logged() -> None:
    harness = ControllerHarness()
    harness.refuse[ReleaseGimbal] = "release failed"
    harness.run(DOWN)
    harness.run(None)
    assert ["release failed" in message for message in harness.messages] == [True]


def test_waiting_point_command_is_answered_at_the_end() -> None:
    harness = ControllerHarness()
    now_ns = harness.vehicle.now_ns
    harness.gimbal = GimbalState(
        1,
        status_ns=now_ns,
        primary_control=NOBODY,
        attitude_ns=now_ns,
        attitude=(1.0, 0.0, 0.0, 0.0),
        information_ns=now_ns,
    )
    harness.controller.point(7, GimbalAim(-0.5), BehaviourContext(now_ns, harness.state), harness.out)
    assert harness.out.results == []
    harness.run(None, 1, ending=True)
    assert [result.identifier for result in harness.out.results] == [7]
    assert not harness.out.results[0].outcome.success


def test_missing_camera_gimbal_is_searched_again() -> None:
    harness = ControllerHarness(GimbalMounting(carries_camera=True))
    harness.gimbal = None
    harness.run(None, round(11.0 / 0.05))
    assert harness.asked == ["find"] * 3
    assert FIND_TIMEOUT_S < 5.0
