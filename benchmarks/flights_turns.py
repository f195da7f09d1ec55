"""Flights of `follow`: an object that turns at once by 90° or 180°, or stops and starts, at up to 3 m/s.

A person or a car, alone. Every 5 to 8 s it changes its motion between two frames: no filter that expects a
bounded acceleration predicts that. The wind is up to 3 m/s with its gusts. A gimbal holds the camera level
and 27° down; range comes from the ground plane. A flight succeeds if the object is followed to the end.
"""

from __future__ import annotations

import math

import numpy as np

from benchmarks.flights import FlightResult
from benchmarks.flights_follow import CAMERA, MOUNT, SIZES_M
from benchmarks.rendered import camera_settings, rendered_scene
from companion.bench.lockstep_flight import Camera, LockstepFlight, Moment
from companion.bench.rendered_camera import RenderedCamera
from companion.bench.synthetic_camera import SyntheticCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose, SyntheticDetector
from companion.guidance.behaviours.follow import Follow, FollowBehaviour
from companion.guidance.objects.tracked_object import Subject
from mavlink_sim.lockstep import LockstepVehicle

DISTANCE_M, HEIGHT_M = 10.0, 4.0
STANDING_S, SETTLING_S, FLIGHT_S = 2.0, 6.0, 60.0
CHANGE_EVERY_S = (5.0, 8.0)
_STEP_S = 0.05


def run(seed: int, *, rendered: bool = False) -> FlightResult:
    """One flight. `rendered`: the camera is drawn, and looked at by the real detector and tracker."""
    rng = np.random.default_rng((seed, 191))
    class_name = ("car", "person")[seed % 2]
    yaw = float(rng.uniform(-math.pi, math.pi))
    goal = _goal(rng, class_name, yaw, ("right angle", "back", "stop")[seed % 3])
    settings = camera_settings(CAMERA, MOUNT, {"detector.image_size": "320", "detector.threads": "1"})
    if rendered:
        scene, (goal,) = rendered_scene([goal], CAMERA, MOUNT, seed)

        def camera(vehicle: LockstepVehicle) -> Camera:
            return RenderedCamera(settings, scene, vehicle, by_flight=True, depth=False)

    else:
        detector = SyntheticDetector([goal], CAMERA, MOUNT, seed=seed)

        def camera(vehicle: LockstepVehicle) -> Camera:
            return SyntheticCamera(settings, detect=detector)

    flight = LockstepFlight.airborne(
        seed=seed, height_m=HEIGHT_M, wind_mps=float(rng.uniform(0.0, 3.0)), camera=camera
    )
    flight.turn_to(yaw)
    errors_m: list[float] = []

    def judge(moment: Moment) -> None:
        if moment.seconds >= SETTLING_S:
            errors_m.append(abs(goal.range_m(moment.truth.position_ned_m, moment.seconds) - DISTANCE_M))

    log = flight.fly(
        FollowBehaviour(Follow(Subject(class_name), distance_m=DISTANCE_M)), FLIGHT_S, each=judge
    )
    if log.outcome is None:
        reason = "followed to the end"
    else:
        reason = f"ended after {flight.seconds:.0f} s: {log.outcome.reason}"
    return FlightResult(
        seed,
        log.outcome is None and not log.violations,
        {
            "range_error_p50_m": float(np.median(errors_m)) if errors_m else math.nan,
            "range_error_p95_m": float(np.percentile(errors_m, 95)) if errors_m else math.nan,
        },
        reason,
    )


def _goal(rng: np.random.Generator, class_name: str, yaw: float, change: str) -> SceneObject:
    """It stands for a moment, so that it can be chosen."""
    speed_mps = float(rng.uniform(1.0, 3.0))
    times = np.arange(0.0, FLIGHT_S + 5.0, _STEP_S)
    headings = np.full_like(times, yaw + float(rng.uniform(-math.pi, math.pi)))
    speeds = np.where(times > STANDING_S, speed_mps, 0.0)
    at_s = float(rng.uniform(6.0, 8.0))
    while at_s < FLIGHT_S:
        after = times >= at_s
        if change == "stop":
            speeds[after & (times < at_s + float(rng.uniform(1.5, 3.0)))] = 0.0
            headings[after] += float(rng.choice([0.0, math.pi / 2, -math.pi / 2, math.pi]))
        else:
            headings[after] += math.pi if change == "back" else float(rng.choice([-1.0, 1.0])) * math.pi / 2
        at_s += float(rng.uniform(*CHANGE_EVERY_S))
    start_m = float(rng.uniform(10.0, 12.0))
    north = start_m * math.cos(yaw) + np.cumsum(speeds * np.cos(headings)) * _STEP_S
    east = start_m * math.sin(yaw) + np.cumsum(speeds * np.sin(headings)) * _STEP_S

    def pose(seconds: float) -> ScenePose:
        at = min(max(seconds, 0.0), float(times[-1]))
        step = min(int(at / _STEP_S), len(times) - 1)
        return ScenePose(
            float(np.interp(at, times, north)), float(np.interp(at, times, east)), float(headings[step])
        )

    return SceneObject(class_name, SIZES_M[class_name], pose)
