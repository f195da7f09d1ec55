"""Landing on a marker, in lockstep with the built-in vehicle and in single steps."""

from __future__ import annotations

import pytest

from benchmarks.flights_land import land
from companion.guidance.arguments import GrammarError
from companion.guidance.behaviour import BehaviourContext, Requirement
from companion.guidance.behaviours.land_on_marker import LandOnMarkerBehaviour
from companion.guidance.behaviours.marker_search import CLIMB_M, MarkerSearch
from companion.guidance.command import NO_CONTEXT
from companion.guidance.grammar import parse
from companion.guidance.requirements import check_requirements
from companion.vehicle.state import LandedState, VehicleState


@pytest.mark.parametrize("seed", [2, 4])
def test_it_lands_on_the_pad_in_gusts(seed: int) -> None:
    result = land(seed, rendered=False)
    assert result.success, result
    assert result.values["error_m"] < 0.3


def test_the_same_seed_is_the_same_landing() -> None:
    assert land(4, rendered=False) == land(4, rendered=False)


def test_the_autopilot_lands_on_what_it_is_told() -> None:
    result = land(4, rendered=False, by_autopilot=True)
    assert "landed and disarmed" in result.reason, result
    assert result.values["error_m"] < 1.0


def test_a_search_waits_climbs_and_goes_round_until_all_was_looked_at() -> None:
    search, place = MarkerSearch((10.0, 5.0, -4.0), 4.0, 4.0), (10.0, 5.0, -4.0)
    farthest, seconds = 0.0, 0.0
    while not search.ended:
        place = search.update(0.05, place)
        farthest = max(farthest, ((place[0] - 10.0) ** 2 + (place[1] - 5.0) ** 2) ** 0.5)
        seconds += 0.05
        assert seconds < 120.0
    assert farthest == pytest.approx(4.0, abs=0.1)
    assert place[2] == pytest.approx(-4.0 - CLIMB_M)


def test_a_command_becomes_the_behaviour_and_back() -> None:
    command = parse("land-on-marker 7 method=autopilot attempts=2")
    assert str(command) == "land-on-marker 7 method=autopilot attempts=2"
    assert isinstance(command.build(NO_CONTEXT), LandOnMarkerBehaviour)
    with pytest.raises(GrammarError, match="id must be a whole number, got 7"):
        parse("land-on-marker 7.5")
    with pytest.raises(GrammarError, match="pad that is still"):
        parse("land-on-marker 7 method=autopilot target=moving")


def test_without_markers_it_is_refused_and_what_is_missing_is_named() -> None:
    behaviour = LandOnMarkerBehaviour(7)
    assert Requirement.MARKER in behaviour.requirements
    now_ns = 10**12
    state = VehicleState(
        heartbeat_ns=now_ns,
        position_ns=now_ns,
        attitude_ns=now_ns,
        position_ned_m=(0.0, 0.0, -5.0),
        attitude=(1.0, 0.0, 0.0, 0.0),
        armed=True,
        landed=LandedState.IN_AIR,
    )
    why = check_requirements(behaviour, BehaviourContext(now_ns, state), None)
    assert why == ("land-on-marker needs perception that looks for markers (markers.dictionary is not set)")
