"""Flights of `follow` with two cars of one colour, 6 m apart, that cross and hide each other.

The followed car goes to and fro across the line of sight, at up to 2.5 m/s; the other one does the same 6 m
nearer to the camera or 6 m behind it, so that they cross four times or more in a minute. Low and 12 m away,
the nearer one hides most of the other, for up to 4 s. The camera is stabilized, 10° below the horizon; range
comes from the ground plane.

A flight succeeds if at its end the vehicle follows the car that it began with. `flown_to_other` is 1 where
it followed the other one, with no word: neither lost nor ambiguous.
"""

from __future__ import annotations

import math

import numpy as np

from benchmarks.flights import FlightResult
from benchmarks.rendered import camera_settings, rendered_scene
from companion.bench.lockstep_flight import Camera, LockstepFlight, Moment
from companion.bench.rendered_camera import RenderedCamera
from companion.bench.synthetic_camera import SyntheticCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose, SyntheticDetector
from companion.guidance.behaviours.follow import Follow, FollowBehaviour
from companion.guidance.objects.tracked_object import Subject
from mavlink_sim.lockstep import LockstepVehicle
from vision.camera_model import CameraModel, CameraMount

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-10.0), stabilized=True)
SIZE_M = (4.2, 1.8, 1.5)
APART_M, SWAY_M = 6.0, 7.0
DISTANCE_M, HEIGHT_M, OCCLUSION_S = 12.0, 3.0, 6.0
FLIGHT_S, STANDING_S = 60.0, 2.5


def run(seed: int, *, rendered: bool = False) -> FlightResult:
    """One flight. `rendered`: the camera is drawn, and looked at by the real detector and tracker."""
    rng = np.random.default_rng((seed, 97))
    yaw = float(rng.uniform(-math.pi, math.pi))
    objects = _two_cars(rng, yaw)
    settings = camera_settings(CAMERA, MOUNT, {"detector.image_size": "320", "detector.threads": "1"})
    if rendered:
        scene, objects = rendered_scene(objects, CAMERA, MOUNT, seed, alike=True)

        def camera(vehicle: LockstepVehicle) -> Camera:
            return RenderedCamera(settings, scene, vehicle, by_flight=True, depth=False)

    else:
        detector = SyntheticDetector(objects, CAMERA, MOUNT, seed=seed)

        def camera(vehicle: LockstepVehicle) -> Camera:
            return SyntheticCamera(settings, detect=detector)

    flight = LockstepFlight.airborne(
        seed=seed, height_m=HEIGHT_M, wind_mps=float(rng.uniform(0.0, 3.0)), camera=camera
    )
    flight.turn_to(yaw)
    subject = Subject("car")
    followed: list[tuple[float, float, bool]] = []

    def judge(moment: Moment) -> None:
        seen = moment.context.objects.of(subject, 0.3)
        if seen is None or seen.position_ned_m is None:
            return
        place = seen.position_at(moment.context.now_ns)[:2]
        off_m = [math.dist(place, _place(item, moment.seconds)) for item in objects]
        followed.append((off_m[0], off_m[1], seen.ambiguous or seen.occluded))

    behaviour = FollowBehaviour(Follow(Subject("car"), distance_m=DISTANCE_M, occlusion_s=OCCLUSION_S))
    log = flight.fly(behaviour, FLIGHT_S, each=judge)
    if not followed:
        return FlightResult(seed, False, {"flown_to_other": 0.0}, "nothing was chosen")
    # The first second shows which car it began with; a whole one, because crossing cars are near each other.
    first, last = followed[:20], followed[-20:]
    begun = min((0, 1), key=lambda which: float(np.median([each[which] for each in first])))
    to_chosen_m, to_other_m = (
        float(np.median([each[which] for each in last])) for which in (begun, 1 - begun)
    )
    kept = log.outcome is None and to_chosen_m < to_other_m
    unsure = log.outcome is not None or any(each[2] for each in last)
    reason = "followed to the end" if log.outcome is None else f"ended after {flight.seconds:.0f} s: "
    reason += "" if log.outcome is None else log.outcome.reason
    if not kept:
        reason += f"; {to_chosen_m:.1f} m from the chosen car, {to_other_m:.1f} m from the other"
    return FlightResult(
        seed,
        kept,
        {"flown_to_other": float(not kept and not unsure), "seconds": flight.seconds},
        reason,
    )


def _place(item: SceneObject, seconds: float) -> tuple[float, float]:
    pose = item.pose(seconds)
    return (pose.north_m, pose.east_m)


def _two_cars(rng: np.random.Generator, yaw: float) -> tuple[SceneObject, ...]:
    """The followed car ahead, and the other one to its side, nearer or farther."""
    ahead_m = float(rng.uniform(12.0, 15.0))
    nearer = math.copysign(APART_M, float(rng.uniform(-1.0, 1.0)))
    side = math.copysign(APART_M, float(rng.uniform(-1.0, 1.0)))
    rate_rad_s = float(rng.uniform(1.5, 2.5)) / SWAY_M
    towards = math.copysign(1.0, float(rng.uniform(-1.0, 1.0)))

    def pose(seconds: float, *, other: bool) -> ScenePose:
        phase = rate_rad_s * max(0.0, seconds - STANDING_S)
        across_m = side * math.cos(phase) if other else towards * SWAY_M * math.sin(phase)
        along_m = ahead_m + (nearer if other else 0.0)
        speed = -side * math.sin(phase) if other else towards * math.cos(phase)
        return ScenePose(
            along_m * math.cos(yaw) - across_m * math.sin(yaw),
            along_m * math.sin(yaw) + across_m * math.cos(yaw),
            yaw + math.copysign(math.pi / 2, speed),
        )

    return (
        SceneObject("car", SIZE_M, lambda seconds: pose(seconds, other=False)),
        SceneObject("car", SIZE_M, lambda seconds: pose(seconds, other=True)),
    )
