"""Flights of `approach` without depth: the range comes from the ground plane.

A car, a truck or a person stands 12 to 30 m away, anywhere in the image's width, with another of its class
and something else about; the wind is up to 3 m/s. A flight succeeds when the behaviour says that it arrived
and the true distance to the object's nearest surface is off by 1.5 m at most, with no limit left on the way.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from benchmarks.flights import FlightResult
from benchmarks.rendered import camera_settings, rendered_scene
from companion.bench.lockstep_flight import Camera, LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.bench.synthetic_camera import SyntheticCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose, SyntheticDetector
from companion.guidance.behaviour import Behaviour
from companion.guidance.behaviours.approach import Approach, ApproachBehaviour
from companion.guidance.objects.tracked_object import Subject
from mavlink_sim.lockstep import LockstepVehicle
from vision.camera_model import CameraModel, CameraMount

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-10.0))
SIZES_M = {
    "car": (4.2, 1.8, 1.5),
    "truck": (7.0, 2.4, 3.0),
    "person": (0.5, 0.6, 1.7),
    "dog": (0.8, 0.3, 0.5),
}
HEIGHT_M = 2.5
DISTANCE_M = 6.0
LIMIT_S = 120.0
WITHOUT_DEPTH_M, WITH_DEPTH_M = 1.5, 0.5


def run(seed: int, *, rendered: bool = False) -> FlightResult:
    """One flight without depth."""
    return fly(seed, with_depth=False, tolerance_m=WITHOUT_DEPTH_M, rendered=rendered)


def fly(
    seed: int,
    *,
    with_depth: bool,
    tolerance_m: float,
    rendered: bool = False,
    command: Callable[[str], str | Behaviour] = lambda name: ApproachBehaviour(
        Approach(Subject(name), distance_m=DISTANCE_M, retries=0.0)
    ),
) -> FlightResult:
    """One flight; its success allows an error of the final range of `tolerance_m`.

    Args:
        rendered: the camera is drawn and looked at by the real detector, tracker and ranging.
        command: to an object of a class, to `DISTANCE_M`.
    """
    rng = np.random.default_rng((seed, 81))
    class_name = ("car", "person", "truck")[seed % 3]
    yaw = float(rng.uniform(-math.pi, math.pi))
    goal = _standing(rng, class_name, yaw + float(rng.uniform(-0.3, 0.3)), (12.0, 30.0))
    # Beside it another of its kind, farther from where the nose points, and a dog.
    things = [
        goal,
        _standing(rng, class_name, yaw + math.copysign(0.7, rng.uniform(-1, 1)), (18.0, 34.0)),
        _standing(rng, "dog", yaw + float(rng.uniform(-0.4, 0.4)), (10.0, 20.0)),
    ]
    settings = camera_settings(CAMERA, MOUNT, {"detector.image_size": "320", "detector.threads": "1"})
    if rendered:
        scene, (goal, *_) = rendered_scene(things, CAMERA, MOUNT, seed, depth=with_depth)

        def camera(vehicle: LockstepVehicle) -> Camera:
            return RenderedCamera(settings, scene, vehicle, by_flight=True, depth=with_depth)

    else:
        detector = SyntheticDetector(things, CAMERA, MOUNT, seed=seed, with_depth=with_depth)

        def camera(vehicle: LockstepVehicle) -> Camera:
            return SyntheticCamera(settings, detect=detector)

    flight = LockstepFlight.airborne(
        seed=seed,
        height_m=HEIGHT_M,
        wind_mps=float(rng.uniform(0.0, 3.0)),
        camera=camera,
    )
    flight.turn_to(
        math.atan2(goal.pose(0.0).east_m, goal.pose(0.0).north_m) + float(rng.uniform(-0.15, 0.15))
    )
    log = flight.fly(command(class_name), LIMIT_S)
    range_m = goal.range_m(flight.vehicle.truth.position_ned_m, flight.seconds)
    error_m = abs(range_m - DISTANCE_M)
    reason = log.outcome.reason if log.outcome is not None else f"not there after {LIMIT_S:g} s"
    if log.violations:
        reason += f"; left the envelope: {log.violations}"
    if error_m > tolerance_m:
        reason += f"; truly {range_m:.1f} m away"
    arrived = log.outcome is not None and log.outcome.success
    nearest_m = min(goal.range_m(moment.truth.position_ned_m, moment.seconds) for moment in log.moments)
    return FlightResult(
        seed,
        arrived and error_m <= tolerance_m and not log.violations,
        {
            "range_error_m": error_m,
            "time_s": flight.seconds,
            "overshoot_m": max(0.0, DISTANCE_M - nearest_m),
            "envelope_violations": float(len(log.violations)),
        },
        reason,
    )


def _standing(
    rng: np.random.Generator, class_name: str, bearing_rad: float, range_m: tuple[float, float]
) -> SceneObject:
    distance = float(rng.uniform(*range_m))
    pose = ScenePose(
        distance * math.cos(bearing_rad),
        distance * math.sin(bearing_rad),
        float(rng.uniform(-math.pi, math.pi)),
    )
    return SceneObject(class_name, SIZES_M[class_name], lambda _: pose)
