"""Whose the gimbal is: taken for somebody, given back, never fought for. No clock but the tests'."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.guidance.gimbal.control import SHOWN_WITHIN_S, GimbalCommand, GimbalControl, GimbalRequest
from companion.vehicle.gimbal import CONTROL_MAX_AGE_S, NOBODY, GimbalAim, GimbalState

OURS, STATION, AUTOPILOT = (1, 191), (245, 190), (1, 1)
DOWN, LEVEL = GimbalAim(-0.5), GimbalAim(0.0)
TAKE, GIVE_BACK = GimbalRequest(GimbalCommand.TAKE), GimbalRequest(GimbalCommand.GIVE_BACK)
SEEK = object()
UNTOLD = "its manager does not tell who has control of it"


def point(aim: GimbalAim) -> GimbalRequest:
    return GimbalRequest(GimbalCommand.POINT, aim)


class Bench:
    """A manager that shows what it is told to show, 0.1 s a turn."""

    def __init__(self, primary: tuple[int, int] | None = NOBODY) -> None:
        self.control = GimbalControl(OURS)
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
        assert self.turn(DOWN) == point(DOWN)
        self.answer()
        assert self.control.held


def test_it_is_taken_for_somebody_pointed_and_given_back() -> None:
    bench = Bench()
    assert bench.turn(None, None) is None
    assert bench.turn(DOWN) == TAKE
    assert bench.turn(DOWN) is None, "one thing at a time"
    bench.answer()
    assert bench.turn(DOWN) == point(DOWN)
    bench.answer()
    assert bench.control.pointed == DOWN
    assert bench.turn(DOWN) is None, "it looks there"
    assert bench.turn(LEVEL) == point(LEVEL)
    bench.answer()
    assert bench.turn(None, None) == GIVE_BACK
    bench.answer()
    assert bench.turn(None, None) is None


def test_an_aim_that_moves_goes_out_ten_times_a_second() -> None:
    bench = Bench()
    bench.held()
    asked = [bench.turn(GimbalAim(-0.5 - 0.01 * n), seconds=0.02) for n in range(1, 51)]
    for request in asked:
        assert request is None or request.ask is GimbalCommand.POINT
        if request is not None:
            bench.answer()
    assert 1 <= sum(request is not None for request in asked) <= 11


@pytest.mark.parametrize(
    ("primary", "free"), [(NOBODY, True), (OURS, True), (AUTOPILOT, True), (None, False)]
)
def test_it_is_taken_from_nobody_and_from_the_autopilot_itself(
    primary: tuple[int, int] | None, free: bool
) -> None:
    assert (Bench(primary).turn(DOWN) == TAKE) is free


def test_who_has_it_keeps_it() -> None:
    bench = Bench(STATION)
    assert bench.turn(DOWN) is None
    assert bench.control.problem == "245/190 has control of it"
    assert bench.turn(DOWN) is None
    assert bench.turn(None, None) is None, "what is not ours is not given back"


@pytest.mark.parametrize(
    ("primary", "words"),
    [
        (STATION, "245/190 has taken control of it"),
        (AUTOPILOT, "1/1 has taken control of it"),
        (NOBODY, "control of it was taken away"),
    ],
)
def test_who_takes_it_wins_and_it_is_not_taken_again_for_the_same_errand(
    primary: tuple[int, int], words: str
) -> None:
    bench = Bench()
    bench.held()
    bench.shows(primary)
    assert bench.turn(LEVEL) is None
    assert bench.control.problem == words
    bench.shows(NOBODY)
    assert bench.turn(LEVEL) is None, "given back or not: whose errand it was has ended"
    assert bench.turn(None, None) is None
    assert bench.turn(LEVEL, object()) == TAKE, "another errand, and nobody has it"


def test_what_the_manager_showed_before_it_did_as_asked_is_no_loss() -> None:
    bench = Bench(AUTOPILOT)
    assert bench.turn(DOWN) == TAKE
    bench.answer()
    bench.shows(AUTOPILOT)
    assert bench.turn(DOWN) == point(DOWN)
    bench.answer()
    bench.shows(AUTOPILOT)
    bench.turn(DOWN, seconds=3.0)
    assert bench.control.problem == "1/1 has taken control of it", "it never showed that it did"


def test_after_a_denial_it_is_given_back_only_if_it_turns_out_to_be_ours() -> None:
    for shown, asked in ((STATION, None), (AUTOPILOT, None), (OURS, GIVE_BACK)):
        bench = Bench()
        bench.held()
        assert bench.turn(LEVEL) == point(LEVEL)
        bench.answer("denied")
        assert bench.control.problem == "denied"
        assert bench.turn(LEVEL) is None, "not known yet"
        bench.shows(shown)
        assert bench.turn(LEVEL) == asked, shown


def test_a_manager_that_refuses_control_is_not_asked_again() -> None:
    bench = Bench()
    assert bench.turn(DOWN) == TAKE
    bench.answer("refused")
    assert bench.control.problem == "refused"
    assert [bench.turn(DOWN) for _ in range(30)] == [None] * 30


def test_after_a_denial_another_errand_takes_it_anew() -> None:
    bench = Bench()
    bench.held()
    assert bench.turn(LEVEL) == point(LEVEL)
    bench.answer("denied")
    another = object()
    assert bench.turn(DOWN, another) is None, "whose it is now is not known yet"
    bench.shows(NOBODY)
    assert bench.turn(DOWN, another) == TAKE


def test_after_a_denial_it_is_not_taken_from_who_turns_out_to_have_it() -> None:
    bench = Bench()
    bench.held()
    assert bench.turn(LEVEL) == point(LEVEL)
    bench.answer("denied")
    another = object()
    assert bench.turn(DOWN, another) is None
    bench.shows(STATION)
    assert bench.turn(DOWN, another) is None
    assert bench.control.problem == "245/190 has control of it"


def test_after_a_denial_that_the_manager_never_clears_up_it_is_not_taken_again() -> None:
    """What it showed before, nobody, is from before somebody denied it to us."""
    bench = Bench()
    assert bench.turn(LEVEL) == TAKE
    bench.answer("denied")
    another = object()
    assert [bench.turn(DOWN, another) for _ in range(40)] == [None] * 40
    assert bench.control.problem == UNTOLD
    bench.shows(NOBODY)
    assert bench.turn(DOWN, object()) == TAKE, "now it is known to be free"


def test_what_could_not_be_given_back_is_tried_again_once_it_shows_to_be_ours_still() -> None:
    bench = Bench()
    bench.held()
    assert bench.turn(None, None) == GIVE_BACK
    bench.answer("not answered")
    assert bench.control.held
    assert bench.turn(None, None) is None, "whose it is now is not known yet"
    bench.shows(OURS)
    assert bench.turn(None, None) is None, "not at every word of the manager"
    assert bench.turn(None, None, seconds=SHOWN_WITHIN_S) == GIVE_BACK
    bench.answer()
    assert not bench.control.held
    assert bench.turn(None, None, seconds=SHOWN_WITHIN_S) is None
    assert bench.control.problem == ""


@pytest.mark.parametrize("shown", [NOBODY, STATION, AUTOPILOT])
def test_what_could_not_be_given_back_and_is_not_ours_any_more_is_left(shown: tuple[int, int]) -> None:
    bench = Bench()
    bench.held()
    assert bench.turn(None, None) == GIVE_BACK
    bench.answer("not answered")
    bench.shows(shown)
    assert bench.turn(None, None, seconds=2 * SHOWN_WITHIN_S) is None
    assert not bench.control.held


def test_what_was_taken_although_the_answer_was_lost_is_given_back() -> None:
    bench = Bench()
    assert bench.turn(DOWN) == TAKE
    bench.answer("not answered")
    bench.shows(OURS)
    assert bench.turn(DOWN) == GIVE_BACK


def test_while_the_manager_does_not_tell_who_has_it_it_is_not_taken() -> None:
    control = GimbalControl(OURS)
    assert control.update(1, None, DOWN, SEEK) is None
    assert control.problem == UNTOLD


def test_what_the_manager_told_long_ago_does_not_count() -> None:
    bench = Bench()
    assert bench.turn(DOWN, seconds=CONTROL_MAX_AGE_S + 0.1) is None
    assert bench.control.problem == UNTOLD
    bench.shows(NOBODY)
    assert bench.turn(DOWN, object(), seconds=CONTROL_MAX_AGE_S - 0.1) == TAKE
