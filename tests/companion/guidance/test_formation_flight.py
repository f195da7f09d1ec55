"""Vehicles that fly in formation, each with its own companion, over a network that loses every tenth pose."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TypedDict, Unpack

import pytest

from benchmarks.formation import Fleet, PointAirframe
from companion.guidance.behaviour import Outcome
from companion.guidance.behaviours.figure_eight import FigureEightBehaviour
from companion.guidance.behaviours.follow_path import FollowPathBehaviour
from companion.guidance.behaviours.formation import FormationBehaviour
from companion.guidance.behaviours.goto import GotoBehaviour
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.limits.envelope import Limits

GRID = [(0.0, 0.0), (-6.0, -6.0), (-6.0, 0.0), (-6.0, 6.0), (-12.0, 0.0), (-12.0, -6.0), (-12.0, 6.0)]


def flying(count: int, seed: int = 1, places: Sequence[tuple[float, float]] = GRID) -> Fleet:
    """Vehicles a, b, c … hovering, every one known to all others."""
    fleet = Fleet(seed)
    for index in range(count):
        name = chr(ord("a") + index)
        fleet.add(
            name, PointAirframe(seed * 100 + index, places[index], 6.0, 10**9 + seed * 10**12 * (index + 1))
        )
    fleet.run(1.0)
    return fleet


class Options(TypedDict, total=False):
    """Those of FormationBehaviour that tests choose."""

    spacing_m: float
    slot: int
    lost_timeout_s: float


def follow(fleet: Fleet, names: str, shape: str = "wedge", **options: Unpack[Options]) -> None:
    for name in names:
        assert fleet.command(name, FormationBehaviour(shape, "a", **options)) is None


def settled(fleet: Fleet, names: Collection[str], within_m: float = 0.8) -> bool:
    errors = fleet.slot_errors()
    return set(names) <= set(errors) and max(errors[name] for name in names) < within_m


def apart(fleet: Fleet) -> bool:
    return fleet.least_m >= Limits().min_separation_m


def slots(fleet: Fleet, name: str) -> dict[str, int]:
    behaviour = fleet.members[name].behaviour
    assert isinstance(behaviour, FormationBehaviour)
    assert behaviour.note is not None
    return dict(behaviour.note.slots)


def ended(fleet: Fleet, name: str) -> Outcome:
    outcome = fleet.members[name].outcome
    assert outcome is not None
    return outcome


@pytest.mark.parametrize("shape", ["line", "column", "wedge", "circle"])
def test_followers_take_their_slots_and_keep_them_through_turns(shape: str) -> None:
    fleet = flying(4)
    follow(fleet, "bcd", shape)
    assert fleet.run_until(lambda: settled(fleet, "bcd"), 30.0)
    fleet.command("a", FollowPathBehaviour(((15.0, 0.0), (15.0, 15.0), (30.0, 15.0)), 2.0))
    worst = []
    fleet.run(25.0, lambda: worst.append(max(fleet.slot_errors().values())))
    assert fleet.run_until(lambda: fleet.members["a"].outcome is not None and settled(fleet, "bcd"), 30.0)
    assert max(worst) < 3.0
    assert apart(fleet)
    # All agree on who assigned what: the one whose name comes first.
    assert sorted(slots(fleet, "b").values()) == [1, 2, 3]
    assert not slots(fleet, "c")


def test_one_that_joins_gets_a_slot_and_nobody_comes_near_anybody() -> None:
    fleet = flying(5)
    follow(fleet, "bc", "line")
    # c goes a long way round: d and e stand where the short one leads.
    assert fleet.run_until(lambda: settled(fleet, "bc"), 60.0)
    follow(fleet, "de", "line")
    assert fleet.run_until(lambda: settled(fleet, "bcde"), 40.0)
    assert sorted(slots(fleet, "b").values()) == [1, 2, 3, 4]
    assert apart(fleet)


def test_the_slot_of_a_silent_vehicle_stays_free_for_a_while_and_then_they_close_up() -> None:
    fleet = flying(4)
    follow(fleet, "bcd", "column")
    assert fleet.run_until(lambda: settled(fleet, "bcd"), 30.0)
    first = min(slots(fleet, "b"), key=slots(fleet, "b").__getitem__)
    assert first in "bcd"
    silent = next(name for name in "cd" if slots(fleet, "b")[name] < 3) if first == "b" else first
    others = [name for name in "bcd" if name != silent]
    fleet.members[silent].muted = True
    fleet.run(3.0)
    told = slots(fleet, others[0]) or slots(fleet, others[1])
    assert silent in told
    # It goes out of the way, and is an obstacle where it was last heard.
    fleet.run(4.0)
    told = slots(fleet, others[0]) or slots(fleet, others[1])
    assert silent not in told
    assert sorted(told.values()) == [1, 2]
    assert apart(fleet)
    assert all(fleet.members[name].outcome is None for name in others)


def test_one_that_leaves_by_command_is_out_at_once_and_the_others_close_up() -> None:
    fleet = flying(4)
    follow(fleet, "bcd", "line")
    assert fleet.run_until(lambda: settled(fleet, "bcd"), 30.0)
    leaving = next(name for name, slot in slots(fleet, "b").items() if slot == 1)
    rest = [name for name in "bcd" if name != leaving]
    assert fleet.command(leaving, GotoBehaviour(from_home_m=(-20.0, 30.0))) is None
    assert fleet.run_until(lambda: fleet.members[leaving].outcome is not None and settled(fleet, rest), 40.0)
    assert apart(fleet)


def test_without_their_leader_followers_brake_and_hold_and_go_on_when_it_is_back() -> None:
    fleet = flying(3)
    follow(fleet, "bc", lost_timeout_s=6.0)
    assert fleet.run_until(lambda: settled(fleet, "bc"), 30.0)
    fleet.command("a", FollowPathBehaviour(((80.0, 0.0),), 2.0))
    fleet.run(6.0)
    fleet.members["a"].muted = True
    fleet.run(3.5)
    for name in "bc":
        member = fleet.members[name]
        velocity = member.airframe.state.velocity_ned_mps
        assert velocity is not None
        assert math.hypot(*velocity) < 0.5
        assert member.behaviour is not None
        assert "a, the leader, is not heard" in member.behaviour.status
    fleet.members["a"].muted = False
    assert fleet.run_until(lambda: settled(fleet, "bc", 1.2), 40.0)
    fleet.members["a"].muted = True
    fleet.run(8.5)
    for name in "bc":
        assert ended(fleet, name).reason == "a, the leader, is not heard; waited for 6 s"
        assert not ended(fleet, name).success
    assert apart(fleet)


def test_when_the_one_who_assigns_is_lost_the_next_does_and_slots_stay() -> None:
    fleet = flying(4)
    follow(fleet, "bcd", "wedge")
    assert fleet.run_until(lambda: settled(fleet, "bcd"), 30.0)
    before = slots(fleet, "b")
    fleet.members["b"].muted = True
    fleet.run(3.0)
    assert slots(fleet, "c") == before


def test_a_command_to_one_changes_the_shape_for_all() -> None:
    fleet = flying(4)
    follow(fleet, "bcd", "wedge")
    assert fleet.run_until(lambda: settled(fleet, "bcd"), 30.0)
    follow(fleet, "d", "line", spacing_m=6.0)
    fleet.run(1.0)
    assert fleet.run_until(lambda: settled(fleet, "bcd"), 40.0)
    for name in "bcd":
        behaviour = fleet.members[name].behaviour
        assert behaviour is not None
        assert "line" in behaviour.status
    assert apart(fleet)


def test_a_slot_that_was_asked_for_is_given_once() -> None:
    fleet = flying(4)
    follow(fleet, "b", "line", slot=3)
    follow(fleet, "c", "line")
    assert fleet.run_until(lambda: settled(fleet, "bc"), 30.0)
    assert slots(fleet, "b") == {"b": 3, "c": 1}
    follow(fleet, "d", "line", slot=3)
    fleet.run(2.0)
    assert ended(fleet, "d").reason == "slot 3 is b's: choose another, or slot=auto"


def test_two_cannot_follow_each_other_nor_one_itself_nor_anybody_not_heard() -> None:
    fleet = flying(2)
    assert fleet.command("b", FormationBehaviour("line", "a")) is None
    fleet.run(1.0)
    assert fleet.command("a", FormationBehaviour("line", "b")) is None
    fleet.run(1.0)
    reasons = [member.outcome.reason for member in fleet.members.values() if member.outcome is not None]
    assert any("two cannot follow each other" in reason for reason in reasons)
    refused = fleet.command("a", FormationBehaviour("line", "a"))
    assert refused is not None
    assert "another leader than itself" in refused
    refused = fleet.command("a", FormationBehaviour("line", "zeus"))
    assert refused is not None
    assert "the pose of zeus (none came; heard are b)" in refused


def test_a_virtual_structure_flies_its_path_waits_and_all_end_together() -> None:
    fleet = flying(3)
    points = ((0.0, 0.0), (20.0, 0.0), (20.0, 12.0, 8.0))
    for name in "abc":
        assert (
            fleet.command(name, FormationBehaviour("line", "virtual", points=points, speed_mps=2.5)) is None
        )
    members = fleet.members.values()
    assert fleet.run_until(lambda: all(member.outcome is not None for member in members), 90.0)
    assert {ended(fleet, name).reason for name in fleet.members} == {"the structure has flown its path"}
    assert apart(fleet)
    centre = [sum(member.airframe.place()[axis] for member in members) / 3 for axis in range(3)]
    # Three abreast with one in the middle: their centre is the structure's.
    assert centre == pytest.approx([20.0, 12.0, -8.0], abs=0.8)


def test_when_the_one_who_moves_the_structure_falls_silent_the_next_goes_on() -> None:
    fleet = flying(3)
    points = ((0.0, 0.0), (40.0, 0.0))
    for name in "abc":
        fleet.command(name, FormationBehaviour("line", "virtual", points=points))
    fleet.run(14.0)
    fleet.members["a"].muted = fleet.members["a"].deaf = True
    assert fleet.run_until(lambda: all(fleet.members[name].outcome for name in "bc"), 90.0)
    assert all(ended(fleet, name).success for name in "bc")
    norths = [fleet.members[name].airframe.place()[0] for name in "bc"]
    assert norths == pytest.approx([40.0, 40.0], abs=1.5)


def test_a_vehicle_that_hovers_in_the_way_is_flown_around() -> None:
    fleet = flying(3, places=[(0.0, 0.0), (0.0, -30.0), (0.0, -15.0)])
    assert fleet.command("b", FormationBehaviour("line", "a", slot=2)) is None
    assert isinstance(fleet.members["c"].behaviour, HoldBehaviour)
    assert fleet.run_until(lambda: settled(fleet, "b"), 40.0)
    assert apart(fleet)


def test_a_figure_of_eight_in_a_circle_of_six_keeps_them_apart() -> None:
    fleet = flying(7)
    follow(fleet, "bcdefg", "circle")
    fleet.run(15.0)
    fleet.command("a", FigureEightBehaviour(12.0, 2.0, 1.0))
    fleet.run(30.0)
    assert apart(fleet)
    assert all(fleet.members[name].outcome is None for name in "bcdefg")
