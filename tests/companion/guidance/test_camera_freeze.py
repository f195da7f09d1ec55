"""A camera that repeats its last image: no behaviour flies on, or nearer to anybody than it may."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from benchmarks import flights_land
from benchmarks.rendered import camera_settings, rendered_scene
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.bench.synthetic_camera import Detect, SyntheticCamera
from companion.bench.synthetic_detector import Faults, SceneObject, ScenePose, SyntheticDetector
from companion.guidance.behaviour import Outcome
from companion.guidance.interface import GuidanceInput
from companion.guidance.objects.from_markers import NO_MARKERS, MarkerSight, object_detections
from companion.guidance.objects.table import ObjectTable
from companion.vehicle.state import Vector3
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject
from tests.companion.guidance.guidance_harness import assert_failed, in_the_air, known, mission
from tests.companion.guidance.test_marker_target import pad_detection
from vision.attitude import Quaternion
from vision.camera_model import CameraModel, CameraMount
from vision.detections import Detections
from vision.tracking import TrackerSettings

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-10.0))
DISTANCE_M, SPEED_MPS = 6.0, 2.0
EXACT, BELOW_A_CLOCK = "camera_freeze image", "camera_freeze image clock=yes"
# After identical images the vehicle flies on for `perception_max_age_s` (0.5 s) and two frames (0.15 s), and
# brakes from 2 m/s in 2.2 m. Below a clock it notices after 1.5 m, or two sigma of the range (2 m at 12 m),
# and two blocks of frames (0.9 s), and brakes alike.
MAX_FLOWN_M = {EXACT: 2.0 * 0.65 + 2.2, BELOW_A_CLOCK: 2.0 + 2.0 * 0.9 + 2.2}
# The range has an error of up to 1.5 m without depth (benchmarks/flights_approach.py). Near its end an
# approach is slow: identical images cost nothing more; below a clock it flies 1.5 m, and a metre until it
# stands.
MARGIN_M = {EXACT: 1.5, BELOW_A_CLOCK: 1.5 + 1.5 + 1.0}
BEHAVIOURS = {
    "approach": f"approach person distance={DISTANCE_M:g} speed={SPEED_MPS:g} retries=0",
    "approach again": f"approach person distance={DISTANCE_M:g} speed={SPEED_MPS:g} lost_timeout=2",
    "follow": f"follow person distance={DISTANCE_M:g} speed={SPEED_MPS:g} duration=60",
    "patrol": (
        f"patrol 0,0 3,0 classes=person on_detection=approach distance={DISTANCE_M:g} speed={SPEED_MPS:g}"
    ),
    "seek": "seek person",
}
ENDS_S, AFTER_S = 45.0, 4.0


@dataclass
class Freeze:
    """Begins a fault at a time of a flight, and notes what follows.

    Attributes:
        flown_m: the farthest from where the vehicle was then. lowest_m: its lowest height since.
        nearest_m: to the person, in the whole flight.
        reasons: the end of the command and what was noted.
    """

    flight: LockstepFlight
    fault: str
    at_s: float
    range_m: Callable[[Vector3], float] = lambda _: math.inf
    place: Vector3 | None = None
    flown_m: float = 0.0
    nearest_m: float = math.inf
    lowest_m: float = math.inf
    outcome: Outcome | None = None
    reasons: list[str] = field(default_factory=list)

    def on_tick(self) -> None:
        here = self.flight.vehicle.truth.position_ned_m
        if self.place is None and self.flight.seconds >= self.at_s:
            self.flight.vehicle.vehicle.faults.begin(self.fault)
            self.place = here
        if self.place is not None:
            self.flown_m = max(self.flown_m, math.dist(here, self.place))
            self.lowest_m = min(self.lowest_m, -here[2])
        self.nearest_m = min(self.nearest_m, self.range_m(here))

    def fly(self, command: str, limit_s: float = ENDS_S) -> Freeze:
        """Fly it until a few seconds after its end, or after a limit."""
        self.outcome = self.flight.fly(command, limit_s, on_tick=self.on_tick).outcome
        for _ in range(round(AFTER_S * 100)):
            self.flight.tick()
            self.on_tick()
        self.reasons = [event.message for event in self.flight.events]
        return self

    @property
    def named(self) -> bool:
        """Whether a reason names the frozen camera."""
        return any("camera frozen" in reason for reason in self.reasons)


def person_at(north_m: float, east_m: float = 0.0) -> SceneObject:
    return SceneObject("person", (0.5, 0.6, 1.7), lambda _: ScenePose(north_m, east_m))


def seeing(
    *persons: SceneObject,
    mount: CameraMount = MOUNT,
    seed: int = 1,
    also: Callable[[Detect], Detect] = lambda detect: detect,
    tracker: TrackerSettings | None = TrackerSettings(),  # noqa: B008 - frozen
) -> LockstepFlight:
    """In the air, nose to the north, with a detector that misses nothing: a frozen image shows the person.

    Args:
        also: adds to the detections.
    """
    seen = Faults(missed=0.0, false_per_frame=0.0)
    detector = SyntheticDetector(persons, CAMERA, mount, seed=seed, faults=seen)
    camera = SyntheticCamera(camera_settings(CAMERA, mount), detect=also(detector), tracker=tracker)
    flight = LockstepFlight.of_vehicle(in_the_air(seed=3, height_m=3.0, wind_mps=1.0), camera=camera)
    flight.turn_to(0.0)
    return flight


def frozen(command: str, fault: str, seed: int, *, stabilized: bool = False) -> Freeze:
    """A flight to a person, with a freeze at a random time of it."""
    rng = random.Random(seed)
    person = person_at(rng.uniform(10.0, 14.0), rng.uniform(-1.0, 1.0))
    mount = CameraMount(forward_m=0.1, pitch_rad=MOUNT.pitch_rad, stabilized=stabilized)
    flight = seeing(person, mount=mount, seed=seed)
    freeze = Freeze(flight, fault, rng.uniform(1.0, 6.0), lambda place: person.range_m(place, 0.0))
    return freeze.fly(command)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 9))])
@pytest.mark.parametrize("fault", [EXACT, BELOW_A_CLOCK])
@pytest.mark.parametrize("name", BEHAVIOURS)
def test_no_behaviour_flies_on_with_a_frozen_camera(name: str, fault: str, seed: int) -> None:
    freeze = frozen(BEHAVIOURS[name], fault, seed, stabilized=seed % 2 == 0)
    assert freeze.nearest_m >= DISTANCE_M - MARGIN_M[fault], freeze
    reached = freeze.outcome is not None and freeze.outcome.success
    if name != "patrol" or not reached:
        assert freeze.flown_m <= MAX_FLOWN_M[fault], freeze
    if fault == EXACT and not reached:
        assert freeze.named, freeze


# --- no false alarm


@pytest.mark.parametrize("tracker", [TrackerSettings(), None], ids=["tracks", "no tracks"])
def test_mission_approaches_two_persons_of_one_class(tracker: TrackerSettings | None) -> None:
    first_s = 4.0
    # The seconds count from the command, before it from the start.
    begun: list[LockstepFlight] = []
    near = replace(person_at(14.0), hidden=lambda seconds: bool(begun) and seconds > first_s - 0.5)
    flight = seeing(near, person_at(22.0, -1.0), tracker=tracker)
    first = {"do": BEHAVIOURS["approach"], "timeout_s": first_s, "on_failure": "continue"}
    both = mission(flight, first, BEHAVIOURS["approach"])
    assert flight.fly(both, 60.0, on_tick=lambda: begun.append(flight)).outcome is not None
    assert [record.success for record in both.records] == [False, True], both.records
    assert not any("camera frozen" in event.message for event in flight.events)


def with_gear(detect: Detect) -> Detect:
    """Detections, and a landing gear that is always at the same pixels."""
    gear = np.array([[40.25, 380.5, 120.75, 460.25]], np.float32)

    def seen(position: Vector3, attitude: Quaternion, seconds: float) -> Detections:
        found = detect(position, attitude, seconds)
        return Detections(
            np.vstack((found.xyxy, gear)),
            np.append(found.confidence, np.float32(0.8)),
            np.append(found.class_id, len(found.class_names)),
            (*found.class_names, "bird"),
        )

    return seen


@pytest.mark.parametrize("tracker", [TrackerSettings(), None], ids=["tracks", "no tracks"])
@pytest.mark.parametrize("command", ["goto 20 0 speed=5", "patrol 0,0 15,0 classes=person laps=1"])
def test_a_landing_gear_in_view_is_no_frozen_camera(command: str, tracker: TrackerSettings | None) -> None:
    flight = seeing(also=with_gear, tracker=tracker)
    outcome = known(flight.fly(command, 60.0).outcome)
    assert not any("camera frozen" in event.message for event in flight.events)
    assert outcome.success, outcome


@pytest.mark.parametrize("fault", [EXACT, BELOW_A_CLOCK])
def test_a_frozen_camera_with_a_landing_gear_in_view_is_found(fault: str) -> None:
    flight = seeing(person_at(12.0), also=with_gear)
    freeze = Freeze(flight, fault, 2.0).fly(BEHAVIOURS["follow"])
    assert freeze.named
    assert freeze.flown_m <= MAX_FLOWN_M[fault], freeze


@pytest.mark.parametrize("shared", [False, True])
def test_a_frozen_camera_leaves_the_markers_of_another(shared: bool) -> None:
    marker = pad_detection(0.0, 0.0)
    below = MarkerSight((marker,), fresh=True, missing="")
    table, here = ObjectTable(), (0.0, 0.0, -3.0)
    objects = table.update(object_detections([marker], here), here, marker.captured_ns)
    flight = seeing(person_at(12.0))
    assemble = flight.inputs.assemble

    def with_markers(*given: Any, **named: Any) -> GuidanceInput:
        steering = below if shared else NO_MARKERS
        return replace(
            assemble(*given, **named),
            markers=below,
            steering_markers=steering,
            marker_objects=objects if shared else (),
            objects_below=objects,
        )

    flight.inputs.assemble = with_markers  # type: ignore[method-assign]
    flight.fly(BEHAVIOURS["follow"], 2.0)
    flight.vehicle.vehicle.faults.begin(BELOW_A_CLOCK)
    for _ in range(1000):
        flight.tick()
        context = flight.guidance.context
        if context is not None and context.camera_fault:
            break
    assert context is not None
    assert context.camera_fault
    assert not context.targets
    assert context.markers.fresh
    assert context.markers.targets == (() if shared else (marker,))
    assert context.below.markers == (() if shared else objects)


# --- markers: drawn, so that the images themselves are identical or not


SMALL = CameraModel.from_horizontal_fov(320, 240, math.radians(75.0))


def marker_flight(seed: int) -> LockstepFlight:
    printed = Print("APRILTAG_36h11", 7, 0.8, standing=True)
    plate = WorldObject(0, "plate", (12.0, 0.5, -2.2), math.pi, printed=printed)
    world = World((plate,), Ground(("concrete",), seed, 256, 0.1))
    scene = Scene(world, {}, CameraSettings(model=SMALL, mount=MOUNT, seed=seed), "marker")
    changes = {"detector.enabled": "false", "markers.dictionary": "APRILTAG_36h11", "markers.size_m": "0.8"}
    vehicle = in_the_air(seed=3, height_m=3.0, wind_mps=1.0)
    settings = camera_settings(SMALL, MOUNT, changes)
    camera = RenderedCamera(settings, scene, vehicle, rate_hz=5.0, by_flight=True, depth=False)
    return LockstepFlight.of_vehicle(vehicle, camera=camera)


@pytest.mark.parametrize("fault", [EXACT, pytest.param(BELOW_A_CLOCK, marks=pytest.mark.slow)])
@pytest.mark.parametrize("at_s", [3.0, pytest.param(4.0, marks=pytest.mark.slow)])
def test_drawn_images_that_freeze_end_an_approach(fault: str, at_s: float) -> None:
    flight = marker_flight(1)
    freeze = Freeze(flight, fault, at_s, lambda place: math.dist(place[:2], (12.0, 0.5)))
    freeze.fly(f"approach marker=7 distance={DISTANCE_M:g} speed={SPEED_MPS:g}")
    assert_failed(freeze.outcome)
    assert freeze.named, freeze
    assert freeze.flown_m <= MAX_FLOWN_M[fault], freeze
    assert freeze.nearest_m >= DISTANCE_M - MARGIN_M[fault], freeze


@pytest.mark.parametrize("target", ["static", pytest.param("moving", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("fault", "steers"), [(EXACT, True), (BELOW_A_CLOCK, True), (BELOW_A_CLOCK, False)])
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))])
def test_no_landing_sinks_on_with_a_frozen_camera(fault: str, steers: bool, target: str, seed: int) -> None:
    """Its camera is the one that steers, or another one that looks down."""
    rng = random.Random(seed)
    pad = flights_land.Pad((rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0)), rng.uniform(-3.0, 3.0))
    finder = flights_land.ProjectedCamera(pad, flights_land.MOUNT, np.random.default_rng(seed))
    settings = camera_settings(flights_land.CAMERA, flights_land.MOUNT, flights_land.MARKER_SETTINGS)
    camera = SyntheticCamera(settings, find_markers=finder.look, rate_hz=20.0)
    flight = LockstepFlight.of_vehicle(in_the_air(seed=3, height_m=8.0, wind_mps=1.0), camera=camera)
    if not steers:
        assemble = flight.inputs.assemble

        def looking_down(*given: Any, **named: Any) -> GuidanceInput:
            return replace(assemble(*given, **named), steering_markers=NO_MARKERS, marker_objects=())

        flight.inputs.assemble = looking_down  # type: ignore[method-assign]
    freeze = Freeze(flight, fault, rng.uniform(3.0, 8.0)).fly(
        f"land-on-marker {flights_land.MIDDLE} target={target} attempts=1"
    )
    # It sinks at 0.8 m/s for a second, or for 1.5 m or two sigma and two blocks of frames, and then climbs.
    assert freeze.lowest_m >= -known(freeze.place)[2] - (1.3 if fault == EXACT else 3.3), freeze
    assert freeze.lowest_m > 0.5, freeze
    assert_failed(freeze.outcome)
    assert fault == BELOW_A_CLOCK or freeze.named, freeze


# --- depth


def test_frozen_depth_brakes_before_an_obstacle() -> None:
    seed = 1
    car = SceneObject("car", (4.2, 1.8, 1.5), lambda _: ScenePose(30.0, 0.0, 1.5))
    scene, _ = rendered_scene([car], SMALL, MOUNT, seed, depth=True)
    changes = {"detector.enabled": "false", "guidance.obstacles": "auto"}
    vehicle = in_the_air(seed=3, height_m=1.5)
    camera = RenderedCamera(camera_settings(SMALL, MOUNT, changes), scene, vehicle, rate_hz=5.0)
    flight = LockstepFlight.of_vehicle(vehicle, camera=camera)
    freeze = Freeze(flight, "camera_freeze depth", 4.0).fly("goto 25 0 speed=2", 6.0)
    assert freeze.named, freeze
    # Frames of 5 a second are later than those of 15, by 0.3 s.
    assert freeze.flown_m <= MAX_FLOWN_M[EXACT] + 2.0 * 0.3, freeze
