"""Chosen objects with the rendered camera, the real detector, tracker, filters and ranging, in lockstep."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest

from benchmarks.rendered import camera_settings, rendered_scene
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose
from mavlink_sim.lockstep import LockstepVehicle
from tests.companion.guidance.guidance_harness import assert_succeeded, known
from vision.camera_model import CameraModel, CameraMount
from vision.tracking import SelectRequest

CAMERA = CameraModel.from_horizontal_fov(480, 360, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-10.0))


def standing(
    class_name: str, north_m: float, east_m: float, size_m: tuple[float, float, float]
) -> SceneObject:
    return SceneObject(class_name, size_m, lambda _: ScenePose(north_m, east_m, 1.2))


class Flight:
    """In the air, looking north at some objects."""

    def __init__(
        self, objects: Sequence[SceneObject], seed: int, *, depth: bool, tracker: bool = True
    ) -> None:
        changes = {"detector.image_size": "320", "detector.threads": "1"}
        changes["tracker.enabled"] = str(tracker).lower()
        settings = camera_settings(CAMERA, MOUNT, changes)
        scene, self.objects = rendered_scene(objects, CAMERA, MOUNT, seed, depth=depth)
        cameras: list[RenderedCamera] = []

        def camera(vehicle: LockstepVehicle) -> RenderedCamera:
            cameras.append(RenderedCamera(settings, scene, vehicle, rate_hz=5.0, by_flight=True, depth=depth))
            return cameras[0]

        self.flight = LockstepFlight.airborne(seed=seed, height_m=3.0, wind_mps=1.0, camera=camera)
        self.camera = cameras[0]
        self.flight.turn_to(0.0)
        self.flight.run(2.0)

    def box_of(self, index: int) -> tuple[float, float, float, float]:
        """An object's true rectangle in the newest frame: left, top, width, height as fractions."""
        (xyxy,) = [o.xyxy for o in known(self.camera.shown).objects if o.world_object.identifier == index]
        left, top, right, bottom = xyxy
        return (
            left / CAMERA.width,
            top / CAMERA.height,
            (right - left) / CAMERA.width,
            (bottom - top) / CAMERA.height,
        )

    def select(self, index: int) -> int:
        """Select an object by its rectangle; the id of the track that is new since."""
        before = {target.track_id for target in self.flight.inputs.steering.targets}
        self.camera.select(SelectRequest(self.box_of(index)))
        self.flight.run(0.5)
        (target,) = [t for t in self.flight.inputs.steering.targets if t.class_name == "target"]
        assert target.track_id not in before
        return known(target.track_id)

    def range_m(self, index: int) -> float:
        return self.objects[index].range_m(self.flight.vehicle.truth.position_ned_m, self.flight.seconds)


def test_follow_by_track_keeps_to_the_farther_of_two_cars() -> None:
    near, far = standing("car", 13.0, -2.5, (4.2, 1.8, 1.5)), standing("car", 19.0, 4.0, (4.2, 1.8, 1.5))
    seen = Flight([near, far], 11, depth=True)
    cars = [t for t in seen.flight.inputs.steering.targets if t.class_name == "car" and t.trusted]
    farther = max(cars, key=lambda target: target.ground_range_m)
    assert len(cars) == 2
    log = seen.flight.fly(f"follow track={farther.track_id} distance=13", 20.0)
    assert known(log.outcome).reason == "in progress"
    seen.flight.run(4.0)
    assert seen.flight.guidance.busy
    assert seen.range_m(1) == pytest.approx(13.0, abs=0.8)


@pytest.mark.parametrize("tracker", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_seek_prefers_a_sure_car_to_a_nearer_truck(tracker: bool) -> None:
    car, truck = standing("car", -14.0, 9.0, (4.2, 1.8, 1.5)), standing("truck", 2.0, 11.0, (7.0, 2.4, 3.0))
    seen = Flight([car, truck], 13, depth=False, tracker=tracker)
    log = seen.flight.fly("seek car", 60.0)
    assert_succeeded(log.outcome)
    (north, east, _), yaw_rad = seen.flight.vehicle.truth.position_ned_m, seen.flight.vehicle.truth.yaw_rad
    bearing_rad = math.atan2(9.0 - east, -14.0 - north)
    assert abs(math.remainder(bearing_rad - yaw_rad, math.tau)) < math.radians(5.0)
    assert log.violations == {}


@pytest.mark.parametrize(
    ("class_name", "size_m", "depth"),
    [
        ("rock", (1.0, 1.0, 0.8), True),
        pytest.param("shed", (3.0, 2.4, 2.6), False, marks=pytest.mark.slow),
    ],
    ids=["rock by depth", "shed by the ground"],
)
def test_selected_object_of_no_class_is_approached_and_held(
    class_name: str, size_m: tuple[float, float, float], depth: bool
) -> None:
    seen = Flight([standing(class_name, 12.0, 1.1, size_m)], 12, depth=depth)
    track_id = seen.select(0)
    log = seen.flight.fly(f"approach track={track_id} distance=6", 90.0)
    assert_succeeded(log.outcome)
    assert seen.range_m(0) == pytest.approx(6.0, abs=0.5 if depth else 1.5)
    seen.flight.run(3.0)
    assert seen.range_m(0) == pytest.approx(6.0, abs=0.6 if depth else 1.6)
    assert log.violations == {}
