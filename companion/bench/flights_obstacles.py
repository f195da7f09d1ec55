"""Flights of `goto` through a wall or a pillar, seen by the built-in vehicle's rendered depth camera.

The place to go to lies behind a wall (even seeds) or a pillar of 2 m (odd ones), 12 to 18 m away, at up to
4 m/s, in up to 3 m/s of wind. Depth comes ten times a second with a stereo camera's noise, 80 ms late. A
flight succeeds when the vehicle's middle never comes nearer to the obstacle than the margin less a metre, and
the wall (nobody gets round it) has stopped it.
"""

from __future__ import annotations

import math

import numpy as np

from companion.bench.flights import FlightResult
from companion.bench.lockstep_flight import LockstepFlight, camera_settings
from companion.bench.synthetic_camera import SyntheticCamera
from companion.guidance.goto import GotoBehaviour
from companion.guidance.obstacles import ObstacleRules
from mavlink_sim.camera.depth_camera import DepthSensor, measured_depth
from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.world import World, WorldObject, range_to
from vision.camera_model import CameraModel, CameraMount
from vision.obstacle_sectors import ObstacleSectors, obstacle_sectors
from vision.rotation import matrix_from_quaternion

CAMERA = CameraModel.from_horizontal_fov(320, 240, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1)
MARGIN_M, ALLOWED_M = 2.0, 1.0
HEIGHT_M, FLIGHT_S = 2.5, 25.0
RATE_HZ, LATENCY_S = 10.0, 0.08


class DepthCamera:
    """What a rendered depth camera makes of a world, as `SyntheticCamera.find_obstacles`."""

    def __init__(self, world: World, seed: int) -> None:
        self._rng = np.random.default_rng((seed, 62))
        self._renderer = Renderer(world, CAMERA, MOUNT)

    def __call__(self, flight: LockstepFlight) -> ObstacleSectors:
        truth, now_ns = flight.vehicle.truth, flight.now_ns
        rendered = self._renderer.render(truth.position_ned_m, matrix_from_quaternion(truth.quaternion))
        depth = measured_depth(rendered.depth_m, CAMERA.fx, DepthSensor(), self._rng)
        pose = flight.inputs.history.at(now_ns)  # the estimate, as a worker knows it
        return obstacle_sectors(depth, now_ns, CAMERA, MOUNT, pose.ned_from_body, pose.height_m)


def run(seed: int) -> FlightResult:
    """One flight."""
    rng = np.random.default_rng((seed, 61))
    wind_mps = float(rng.uniform(0.0, 3.0))
    heading, away_m = float(rng.uniform(-math.pi, math.pi)), float(rng.uniform(12.0, 18.0))
    place = (away_m * math.cos(heading), away_m * math.sin(heading), 0.0)
    wall = seed % 2 == 0
    if wall:
        slant = heading + float(rng.uniform(-0.3, 0.3))
        thing = WorldObject(0, "wall", place, slant, size_m=(40.0, 0.4, 5.0))
    else:
        thing = WorldObject(0, "box", place, heading, size_m=(2.0, 2.0, 6.0))
    camera = SyntheticCamera(
        camera_settings(CAMERA, MOUNT),
        find_obstacles=DepthCamera(World((thing,)), seed),
        size=(CAMERA.width, CAMERA.height),
        rate_hz=RATE_HZ,
        latency_s=LATENCY_S,
    )
    flight = LockstepFlight.airborne(
        seed=seed,
        height_m=HEIGHT_M,
        wind_mps=wind_mps,
        camera=lambda _: camera,
        rules=ObstacleRules("required", MARGIN_M),
    )
    flight.turn_to(heading)
    goto = GotoBehaviour(
        from_home_m=((away_m + 10.0) * math.cos(heading), (away_m + 10.0) * math.sin(heading)),
        speed_mps=float(rng.uniform(2.0, 4.0)),
    )
    log = flight.fly(goto, FLIGHT_S)
    ranges = [range_to(thing, moment.truth.position_ned_m) for moment in log.moments]
    nearest_m, crashed = min(ranges), "crash" in log.violations
    backwards_m = ranges[-1] - nearest_m
    there = log.outcome is not None and log.outcome.success
    success = not crashed and nearest_m >= MARGIN_M - ALLOWED_M and not (wall and there)
    reason = log.outcome.reason if log.outcome is not None else "stopped"
    return FlightResult(
        seed,
        success,
        {
            "nearest_m": nearest_m,
            "bounced_back_m": backwards_m if wall else math.nan,
            "fastest_mps": max(math.hypot(*m.truth.velocity_ned_mps[:2]) for m in log.moments),
        },
        f"{reason}; nearest {nearest_m:.2f} m{', crashed' if crashed else ''}",
    )
