"""Formations of vehicles with one companion each, over a network that loses 10 % of the poses."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TypedDict, Unpack

import pytest

from benchmarks.formation import Fleet, PointAirframe
from companion.guidance.behaviour import Outcome
from companion.guidance.behaviours.figure_eight import FigureEightBehaviour
from companion.guidance.behaviours.follow_path import FollowPathBehaviour
from companion.guidance.behaviours.formation import Formation, FormationBehaviour
from companion.guidance.behaviours.goto import Goto, GotoBehaviour
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.interface import EventKind
from companion.guidance.limits.envelope import Limits
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import known

GRID = [(0.0, 0.0), (-6.0, -6.0), (-6.0, 0.0), (-6.0, 6.0), (-12.0, 0.0), (-12.0, -6.0), (-12.0, 6.0)]


def flying(
    count: int, seed: int = 1, positions: Sequence[tuple[float, float]] = GRID, *, as_text: bool = False
) -> Fleet:
    """Hovering vehicles a, b, c …, all known to each other."""
    fleet = Fleet(seed, as_text=as_text)
    for index in range(count):
        name = chr(ord("a") + index)
        fleet.add(
            name,
            PointAirframe(seed * 100 + index, positions[index], 6.0, 10**9 + seed * 10**12 * (index + 1)),
        )
    fleet.run(1.0)
    return fleet


class Options(TypedDict, total=False):
    """Arguments of a formation."""

    spacing_m: float
    slot: str
    lost_timeout_s: float


def follow(fleet: Fleet, names: str, shape: str = "wedge", **options: Unpack[Options]) -> None:
    for name in names:
        assert fleet.command(name, FormationBehaviour(Formation(shape, "a", **options))) is None


def settled(fleet: Fleet, names: Collection[str], within_m: float = 0.8) -> bool:
    errors = fleet.slot_errors()
    return set(names) <= set(errors) and max(errors[name] for name in names) < within_m


def separated(fleet: Fleet) -> bool:
    return fleet.least_m >= Limits().min_separation_m


def slots(fleet: Fleet, name: str) -> dict[str, int]:
    behaviour = fleet.members[name].behaviour
    assert isinstance(behaviour, FormationBehaviour)
    return dict(known(behaviour.note).slots)


def ended(fleet: Fleet, name: str) -> Outcome:
    return known(fleet.members[name].outcome)


@pytest.mark.parametrize(
    "shape", ["line", *(pytest.param(name, marks=pytest.mark.slow) for name in ("circle", "column", "wedge"))]
)
def test_followers_keep_their_slots_through_turns(shape: str) -> None:
    fleet = flying(4, as_text=True)
    follow(fleet, "bcd", shape)
    assert fleet.run_until(lambda: settled(fleet, "bcd"), 30.0)
    fleet.command("a", FollowPathBehaviour(((9.0, 0.0), (9.0, 9.0), (18.0, 9.0)), 2.0))
    worst = []
    fleet.run(15.0, lambda: worst.append(max(fleet.slot_errors().values())))
    assert fleet.run_until(lambda: fleet.members["a"].outcome is not None and settled(fleet, "bcd"), 30.0)
    assert max(worst) < 3.0
    assert separated(fleet)
    # All agree on the assignment of the first vehicle by name.
    assert sorted(slots(fleet, "b").values()) == [1, 2, 3]
    assert not slots(fleet, "c")


def notes(fleet: Fleet, name: str) -> list[str]:
    events = fleet.members[name].flight.events
    return [event.message for event in events if event.kind is EventKind.NOTED]


@pytest.mark.parametrize("as_text", [True, False])
@pytest.mark.parametrize(
    "mode",
    [FlightMode.RETURN, FlightMode.LAND, FlightMode.POSITION, FlightMode.MANUAL, FlightMode.HOLD],
)
def test_follower_says_when_its_leader_was_taken(mode: FlightMode, as_text: bool) -> None:
    fleet = flying(2, as_text=as_text)
    follow(fleet, "b")
    fleet.run(3.0)
    follower, leader = fleet.members["b"].flight.guidance, fleet.members["a"]
    assert notes(fleet, "b") == []
    assert isinstance(leader.airframe, PointAirframe)
    leader.airframe._mode = mode  # by its pilot, or a failsafe
    fleet.run(1.0)
    (taken,) = notes(fleet, "b")
    assert "leader a " in taken
    assert "any more" in taken
    assert f"mode {mode.value}" in taken
    assert "a is not flown" in follower.status
    assert fleet.members["b"].outcome is None or ended(fleet, "b").success
    assert fleet.command("a", HoldBehaviour()) is None
    fleet.run(1.5)
    (again,) = notes(fleet, "b")[1:]
    assert "leader a " in again
    assert "any more" not in again
    assert "not flown" not in follower.status


def test_follower_says_that_its_leader_was_never_commanded() -> None:
    fleet = flying(2)
    leader = fleet.members["a"].airframe
    assert isinstance(leader, PointAirframe)
    leader._mode = FlightMode.POSITION
    fleet.run(1.0)
    follow(fleet, "b")
    fleet.run(1.0)
    (words,) = notes(fleet, "b")
    assert "leader a " in words
    assert ", but " in words


def test_joining_vehicle_gets_a_slot_with_separation() -> None:
    fleet = flying(5, positions=[(0.0, 0.0), (0.0, -6.0), (0.0, 6.0), (-6.0, 6.0), (-12.0, 0.0)])
    follow(fleet, "bc", "line")
    assert fleet.run_until(lambda: settled(fleet, "bc"), 60.0)
    follow(fleet, "de", "line")
    assert fleet.run_until(lambda: settled(fleet, "bcde"), 40.0)
    assert sorted(slots(fleet, "b").values()) == [1, 2, 3, 4]
    assert separated(fleet)


def test_slot_of_a_silent_vehicle_is_freed_after_a_while() -> None:
    fleet = flying(4)
    follow(fleet, "bcd", "column")
    assert fleet.run_until(lambda: settled(fleet, "bcd"), 30.0)
    first = min(slots(fleet, "b"), key=slots(fleet, "b").__getitem__)
    assert first in "bcd"
    silent = next(name for name in "cd" if slots(fleet, "b")[name] < 3) if first == "b" else first
    others = [name for name in "bcd" if name != silent]
    fleet.members[silent].muted = True
    fleet.run(3.0)
    assigned = slots(fleet, others[0]) or slots(fleet, others[1])
    assert silent in assigned
    # It flies away, and remains an obstacle at its last known position.
    fleet.run(4.0)
    assigned = slots(fleet, others[0]) or slots(fleet, others[1])
    assert silent not in assigned
    assert sorted(assigned.values()) == [1, 2]
    assert separated(fleet)
    assert all(fleet.members[name].outcome is None for name in others)


def test_leaving_by_command_frees_the_slot_at_once() -> None:
    fleet = flying(4)
    follow(fleet, "bcd", "line")
    assert fleet.run_until(lambda: settled(fleet, "bcd"), 30.0)
    leaving = next(name for name, slot in slots(fleet, "b").items() if slot == 1)
    rest = [name for name in "bcd" if name != leaving]
    assert fleet.command(leaving, GotoBehaviour(Goto(north_m=-20.0, east_m=30.0))) is None
    assert fleet.run_until(lambda: fleet.members[leaving].outcome is not None and settled(fleet, rest), 40.0)
    assert separated(fleet)


def test_followers_hold_without_leader_and_resume() -> None:
    fleet = flying(3)
    follow(fleet, "bc", lost_timeout_s=6.0)
    assert fleet.run_until(lambda: settled(fleet, "bc"), 30.0)
    fleet.command("a", FollowPathBehaviour(((80.0, 0.0),), 2.0))
    fleet.run(6.0)
    fleet.members["a"].muted = True
    fleet.run(3.5)
    for name in "bc":
        member = fleet.members[name]
        velocity = known(member.airframe.state.velocity_ned_mps)
        assert math.hypot(*velocity) < 0.5
        assert "leader a" in known(member.behaviour).status
    fleet.members["a"].muted = False
    assert fleet.run_until(lambda: settled(fleet, "bc", 1.2), 40.0)
    fleet.members["a"].muted = True
    fleet.run(8.5)
    for name in "bc":
        assert ended(fleet, name).reason.endswith("leader a; waited for 6 s")
        assert not ended(fleet, name).success
    assert separated(fleet)


def test_shape_changes_for_all_and_slots_outlast_their_assigner() -> None:
    fleet = flying(4)
    follow(fleet, "bcd", "wedge")
    assert fleet.run_until(lambda: settled(fleet, "bcd"), 30.0)
    follow(fleet, "d", "line", spacing_m=6.0)
    fleet.run(1.0)
    assert fleet.run_until(lambda: settled(fleet, "bcd"), 40.0)
    for name in "bcd":
        behaviour = known(fleet.members[name].behaviour)
        assert "line" in behaviour.status
    assert separated(fleet)
    before = slots(fleet, "b")
    fleet.members["b"].muted = True
    fleet.run(3.0)
    assert slots(fleet, "c") == before


def test_requested_slot_is_assigned_once() -> None:
    fleet = flying(4)
    follow(fleet, "b", "line", slot="3")
    follow(fleet, "c", "line")
    fleet.run(2.0)
    assert slots(fleet, "b") == {"b": 3, "c": 1}
    follow(fleet, "d", "line", slot="3")
    fleet.run(2.0)
    assert "taken by b" in ended(fleet, "d").reason


def test_impossible_leaders_are_refused() -> None:
    fleet = flying(2)
    assert fleet.command("b", FormationBehaviour(Formation("line", "a"))) is None
    fleet.run(1.0)
    assert fleet.command("a", FormationBehaviour(Formation("line", "b"))) is None
    fleet.run(1.0)
    reasons = [member.outcome.reason for member in fleet.members.values() if member.outcome is not None]
    assert any(reason.startswith(("a follows b: ", "b follows a: ")) for reason in reasons)
    refused = known(fleet.command("a", FormationBehaviour(Formation("line", "a"))))
    assert "than itself" in refused
    refused = known(fleet.command("a", FormationBehaviour(Formation("line", "zeus"))))
    assert "zeus" in refused


def test_virtual_structure_flies_its_path_and_ends() -> None:
    fleet = flying(3)
    points = "0,0 12,0 12,8,8"
    virtual = Formation("line", "virtual", points=points, speed_mps=2.5)
    for name in "abc":
        assert fleet.command(name, FormationBehaviour(virtual)) is None
    members = fleet.members.values()
    assert fleet.run_until(lambda: all(member.outcome is not None for member in members), 90.0)
    assert all(ended(fleet, name).success for name in fleet.members)
    for name in fleet.members:
        assert "1.2 m" in ended(fleet, name).reason
    assert separated(fleet)
    centre = [sum(member.airframe.place()[axis] for member in members) / 3 for axis in range(3)]
    # Three abreast: their centre is the structure's.
    assert centre == pytest.approx([12.0, 8.0, -8.0], abs=0.8)


def test_next_vehicle_takes_over_the_virtual_structure() -> None:
    fleet = flying(3, as_text=True)
    points = "0,0 18,0"
    for name in "abc":
        fleet.command(name, FormationBehaviour(Formation("line", "virtual", points=points)))
    fleet.run(8.0)
    fleet.members["a"].muted = fleet.members["a"].deaf = True
    assert fleet.run_until(lambda: all(fleet.members[name].outcome for name in "bc"), 90.0)
    assert all(ended(fleet, name).success for name in "bc")
    norths = [fleet.members[name].airframe.place()[0] for name in "bc"]
    assert norths == pytest.approx([18.0, 18.0], abs=1.5)


def test_hovering_vehicle_is_flown_around() -> None:
    fleet = flying(3, positions=[(0.0, 0.0), (0.0, -30.0), (0.0, -15.0)])
    assert fleet.command("b", FormationBehaviour(Formation("line", "a", slot="2"))) is None
    assert isinstance(fleet.members["c"].behaviour, HoldBehaviour)
    assert fleet.run_until(lambda: settled(fleet, "b"), 40.0)
    assert separated(fleet)


@pytest.mark.slow
def test_circle_of_six_on_a_figure_eight_keeps_separation() -> None:
    fleet = flying(7)
    follow(fleet, "bcdefg", "circle")
    fleet.run(15.0)
    fleet.command("a", FigureEightBehaviour(12.0, 2.0, 1.0))
    fleet.run(30.0)
    assert separated(fleet)
    assert all(fleet.members[name].outcome is None for name in "bcdefg")
