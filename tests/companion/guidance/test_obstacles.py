import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import flights_obstacles
from benchmarks.flights_obstacles import ALLOWED_M, MARGIN_M
from companion.bus.messages import obstacles_message
from companion.guidance.behaviour import BehaviourContext
from companion.guidance.behaviours.goto import Goto, GotoBehaviour
from companion.guidance.behaviours.land import LandBehaviour
from companion.guidance.core import Guidance, GuidanceOptions
from companion.guidance.interface import EventKind, GuidanceInput
from companion.guidance.limits.envelope import Envelope, Limits
from companion.guidance.limits.obstacles import (
    BRAKING_GAIN,
    LATENCY_S,
    Constraint,
    ObstacleMemory,
    ObstacleRules,
    speed_towards,
)
from companion.guidance.requirements import check_requirements
from companion.service.factory import guidance_options
from companion.settings.reading import load_settings
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, Vector3
from tests.companion.guidance.guidance_harness import GuidanceHarness, known
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle
from vision.camera_model import CameraModel, CameraMount
from vision.obstacle_sectors import SECTOR_RAD, SECTORS, ObstacleSectors, obstacle_sectors
from vision.path_planner import PlannedPath

NAN, INF = math.nan, math.inf


def sectors(captured_ns: int, near: dict[int, float] | None = None, *, rest: float = INF) -> ObstacleSectors:
    distances = [rest] * SECTORS
    for index, value in (near or {}).items():
        distances[index % SECTORS] = value
    return ObstacleSectors(captured_ns, tuple(distances))


def context(
    obstacles: ObstacleSectors | None, *, age_s: float = 0.0, vehicle: KinematicVehicle | None = None
) -> BehaviourContext:
    vehicle = vehicle or KinematicVehicle()
    return BehaviourContext(vehicle.now_ns + round(age_s * 1e9), vehicle.state, obstacles=obstacles)


def sent_velocity(harness: GuidanceHarness) -> Vector3:
    sent = known(harness.guidance.setpoints.sent)
    assert sent.velocity_ned_mps is not None
    return sent.velocity_ned_mps


def ahead_m(memory: ObstacleMemory, vehicle: KinematicVehicle) -> float:
    """The remembered distance ahead while nothing is seen."""
    filled = known(
        memory.filled(context(sectors(vehicle.now_ns, rest=NAN), vehicle=vehicle), MARGIN_M).obstacles
    )
    return filled.distance_m[0]


@given(left_m=st.floats(0.0, 50.0), late_s=st.floats(0.1, 2.0))
def test_allowed_speed_stops_within_the_distance(left_m: float, late_s: float) -> None:
    speed = speed_towards(left_m, late_s, 0.7)
    assert speed >= 0.0
    assert speed * late_s + speed**2 / (2 * 0.7) <= left_m + 1e-6


def test_wall_limits_velocity_into_it_only() -> None:
    vehicle = KinematicVehicle(velocity=[0.0, 1.0, 0.0])
    now_ns = vehicle.now_ns
    # A perpendicular wall 2 m north.
    near = {i: 2.0 / math.cos(math.radians(5 * i)) for i in range(-14, 15)}
    envelope = Envelope()
    envelope.obstacle_constraints = ObstacleRules("auto", 2.0).constraints(
        context(sectors(now_ns, near), vehicle=vehicle)
    )
    asked = Setpoint.velocity((2.0, 2.0, 0.0), now_ns)
    sent = envelope.apply(asked, vehicle.state, now_ns, 0.05)
    assert sent.sent.velocity_ned_mps is not None
    assert sent.sent.velocity_ned_mps[0] <= 0.02
    assert sent.sent.velocity_ned_mps[1] > 0.1
    assert any("obstacle" in reason for reason in sent.reasons)
    away = envelope.apply(Setpoint.velocity((-0.1, 0.0, 0.0), now_ns), vehicle.state, now_ns, 0.05)
    assert away.sent.velocity_ned_mps is not None
    assert away.sent.velocity_ned_mps[0] < 0.0


def test_retreat_is_no_faster_than_the_horizontal_limit() -> None:
    """A drift of 1.5 m/s towards an obstacle inside the margin is countered as fast as is allowed."""
    vehicle = KinematicVehicle(velocity=[1.5, 0.0, 0.0])
    envelope = Envelope(Limits(max_horizontal_speed_mps=1.0))
    near = sectors(vehicle.now_ns, {0: 1.0})
    envelope.obstacle_constraints = ObstacleRules("auto", 2.0).constraints(context(near, vehicle=vehicle))
    still = Setpoint.velocity((0.0, 0.0, 0.0), vehicle.now_ns)
    sent = envelope.apply(still, vehicle.state, vehicle.now_ns, 0.05).sent
    assert sent.velocity_ned_mps == pytest.approx((-1.0, 0.0, 0.0))


@pytest.mark.parametrize("sector", [0, 9, 30, 54])
def test_vehicle_too_fast_for_the_distance_brakes(sector: int) -> None:
    """In every direction alike, and also outside the margin."""
    north, east = math.cos(sector * SECTOR_RAD), math.sin(sector * SECTOR_RAD)
    vehicle = KinematicVehicle(velocity=[north, east, 0.0])
    near = sectors(vehicle.now_ns, {sector: 4.0})
    nearest = ObstacleRules("auto", 2.0).constraints(context(near, vehicle=vehicle))[0]
    allowed_mps = speed_towards(2.0, LATENCY_S)
    assert allowed_mps < 1.0
    assert nearest == pytest.approx((north, east, allowed_mps - BRAKING_GAIN * (1.0 - allowed_mps)))


def test_obstacles_without_a_position_are_as_seen() -> None:
    seen = context(sectors(1, {0: 4.0}, rest=NAN))
    seen = replace(seen, state=replace(seen.state, position_ned_m=None))
    assert ObstacleMemory().filled(seen, MARGIN_M) is seen


def test_position_behind_an_obstacle_is_not_reached() -> None:
    vehicle = KinematicVehicle()
    envelope = Envelope()
    near = sectors(vehicle.now_ns, {0: 3.0, 1: 3.0, -1: 3.0})
    envelope.obstacle_constraints = ObstacleRules("auto", 2.0).constraints(context(near, vehicle=vehicle))
    sent = envelope.apply(
        Setpoint.position((10.0, 0.0, -5.0), vehicle.now_ns), vehicle.state, vehicle.now_ns, 0.05
    )
    assert sent.sent.position_ned_m is not None
    assert sent.sent.position_ned_m[0] < 1.0


def test_unknown_sectors_are_limited_only_by_setting() -> None:
    seen = sectors(KinematicVehicle().now_ns, rest=NAN)
    assert ObstacleRules("auto").constraints(context(seen)) == ()
    constraints = ObstacleRules("auto", max_speed_unobserved_mps=1.0).constraints(context(seen))
    assert len(constraints) == SECTORS
    assert {one[2] for one in constraints} == {1.0}


def test_stale_depth_brakes_with_its_age() -> None:
    vehicle = KinematicVehicle()
    seen = sectors(vehicle.now_ns)
    rules = ObstacleRules("auto")
    assert rules.blind(context(seen, age_s=0.4)) is None
    assert "0.7 s old" in (rules.blind(context(seen, age_s=0.7)) or "")
    assert rules.blind(context(None)) is None
    assert "none received" in (ObstacleRules("required").blind(context(None)) or "")
    assert ObstacleRules("off").blind(context(seen, age_s=9.0)) is None
    assert ObstacleRules("auto", max_age_s=1.0).blind(context(seen, age_s=0.9)) is None


def test_depth_age_follows_perception_max_age_s() -> None:
    settings = load_settings("/dev/null", {"guidance.perception_max_age_s": "1.5"}, environment={})
    assert guidance_options(settings).obstacles.max_age_s == 1.5


@pytest.mark.parametrize("send", [True, False])
def test_obstacle_distance_is_sent_at_10_hz_while_fresh(send: bool) -> None:
    vehicle = KinematicVehicle(mode=FlightMode.POSITION)  # a pilot flies
    guidance = Guidance(GuidanceOptions(obstacles=ObstacleRules("auto"), send_obstacle_distance=send))
    begun_ns, sent = vehicle.now_ns, []
    for _ in range(200):  # 10 s of 20 steps a second; the depth camera stops after 5 s
        inputs = GuidanceInput(vehicle.state, obstacles=sectors(min(vehicle.now_ns, begun_ns + 5 * 10**9)))
        if guidance.step(vehicle.now_ns, inputs).obstacle_distance is not None:
            sent.append((vehicle.now_ns - begun_ns) / 1e9)
        vehicle.now_ns += 50_000_000
    assert sent == pytest.approx([number / 10 for number in range(56)] if send else [])


def test_missing_required_depth_is_refused() -> None:
    goto = GotoBehaviour(Goto(forward_m=5.0, right_m=0.0))
    rules = ObstacleRules("required")
    why = known(check_requirements(goto, context(None), None, obstacles=rules))
    assert "needs depth" in why
    assert check_requirements(LandBehaviour(), context(None), None, obstacles=rules) is None
    assert (
        check_requirements(goto, context(sectors(KinematicVehicle().now_ns)), None, obstacles=rules) is None
    )


def test_brake_is_sent_while_depth_is_missing() -> None:
    vehicle, seen = KinematicVehicle(mode=FlightMode.HOLD), True
    harness = GuidanceHarness(
        vehicle,
        options=GuidanceOptions(obstacles=ObstacleRules("required")),
        inputs=lambda inputs: replace(inputs, obstacles=sectors(vehicle.now_ns) if seen else None),
    )
    harness.run(0.1)
    harness.command(GotoBehaviour(Goto(forward_m=30.0, right_m=0.0)))
    harness.until(lambda: harness.guidance.phase == "offboard", 5.0)
    harness.run(1.0)
    assert math.hypot(*sent_velocity(harness)) > 1.0
    seen = False
    harness.run(0.1)
    assert sent_velocity(harness) == (0.0, 0.0, 0.0)
    assert [reason[:8] for reason in harness.guidance.setpoints.limited_by] == ["no depth"]
    seen = True
    harness.run(1.0)
    assert math.hypot(*sent_velocity(harness)) > 0.5
    assert [event.kind for event in harness.events][-2:] == [
        EventKind.BLIND,
        EventKind.NOTED,
    ]
    assert "no depth" in harness.events[-2].message
    assert "depth" in harness.events[-1].message


@pytest.mark.parametrize("error_mps", [0.0, -0.5, 0.5])
def test_wrong_velocity_estimate_does_not_pass_the_margin(error_mps: float) -> None:
    """The velocity estimate of a PX4 errs by half a metre per second for seconds, its position does not."""
    vehicle = KinematicVehicle(mode=FlightMode.HOLD, velocity_error=(error_mps, 0.0, 0.0))

    def wall() -> ObstacleSectors:
        away_m = 15.0 - vehicle.position[0]
        return sectors(vehicle.now_ns, {i: away_m / math.cos(math.radians(5 * i)) for i in range(-8, 9)})

    harness = GuidanceHarness(
        vehicle,
        options=GuidanceOptions(obstacles=ObstacleRules("required", margin_m=2.0)),
        inputs=lambda inputs: replace(inputs, obstacles=wall()),
    )
    harness.run(0.1)
    harness.command(GotoBehaviour(Goto(forward_m=30.0, right_m=0.0)))
    harness.run(40.0)
    assert 12.5 < vehicle.position[0] < 13.1


@pytest.mark.parametrize("left_m", [3.0, 0.5])
def test_obstacle_outside_the_image_is_remembered(left_m: float) -> None:
    memory, vehicle = ObstacleMemory(), KinematicVehicle()
    memory.filled(context(sectors(vehicle.now_ns, {0: 4.0}, rest=NAN), vehicle=vehicle), MARGIN_M)
    vehicle.position[0] += 4.0 - left_m
    vehicle.now_ns += 10**9
    assert ahead_m(memory, vehicle) == pytest.approx(left_m)
    vehicle.now_ns += 10**10
    assert math.isnan(ahead_m(memory, vehicle))


def test_obstacles_of_the_map_fill_unseen_directions() -> None:
    vehicle = KinematicVehicle()
    planned = PlannedPath(vehicle.now_ns, (), near=((2.0, 0.0), (0.0, -1.5), (-1.2, 0.0)))
    seen = context(sectors(vehicle.now_ns, {0: 4.0, 1: 5.0}, rest=NAN), vehicle=vehicle)
    filled = known(ObstacleMemory().filled(replace(seen, planned=planned), 1.0).obstacles)
    assert filled.distance_m[:2] == (4.0, 5.0)  # as seen now
    assert [filled.distance_m[index] for index in (36, 54)] == pytest.approx([1.2, 1.5])
    assert sum(math.isnan(value) for value in filled.distance_m) == SECTORS - 4
    old = replace(seen, planned=replace(planned, captured_ns=vehicle.now_ns - 10**10))
    assert ObstacleMemory().filled(old, 1.0).obstacles == seen.obstacles


def test_obstacle_of_the_map_stops_but_does_not_push_vehicle() -> None:
    vehicle, rules = KinematicVehicle(), ObstacleRules("auto", 2.0)
    planned = PlannedPath(vehicle.now_ns, (), near=((-1.2, 0.0),))

    def slowest(south_mps: float, near: dict[int, float]) -> Constraint:
        """The least speed that is allowed, and its direction."""
        vehicle.velocity[0] = -south_mps
        seen = context(sectors(vehicle.now_ns, near, rest=NAN), vehicle=vehicle)
        filled = ObstacleMemory().filled(replace(seen, planned=planned), rules.margin_m)
        return min(rules.constraints(filled), key=lambda one: one[2])

    assert slowest(0.0, {}) == pytest.approx((-1.0, 0.0, 0.0), abs=0.01)
    assert slowest(1.0, {})[2] < 0.0, "it brakes while it flies there"
    assert slowest(0.0, {18: 1.8}) == pytest.approx((0.0, 1.0, -0.5)), "it backs out of what it sees"


def test_vehicle_brakes_towards_the_nearest_obstacle_of_the_map() -> None:
    vehicle, rules = KinematicVehicle(), ObstacleRules("auto", 2.0)
    vehicle.velocity[1] = -1.0
    planned = PlannedPath(vehicle.now_ns, (), near=((1.5, 0.0), (0.0, -0.8), (-1.5, 0.0)))
    seen = context(sectors(vehicle.now_ns, {18: math.inf}, rest=NAN), vehicle=vehicle)
    filled = ObstacleMemory().filled(replace(seen, planned=planned), rules.margin_m)
    assert rules.constraints(filled)[0] == pytest.approx((0.0, -1.0, -1.5), abs=0.01)


def test_message_distinguishes_unknown_from_free() -> None:
    message: dict[str, Any] = {**obstacles_message(sectors(5, {0: 1.234, 1: NAN}), "v")}
    assert message["distance_m"][:3] == [1.23, None, None]
    assert message["known"][:3] == [True, False, True]


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_goto_stops_before_an_obstacle(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights_obstacles, "FLIGHT_S", 12.0)
    result = flights_obstacles.run(seed)
    assert result.success, result.reason
    assert MARGIN_M - ALLOWED_M <= result.values["nearest_m"] < MARGIN_M + 1.0


@pytest.mark.parametrize("height_m", [-2.0, 0.0, 0.3, 3.0])
def test_wall_is_seen_at_every_height_relative_to_home(height_m: float) -> None:
    wall = np.full((480, 640), 3.0, np.float32)
    camera = CameraModel.from_horizontal_fov(640, 480, 1.2)
    seen = obstacle_sectors(wall, 1, camera, CameraMount(), np.eye(3), height_m)
    assert seen.distance_m[0] == pytest.approx(3.0, abs=0.01)
