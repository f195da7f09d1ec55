"""Primary control of the gimbal: taken, released, never taken from another owner."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.guidance.gimbal.controller import SHOWN_WITHIN_S, GimbalControl, GimbalRequest
from companion.guidance.interface import PointGimbal, ReleaseGimbal, TakeGimbal
from companion.vehicle.gimbal import CONTROL_MAX_AGE_S, NOBODY, GimbalAim, GimbalState

OURS, STATION, AUTOPILOT = (1, 191), (245, 190), (1, 1)
DOWN, LEVEL = GimbalAim(-0.5), GimbalAim(0.0)
TAKE, GIVE_BACK = TakeGimbal(), ReleaseGimbal()
SEEK = object()
UNKNOWN_OWNER = "not reported"


class Bench:
    """A manager with a configurable status, stepped every 0.1 s."""

    def __init__(self, primary: tuple[int, int] | None = NOBODY) -> None:
        self.control = GimbalControl()
        self.now_ns = 10_000_000_000
        self.gimbal = GimbalState(device=1, primary_control=primary, status_ns=self.now_ns)

    def turn(
        self, aim: GimbalAim | None, owner: object = SEEK, *, seconds: float = 0.1
    ) -> GimbalRequest | None:
        self.now_ns += round(seconds * 1e9)
        return self.control.update(self.now_ns, self.gimbal, aim, owner)

    def answer(self, refused: str | None = None) -> None:
        self.control.answered(self.now_ns, refused)

    def shows(self, primary: tuple[int, int]) -> None:
        self.now_ns += 1_000_000
        self.gimbal = replace(self.gimbal, primary_control=primary, status_ns=self.now_ns)

    def held(self) -> None:
        assert self.turn(DOWN) == TAKE
        self.answer()
        self.shows(OURS)
        assert self.turn(DOWN) == PointGimbal(DOWN)
        self.answer()
        assert self.control.held

    def denied(self) -> None:
        """We have had control, and the next aim is denied."""
        self.held()
        assert self.turn(LEVEL) == PointGimbal(LEVEL)
        self.answer("denied")


def test_control_is_taken_pointed_and_released() -> None:
    bench = Bench()
    assert bench.turn(None, None) is None
    assert bench.turn(DOWN) == TAKE
    assert bench.turn(DOWN) is None, "one request at a time"
    bench.answer()
    assert bench.turn(DOWN) == PointGimbal(DOWN)
    bench.answer()
    assert bench.control.pointed == DOWN
    assert bench.turn(DOWN) is None, "pointed already"
    assert bench.turn(LEVEL) == PointGimbal(LEVEL)
    bench.answer()
    assert bench.turn(None, None) == GIVE_BACK
    bench.answer()
    assert bench.turn(None, None) is None


def test_moving_aim_is_sent_at_10_hz() -> None:
    bench = Bench()
    bench.held()
    asked = [bench.turn(GimbalAim(-0.5 - 0.01 * n), seconds=0.02) for n in range(1, 51)]
    for request in asked:
        assert request is None or isinstance(request, PointGimbal)
        if request is not None:
            bench.answer()
    assert 1 <= sum(request is not None for request in asked) <= 11


@pytest.mark.parametrize(
    ("primary", "free"), [(NOBODY, True), (OURS, True), (AUTOPILOT, True), (None, False)]
)
def test_control_is_taken_when_free_or_from_the_autopilot(
    primary: tuple[int, int] | None, free: bool
) -> None:
    assert (Bench(primary).turn(DOWN) == TAKE) is free


def test_existing_owner_is_not_displaced() -> None:
    bench = Bench(STATION)
    assert bench.turn(DOWN) is None
    assert bench.control.problem.startswith("245/190 has")
    assert bench.turn(DOWN) is None
    assert bench.turn(None, None) is None, "not ours to release"


@pytest.mark.parametrize(
    ("primary", "words"),
    [
        (STATION, "245/190"),
        (AUTOPILOT, "1/1"),
        (NOBODY, "removed"),
    ],
)
def test_lost_control_is_not_taken_again_for_the_same_owner(primary: tuple[int, int], words: str) -> None:
    bench = Bench()
    bench.held()
    bench.shows(primary)
    assert bench.turn(LEVEL) is None
    assert words in bench.control.problem
    bench.shows(NOBODY)
    assert bench.turn(LEVEL) is None, "released or not, the owner is done"
    assert bench.turn(None, None) is None
    assert bench.turn(LEVEL, object()) == TAKE, "a new owner, and control is free"


def test_stale_status_is_not_a_loss_of_control() -> None:
    bench = Bench(AUTOPILOT)
    assert bench.turn(DOWN) == TAKE
    bench.answer()
    bench.shows(AUTOPILOT)
    assert bench.turn(DOWN) == PointGimbal(DOWN)
    bench.answer()
    bench.shows(AUTOPILOT)
    bench.turn(DOWN, seconds=3.0)
    assert bench.control.problem.startswith("1/1"), "our control never showed"


def test_after_a_denial_it_is_released_only_if_ours() -> None:
    for shown, asked in ((STATION, None), (AUTOPILOT, None), (OURS, GIVE_BACK)):
        bench = Bench()
        bench.denied()
        assert bench.control.problem == "denied"
        assert bench.turn(LEVEL) is None, "owner not known yet"
        bench.shows(shown)
        assert bench.turn(LEVEL) == asked, shown


def test_refused_control_is_not_requested_again() -> None:
    bench = Bench()
    assert bench.turn(DOWN) == TAKE
    bench.answer("refused")
    assert bench.control.problem == "refused"
    assert [bench.turn(DOWN) for _ in range(30)] == [None] * 30


@pytest.mark.parametrize(
    ("shown", "request_", "problem"), [(NOBODY, TAKE, ""), (STATION, None, "245/190 has primary control")]
)
def test_after_a_denial_a_new_owner_requests_only_free_control(
    shown: tuple[int, int], request_: GimbalRequest | None, problem: str
) -> None:
    bench, another = Bench(), object()
    bench.denied()
    assert bench.turn(DOWN, another) is None, "owner not known yet"
    bench.shows(shown)
    assert bench.turn(DOWN, another) == request_
    assert bench.control.problem == problem


def test_after_a_denial_without_status_it_is_not_taken() -> None:
    """The status from before the denial, no owner, is outdated."""
    bench = Bench()
    assert bench.turn(LEVEL) == TAKE
    bench.answer("denied")
    another = object()
    assert [bench.turn(DOWN, another) for _ in range(40)] == [None] * 40
    assert UNKNOWN_OWNER in bench.control.problem
    bench.shows(NOBODY)
    assert bench.turn(DOWN, object()) == TAKE, "known to be free"


def test_failed_release_is_retried_while_still_ours() -> None:
    bench = Bench()
    bench.held()
    assert bench.turn(None, None) == GIVE_BACK
    bench.answer("not answered")
    assert bench.control.held
    assert bench.turn(None, None) is None, "owner not known yet"
    bench.shows(OURS)
    assert bench.turn(None, None) is None, "rate limited"
    assert bench.turn(None, None, seconds=SHOWN_WITHIN_S) == GIVE_BACK
    bench.answer()
    assert not bench.control.held
    assert bench.turn(None, None, seconds=SHOWN_WITHIN_S) is None
    assert bench.control.problem == ""


@pytest.mark.parametrize("shown", [NOBODY, STATION, AUTOPILOT])
def test_failed_release_is_dropped_when_not_ours(shown: tuple[int, int]) -> None:
    bench = Bench()
    bench.held()
    assert bench.turn(None, None) == GIVE_BACK
    bench.answer("not answered")
    bench.shows(shown)
    assert bench.turn(None, None, seconds=2 * SHOWN_WITHIN_S) is None
    assert not bench.control.held


def test_control_with_a_lost_answer_is_released() -> None:
    bench = Bench()
    assert bench.turn(DOWN) == TAKE
    bench.answer("not answered")
    bench.shows(OURS)
    assert bench.turn(DOWN) == GIVE_BACK


def test_control_is_not_taken_while_the_owner_is_unknown() -> None:
    control = GimbalControl()
    assert control.update(1, None, DOWN, SEEK) is None
    assert UNKNOWN_OWNER in control.problem


def test_outdated_status_does_not_count() -> None:
    bench = Bench()
    assert bench.turn(DOWN, seconds=CONTROL_MAX_AGE_S + 0.1) is None
    assert UNKNOWN_OWNER in bench.control.problem
    bench.shows(NOBODY)
    assert bench.turn(DOWN, object(), seconds=CONTROL_MAX_AGE_S - 0.1) == TAKE
