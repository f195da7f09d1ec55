import itertools
import math
from dataclasses import replace

import pytest

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.orbit import Orbit, OrbitBehaviour
from companion.guidance.limits.envelope import Limits
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from tests.companion.guidance.guidance_harness import Flight, assert_failed, assert_succeeded
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject
from vision.attitude import wrap_angle


class AfterGoal(Behaviour):
    """Starts a behaviour after another one that ended with a goal."""

    name = "after goal"

    def __init__(self, behaviour: Behaviour, goal_ned_m: Vector3) -> None:
        self._behaviour, self._goal_ned_m = behaviour, goal_ned_m

    def on_activate(self, context: BehaviourContext) -> None:
        self._behaviour.on_activate(replace(context, goal_ned_m=self._goal_ned_m))

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        return self._behaviour.update(dt_s, context)


def test_hold_keeps_its_initial_position_and_heading() -> None:
    vehicle = KinematicVehicle(position=[3.0, -2.0, -6.0], yaw_rad=1.2)
    flight = Flight("hold", vehicle)
    assert flight.run(5.0) is None
    assert math.dist(vehicle.position, (3.0, -2.0, -6.0)) < 0.01
    first = flight.steps[0]
    assert isinstance(first, Setpoint)
    assert first.yaw_rad == pytest.approx(1.2)


@pytest.mark.parametrize(("goal", "held"), [((3.6, -2.0, -6.3), True), ((4.5, -2.0, -6.0), False)])
def test_hold_keeps_the_previous_goal_if_near(goal: Vector3, held: bool) -> None:
    vehicle = KinematicVehicle(position=[3.0, -2.0, -6.0])
    flight = Flight(AfterGoal(HoldBehaviour(8.0), goal), vehicle)
    outcome = flight.run(10.0)
    assert outcome is not None
    position = goal if held else (3.0, -2.0, -6.0)
    assert outcome.goal_ned_m == position
    assert math.dist(vehicle.position, position) < 0.05


def test_hold_brakes_first_and_does_not_fly_back() -> None:
    vehicle = KinematicVehicle(velocity=[4.0, 0.0, 0.0])
    flight = Flight("hold", vehicle)
    flight.run(8.0)
    furthest = max(position[0] for position in flight.track)
    assert vehicle.position[0] > 0.5
    assert furthest - vehicle.position[0] < 0.15
    assert math.hypot(*vehicle.velocity) < 0.05


def test_hold_ends_after_its_duration() -> None:
    assert_succeeded(Flight("hold 2").run(3.0), "2 s")


@pytest.mark.parametrize("direction", ["clockwise", "counterclockwise"])
def test_orbit_flies_its_laps_facing_the_centre(direction: str) -> None:
    vehicle = KinematicVehicle(yaw_rad=math.pi / 2)
    centre = (0.0, 10.0)
    seen = []

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        north, east = vehicle.position[0] - centre[0], vehicle.position[1] - centre[1]
        if seconds > 8.0:
            to_centre = math.atan2(-east, -north)
            seen.append(
                (
                    math.hypot(north, east),
                    math.hypot(*vehicle.velocity),
                    abs(wrap_angle(to_centre - vehicle.yaw_rad)),
                    wrap_angle(math.atan2(east, north)),
                    vehicle.position[2],
                )
            )

    orbit = OrbitBehaviour(Orbit(None, 10.0, 2.0, 2.0, direction))
    assert_succeeded(Flight(orbit, vehicle).run(120.0, each))
    assert all(abs(distance - 10.0) < 0.1 for distance, *_ in seen)
    assert all(abs(speed - 2.0) < 0.2 for _, speed, *_ in seen)
    assert all(off < math.radians(3) for _, _, off, *_ in seen)
    assert all(abs(down + 5.0) < 0.1 for *_, down in seen)
    turned = sum(wrap_angle(b[3] - a[3]) for a, b in itertools.pairwise(seen))
    assert (turned > 0) is (direction == "clockwise")


def test_orbit_reaches_a_distant_circle() -> None:
    car = SeenObject("car", 30.0, 4.0)
    vehicle = KinematicVehicle()
    flight = Flight("orbit car radius=8 speed=3 laps=1", vehicle, [car])
    # The behaviour begins after the first frame, as its requirement demands.
    flight.latency_s = 0.0
    assert_succeeded(flight.run(90.0))
    assert math.dist(vehicle.position[:2], (30.0, 4.0)) == pytest.approx(8.0, abs=0.6)


def test_orbit_whose_circle_leaves_the_limits_ends_by_its_time() -> None:
    flight = Flight(
        "orbit car radius=8 speed=3 laps=1",
        KinematicVehicle(),
        [SeenObject("car", 30.0, 4.0)],
        limits=Limits(max_distance_m=30.0),
    )
    flight.latency_s = 0.0
    assert_failed(flight.run(120.0), "timed out")
    assert max(math.hypot(*position[:2]) for position in flight.track) < 30.5


def test_orbit_without_a_visible_object_ends() -> None:
    assert_failed(Flight("orbit boat").run(5.0), "boat")


def test_orbit_at_its_centre_gives_finite_setpoints() -> None:
    behaviour = OrbitBehaviour(Orbit(radius_m=5.0, speed_mps=1.0))
    vehicle = KinematicVehicle()
    flight = Flight(behaviour, vehicle)
    flight.run(0.1)
    vehicle.position[:2] = [5.0, 0.0]
    step = behaviour.update(0.02, BehaviourContext(vehicle.now_ns, vehicle.state))
    assert isinstance(step, Setpoint)
