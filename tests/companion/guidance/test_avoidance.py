"""Paths around obstacles as an input of guidance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import pytest

from companion.guidance.behaviours.approach import Approach, ApproachBehaviour
from companion.guidance.behaviours.goto import Goto, GotoBehaviour
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.patrol import Patrol, PatrolBehaviour
from companion.guidance.core import GuidanceOptions
from companion.guidance.interface import EventKind, GuidanceInput, GuidanceOutput
from companion.guidance.limits.obstacles import ObstacleRules
from companion.guidance.objects.tracked_object import Subject
from companion.recording.encoding import decode, encode
from tests.companion.guidance.guidance_harness import STEP_S, GuidanceHarness, assert_failed, flying
from tests.companion.guidance.kinematic_vehicle import SeenObject, look
from vision.path_planner import PlannedPath

OPTIONS = GuidanceOptions(obstacles=ObstacleRules("off", 1.0), avoid=True)
Plan = Callable[[GuidanceInput], PlannedPath | None]


def harness_with(
    plan: Plan, options: GuidanceOptions = OPTIONS, objects: Sequence[SeenObject] = ()
) -> GuidanceHarness:
    """Guidance whose perception worker plans by `plan`, for the newest request, and sees objects."""

    def add_plan(inputs: GuidanceInput) -> GuidanceInput:
        request = harness.path_requests[-1] if harness.path_requests else None
        planned = plan(inputs)
        inputs = replace(inputs, targets=look(harness.vehicle, objects, inputs.seen_ns or 0))
        if planned is None or request is None:
            return inputs
        return replace(inputs, planned=replace(planned, number=request.number))

    harness = GuidanceHarness(flying(), options=options, inputs=add_plan)
    return harness


def around(side_m: float, free_m: float = 100.0) -> Plan:
    """A way 10 m north with a bend to the side, from wherever the vehicle is."""

    def plan(inputs: GuidanceInput) -> PlannedPath:
        north, east, _ = inputs.state.position_ned_m or (0.0, 0.0, 0.0)
        bend = ((5.0, side_m),) if north < 4.0 else ()
        points = ((north, east), *bend, (12.0, 0.0))
        return PlannedPath(inputs.state.position_ns, points, free_m)

    return plan


def flown(harness: GuidanceHarness, seconds: float) -> list[tuple[float, ...]]:
    harness.run(0.1)
    harness.command(GotoBehaviour(Goto(forward_m=12.0, right_m=0.0, speed_mps=2.0)))
    track = []
    for _ in range(round(seconds / STEP_S)):
        harness.run()
        track.append(tuple(harness.vehicle.position))
    return track


def test_goto_flies_the_planned_path() -> None:
    harness = harness_with(around(3.0))
    track = flown(harness, 20.0)
    assert max(east for _, east, _ in track) > 2.0
    assert track[-1][:2] == pytest.approx((12.0, 0.0), abs=0.3)
    assert next(iter(harness.results.values())).success
    assert harness.guidance.setpoints.path == ()  # arrived
    request = harness.path_requests[0]
    assert request.clearance_m == pytest.approx(1.2)
    assert request.reference[-1] == pytest.approx((12.0, 0.0), abs=0.1)


def test_patrol_flies_the_planned_path() -> None:
    harness = harness_with(around(3.0))
    harness.run(0.1)
    harness.command(PatrolBehaviour(Patrol("0,0 12,0", "car")))
    harness.until(lambda: harness.vehicle.position[1] > 2.0, 10.0)


def test_flown_path_is_shown_while_it_is_flown() -> None:
    harness = harness_with(around(3.0))
    north, east, _ = flown(harness, 2.0)[-1]
    (first, *further) = harness.guidance.setpoints.path
    assert first == pytest.approx((north, east), abs=0.2)
    assert further == [(5.0, 3.0), (12.0, 0.0)]
    harness.command(HoldBehaviour())
    harness.run(0.1)
    assert harness.guidance.setpoints.path == ()


def test_no_path_is_requested_without_avoid_or_by_hold() -> None:
    straight = harness_with(around(3.0), replace(OPTIONS, avoid=False))
    assert max(abs(east) for _, east, _ in flown(straight, 10.0)) < 0.3
    holding = harness_with(around(3.0))
    holding.run(0.1)
    holding.command(HoldBehaviour())
    holding.run(3.0)
    assert straight.path_requests == holding.path_requests == []


def test_path_of_the_command_before_is_not_flown() -> None:
    harness = GuidanceHarness(
        flying(),
        options=OPTIONS,
        inputs=lambda inputs: replace(
            inputs, planned=PlannedPath(inputs.state.position_ns, ((0.0, 0.0), (0.0, 9.0)), 9.0, number=1)
        ),
    )
    assert max(math.hypot(north, east) for north, east, _ in flown(harness, 5.0)) < 0.3
    numbers = {request.number for request in harness.path_requests}
    assert len(numbers) == 1
    assert 1 not in numbers


def test_approach_flies_the_planned_path_to_a_hidden_object() -> None:
    car = SeenObject("car", 17.0, 0.0)
    plan = around(3.0)

    def seen(inputs: GuidanceInput) -> PlannedPath | None:
        car.visible = not 3.0 < harness.vehicle.position[0] < 6.0
        return plan(inputs)

    harness = harness_with(seen, objects=[car])
    harness.run(0.1)
    pending = harness.command(ApproachBehaviour(Approach(Subject("car"), distance_m=5.0, retries=0.0)))
    aside: list[float] = []
    while not pending.done() and len(aside) < 1000:
        harness.run()
        aside.append(harness.vehicle.position[1])
    assert pending.result().success, pending.result().reason
    assert max(aside) > 2.0


def test_gust_to_an_obstacle_is_countered_without_turning_away() -> None:
    harness = harness_with(
        lambda inputs: PlannedPath(
            inputs.state.position_ns, ((0.0, 0.0), (-0.3, 0.0), (-0.3, 9.0)), 9.0, inside=True
        )
    )
    flown(harness, 0.5)
    harness.vehicle.velocity[0] = 0.6
    harness.run()
    assert harness.guidance.setpoints.asked is not None
    assert harness.guidance.setpoints.asked.velocity_ned_mps == pytest.approx((-2.1, 0.0, 0.0), abs=0.3)
    harness.run(3.0)
    assert harness.vehicle.position[0] < -0.8
    assert harness.vehicle.yaw_rad == pytest.approx(0.0, abs=0.05)


def test_nothing_beyond_the_observed_part_is_flown() -> None:
    track = flown(harness_with(around(0.0, free_m=0.0)), 6.0)
    assert max(north for north, _, _ in track) < 0.5
    slow = flown(harness_with(around(0.0, free_m=1.5)), 6.0)
    fastest = max(math.dist(a, b) / STEP_S for a, b in pairwise(slow))
    assert 0.5 < fastest < 1.42  # stops within 1 m at 1 m/s²


@pytest.mark.parametrize(
    ("plan", "word"),
    [
        (lambda inputs: None, "no path"),
        (lambda inputs: PlannedPath(inputs.state.position_ns, (), reason="no gap of 2.6 m"), "2.6 m"),
        (
            lambda inputs: PlannedPath(inputs.state.position_ns - 10**10, ((0.0, 0.0), (9.0, 0.0)), 9.0),
            "10.0 s old",
        ),
    ],
)
def test_without_a_way_it_holds_and_ends_with_the_reason(plan: Plan, word: str) -> None:
    harness = harness_with(plan)
    track = flown(harness, 12.0)
    assert max(math.hypot(north, east) for north, east, _ in track) < 0.3
    assert_failed(next(iter(harness.results.values())), "no way", word)
    assert [event.level for event in harness.events if event.kind is EventKind.NOTED] == ["warning"]
    assert harness.guidance.behaviour is not None
    assert harness.guidance.behaviour.name == "hold"


def test_paths_are_recorded_exactly() -> None:
    planned = PlannedPath(5, ((0.1, -0.2), (1 / 3, 9.0)), 2.5, "")
    harness = harness_with(lambda inputs: planned)
    inputs = GuidanceInput(harness.autopilot.state, planned=planned)
    assert decode(GuidanceInput, encode(GuidanceInput, inputs)).planned == planned
    flown(harness, 1.0)
    output = next(output for output in harness.outputs if output.path_request is not None)
    assert decode(GuidanceOutput, encode(GuidanceOutput, output)) == output
