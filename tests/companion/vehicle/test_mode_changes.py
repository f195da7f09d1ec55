"""The sender of modes: what is sent after which reports, acknowledgements and answers of TIMESYNC."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.vehicle.mode_changes import (
    ARM_DISARM,
    DO_SET_MODE,
    NAV_TAKEOFF,
    Ending,
    ModeChange,
    ModeChanges,
)
from companion.vehicle.state import FlightMode, VehicleState

HOLD = VehicleState(armed=True, mode=FlightMode.HOLD, custom_mode=3)
OFFBOARD = replace(HOLD, mode=FlightMode.OFFBOARD, custom_mode=6)
POSITION = replace(HOLD, mode=FlightMode.POSITION, custom_mode=2)
LAND = replace(HOLD, mode=FlightMode.LAND, custom_mode=9)
TAKEOFF = replace(HOLD, mode=FlightMode.TAKEOFF, custom_mode=5)
RETURN_BY_FAILSAFE = replace(
    HOLD,
    mode=FlightMode.RETURN,
    custom_mode=8,
    intended_mode=FlightMode.HOLD,
    intended_beside=FlightMode.RETURN,
)
ACCEPTED, REJECTED, IN_PROGRESS = 0, 1, 5


class Sender:
    """The state machine, with a clock and a TIMESYNC that the test sets. `sent`: (command, parameter)."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, float]] = []
        self.restored: list[str] = []
        self.now_s = 100.0
        self.answered_s = 0.0
        self.newest: VehicleState | None = None
        self.changes = ModeChanges(
            lambda command, values, confirmation: self.sent.append((command, values[-1])),
            lambda custom_mode: (custom_mode, custom_mode),
            lambda change, text: self.restored.append(change.what),
        )

    @property
    def now_ns(self) -> int:
        return round(self.now_s * 1e9)

    def begin(
        self, before: VehicleState, wanted: VehicleState, state: VehicleState | None = None
    ) -> ModeChange:
        change = ModeChange(
            f"mode {wanted.mode}", DO_SET_MODE, (1, wanted.custom_mode), before, wanted.custom_mode
        )
        self.newest = state or before
        self.changes.begin(change, self.newest, self.now_ns)
        return change

    def arm(self, before: VehicleState) -> ModeChange:
        self.newest = before
        change = ModeChange("arming", ARM_DISARM, (1.0,), before, None, armed=True)
        self.changes.begin(change, before, self.now_ns)
        return change

    def report(self, *states: VehicleState) -> None:
        for state in states:
            self.newest = state
            self.changes.on_report(state, self.now_ns, round(self.answered_s * 1e9))

    def acknowledge(self, *results: int, command: int = DO_SET_MODE) -> None:
        for result in results:
            self.changes.on_acknowledgement(command, result, self.now_ns)

    def wait(self, seconds: float, *, answered: bool = True, reported: bool = True) -> None:
        """Let time pass; the newest report comes again and again, and TIMESYNC is answered at once."""
        for _ in range(round(seconds / 0.05)):
            self.now_s += 0.05
            if answered:
                self.answered_s = self.now_s
            if reported and self.newest is not None:
                self.report(self.newest)
            self.changes.tick(self.now_ns)


@pytest.fixture
def sender() -> Sender:
    return Sender()


def test_lost_request_is_repeated_until_it_shows(sender: Sender) -> None:
    change = sender.begin(HOLD, OFFBOARD)
    assert sender.sent == [(DO_SET_MODE, 6)]
    sender.wait(1.1)
    assert len(sender.sent) == 3
    sender.report(OFFBOARD)
    assert change.ending is Ending.DONE
    sender.wait(3.0)
    assert len(sender.sent) == 3


def test_unanswered_request_ends_after_its_attempts(sender: Sender) -> None:
    change = sender.begin(HOLD, OFFBOARD)
    sender.wait(4.0)
    assert (change.ending, len(sender.sent)) == (Ending.NO_ANSWER, 5)


@pytest.mark.parametrize("missing", ["answered", "reported"])
def test_request_that_may_have_arrived_is_not_repeated(sender: Sender, missing: str) -> None:
    sender.begin(HOLD, OFFBOARD)
    sender.wait(2.0, **{missing: False})
    assert len(sender.sent) == 1


@pytest.mark.parametrize("result", [ACCEPTED, IN_PROGRESS])
def test_acknowledged_request_is_not_repeated(sender: Sender, result: int) -> None:
    change = sender.begin(HOLD, OFFBOARD)
    sender.acknowledge(result)
    sender.wait(2.5)
    assert (change.ending, len(sender.sent)) == (None, 1)


def test_second_acknowledgement_rejects(sender: Sender) -> None:
    change = sender.begin(HOLD, OFFBOARD)
    sender.acknowledge(ACCEPTED, REJECTED)
    assert (change.ending, change.result) == (Ending.REJECTED, REJECTED)


@pytest.mark.parametrize(
    "other", [POSITION, replace(HOLD, armed=False), RETURN_BY_FAILSAFE], ids=["mode", "disarmed", "failsafe"]
)
def test_any_other_report_ends_the_request(sender: Sender, other: VehicleState) -> None:
    change = sender.begin(HOLD, OFFBOARD)
    sender.report(other)
    assert change.ending is Ending.TAKEN_OVER
    sender.report(HOLD)
    sender.wait(3.0)
    assert len(sender.sent) == 1


def test_disarming_is_not_called_a_pilots(sender: Sender) -> None:
    """PX4 disarms by itself on the ground."""
    change = sender.begin(HOLD, OFFBOARD)
    sender.report(replace(HOLD, armed=False))
    assert "disarmed" in change.why
    assert "pilot" not in change.why


def test_nothing_is_sent_if_the_mode_has_changed_since(sender: Sender) -> None:
    change = sender.begin(OFFBOARD, HOLD, POSITION)
    assert (change.ending, sender.sent) == (Ending.TAKEN_OVER, [])


def test_dropped_request_is_not_repeated(sender: Sender) -> None:
    change = sender.begin(HOLD, OFFBOARD)
    sender.changes.drop(change, "superseded")
    sender.wait(3.0)
    assert (change.ending, len(sender.sent)) == (Ending.DROPPED, 1)


def test_nothing_is_sent_after_the_deadline(sender: Sender) -> None:
    change = ModeChange("mode hold", DO_SET_MODE, (1, 3), OFFBOARD, 3, valid_until_ns=sender.now_ns - 1)
    sender.changes.begin(change, OFFBOARD, sender.now_ns)
    assert (change.ending, sender.sent) == (Ending.DROPPED, [])
    change = ModeChange("mode hold", DO_SET_MODE, (1, 3), OFFBOARD, 3, valid_until_ns=sender.now_ns + 10**8)
    sender.changes.begin(change, OFFBOARD, sender.now_ns)
    sender.wait(3.0)
    assert len(sender.sent) == 1


def test_pilots_mode_that_ours_overrides_is_restored(sender: Sender) -> None:
    change = sender.begin(HOLD, OFFBOARD)
    sender.report(POSITION)
    sender.acknowledge(ACCEPTED, ACCEPTED)
    sender.report(OFFBOARD)
    assert change.ending is Ending.TAKEN_OVER
    assert sender.restored == ["mode position"]
    assert sender.sent[1:] == [(DO_SET_MODE, 2)]
    sender.acknowledge(ACCEPTED)
    sender.report(POSITION)
    sender.wait(3.0)
    assert len(sender.sent) == 2


def test_restoration_yields_to_the_pilots_next_change(sender: Sender) -> None:
    sender.begin(HOLD, OFFBOARD)
    sender.report(POSITION)
    sender.acknowledge(ACCEPTED)
    sender.report(OFFBOARD, LAND)
    sender.wait(2.0)
    assert sender.sent[1:] == [(DO_SET_MODE, 2)]
    sender.acknowledge(ACCEPTED)
    sender.report(POSITION)
    assert sender.sent[2:] == [(DO_SET_MODE, 9)]


@pytest.mark.parametrize("rejected", [False, True])
def test_pilots_own_choice_of_our_mode_stays(sender: Sender, rejected: bool) -> None:
    sender.begin(HOLD, LAND)
    sender.report(POSITION)
    if rejected:
        sender.acknowledge(ACCEPTED, REJECTED)
    sender.report(LAND)
    sender.acknowledge(ACCEPTED)
    sender.report(LAND)
    assert sender.restored == []


def test_mode_after_ours_is_left_alone(sender: Sender) -> None:
    sender.begin(OFFBOARD, HOLD)
    sender.acknowledge(ACCEPTED, ACCEPTED)
    sender.report(HOLD, POSITION, HOLD)
    assert sender.restored == []


def test_duplicate_that_arrives_later_is_undone(sender: Sender) -> None:
    sender.begin(OFFBOARD, LAND)
    sender.acknowledge(ACCEPTED)
    sender.report(LAND, POSITION)
    sender.acknowledge(ACCEPTED)
    sender.report(LAND)
    assert sender.restored == ["mode position"]


def test_failsafe_that_ours_overrides_is_not_restored(sender: Sender) -> None:
    sender.begin(HOLD, LAND)
    sender.report(RETURN_BY_FAILSAFE)
    sender.acknowledge(ACCEPTED)
    sender.report(LAND)
    assert sender.restored == []


def test_end_of_a_takeoff_is_not_a_pilots(sender: Sender) -> None:
    change = sender.begin(TAKEOFF, OFFBOARD)
    sender.report(HOLD)
    sender.acknowledge(ACCEPTED)
    sender.report(OFFBOARD)
    assert (change.ending, sender.restored) == (Ending.DONE, [])


def test_hold_that_guidance_calls_a_pilots_is_restored(sender: Sender) -> None:
    change = sender.begin(TAKEOFF, OFFBOARD)
    sender.report(HOLD)
    sender.changes.drop(change, "the pilot took over")
    sender.acknowledge(ACCEPTED)
    sender.report(OFFBOARD)
    assert sender.restored == ["mode hold"]


def test_mode_of_a_superseded_request_is_not_a_pilots(sender: Sender) -> None:
    sender.begin(HOLD, OFFBOARD)
    change = sender.begin(HOLD, LAND)
    sender.report(OFFBOARD)
    sender.acknowledge(ACCEPTED)
    sender.report(LAND)
    assert (change.ending, sender.restored) == (Ending.DONE, [])


def test_disarming_by_the_pilot_is_not_undone(sender: Sender) -> None:
    parked = replace(HOLD, armed=False)
    change = sender.arm(parked)
    sender.acknowledge(ACCEPTED, command=ARM_DISARM)
    sender.report(HOLD)
    assert change.ending is Ending.DONE
    sender.report(parked)
    sender.wait(3.0)
    assert sender.sent == [(ARM_DISARM, 1.0)]


def test_arming_that_arrives_after_the_pilot_is_undone(sender: Sender) -> None:
    parked = replace(HOLD, armed=False)
    change = sender.arm(parked)
    sender.report(replace(POSITION, armed=False))
    assert change.ending is Ending.TAKEN_OVER
    sender.acknowledge(ACCEPTED, command=ARM_DISARM)
    sender.report(POSITION)
    assert sender.sent[1:] == [(ARM_DISARM, 0.0)]


def test_takeoff_ends_with_its_acknowledgement(sender: Sender) -> None:
    change = ModeChange("take-off", NAV_TAKEOFF, (5.0,), HOLD, 5, done_by_acknowledgement=True)
    sender.changes.begin(change, HOLD, sender.now_ns)
    sender.acknowledge(ACCEPTED, command=NAV_TAKEOFF)
    assert change.ending is Ending.DONE


def test_takeoff_without_a_mode_of_its_own_is_repeated(sender: Sender) -> None:
    change = ModeChange("take-off", NAV_TAKEOFF, (5.0,), HOLD, None, done_by_acknowledgement=True)
    sender.changes.begin(change, HOLD, sender.now_ns)
    sender.report(HOLD)
    sender.wait(0.6)
    assert (change.ending, len(sender.sent)) == (None, 2)


def test_mode_that_is_there_already_needs_the_acknowledgement(sender: Sender) -> None:
    change = sender.begin(HOLD, HOLD)
    sender.report(HOLD)
    sender.wait(1.0)
    assert (change.ending, len(sender.sent)) == (None, 1)
    sender.acknowledge(ACCEPTED)
    assert change.ending is Ending.DONE
