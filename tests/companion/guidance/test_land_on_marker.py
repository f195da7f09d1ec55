"""Landing on a marker, in lockstep with the simulated vehicle and step by step."""

from __future__ import annotations

import pytest

from benchmarks.flights_land import land
from companion.guidance.behaviour import BehaviourContext, Requirement
from companion.guidance.behaviours.land_on_marker import LandOnMarkerBehaviour
from companion.guidance.behaviours.marker_search import CLIMB_M, MarkerSearch
from companion.guidance.command import NO_CONTEXT, GrammarError
from companion.guidance.grammar import parse
from companion.guidance.requirements import check_requirements
from companion.vehicle.state import LandedState, VehicleState


@pytest.mark.parametrize("seed", [4, 505, 600, pytest.param(2, marks=pytest.mark.slow)])
def test_lands_on_the_pad_in_gusts(seed: int) -> None:
    result = land(seed, rendered=False)
    assert result.success, result.reason
    assert result.values["error_m"] < 0.3


@pytest.mark.slow
def test_same_seed_gives_the_same_landing() -> None:
    assert land(4, rendered=False) == land(4, rendered=False)


def test_autopilot_lands_with_landing_target_messages() -> None:
    result = land(4, rendered=False, by_autopilot=True)
    assert result.reason.startswith("landed "), result
    assert " disarmed, " in result.reason, result
    assert result.values["error_m"] < 1.0


def test_marker_search_waits_climbs_and_spirals() -> None:
    search, point = MarkerSearch((10.0, 5.0, -4.0), 4.0, 4.0), (10.0, 5.0, -4.0)
    farthest, seconds = 0.0, 0.0
    while not search.ended:
        point = search.update(0.05, point)
        farthest = max(farthest, ((point[0] - 10.0) ** 2 + (point[1] - 5.0) ** 2) ** 0.5)
        seconds += 0.05
        assert seconds < 120.0
    assert farthest == pytest.approx(4.0, abs=0.1)
    assert point[2] == pytest.approx(-4.0 - CLIMB_M)


def test_command_round_trip_and_errors() -> None:
    command = parse("land-on-marker 7 method=autopilot attempts=2")
    assert str(command) == "land-on-marker 7 method=autopilot attempts=2"
    assert isinstance(command.build(NO_CONTEXT), LandOnMarkerBehaviour)
    with pytest.raises(GrammarError, match="whole number"):
        parse("land-on-marker 7.5")
    with pytest.raises(GrammarError, match="target=static"):
        parse("land-on-marker 7 method=autopilot target=moving")


def test_refused_without_marker_detection() -> None:
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
    assert "markers.dictionary" in (why or "")
