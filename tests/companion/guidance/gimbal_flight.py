"""Lockstep flight with a camera on the simulated vehicle's gimbal."""

from __future__ import annotations

import math

from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.synthetic_camera import SyntheticCamera
from companion.bench.synthetic_detector import Faults, SceneObject, ScenePose, SyntheticDetector
from companion.guidance.search_pattern import Footprint
from tests.companion.guidance.guidance_harness import in_the_air
from vision.attitude import Quaternion
from vision.camera_model import CameraModel, CameraMount

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
ON_GIMBAL = CameraMount(forward_m=0.1, on_gimbal=True)
FOOTPRINT = Footprint(math.radians(80.0), 0.0)
HEIGHT_M = 10.0
PERSON_M = (0.5, 0.6, 1.7)


def person(bearing_deg: float, distance_m: float = 4.0) -> SceneObject:
    """A standing person."""
    bearing = math.radians(bearing_deg)
    pose = ScenePose(distance_m * math.cos(bearing), distance_m * math.sin(bearing))
    return SceneObject("person", PERSON_M, lambda _: pose)


def gimbal_flight(
    *scene_objects: SceneObject,
    seed: int = 5,
    mount: CameraMount = ON_GIMBAL,
    rate_hz: float = 5.0,
    wind_mps: float = 0.0,
    noise: float = 1.0,
) -> LockstepFlight:
    """In the air; a detector sees the objects through the gimbal's camera. noise: of the estimate."""
    vehicle = in_the_air(seed=seed, height_m=HEIGHT_M, wind_mps=wind_mps, noise=noise, gimbal=True)

    def gimbal_attitude() -> Quaternion:
        gimbal = vehicle.vehicle.gimbal
        assert gimbal is not None
        return gimbal.quaternion

    # Box noise of the detector is tested elsewhere.
    detector = SyntheticDetector(
        scene_objects, CAMERA, mount, seed=seed, faults=Faults(0.0, 0.05, 0.0, 0.0), gimbal=gimbal_attitude
    )
    camera = SyntheticCamera(camera_settings(CAMERA, mount), detect=detector, rate_hz=rate_hz)
    return LockstepFlight.of_vehicle(vehicle, camera=camera)
