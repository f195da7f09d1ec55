"""Flights of `goto` through a wall or a pillar, which the rendered depth camera and the real pipeline see.

The place to go to lies behind a wall (even seeds) or a pillar of 2 m (odd ones), 12 to 18 m away, at up to
4 m/s, in up to 3 m/s of wind. Depth comes ten times a second with a stereo camera's noise, 80 ms late. A
flight succeeds when the vehicle's middle never comes nearer to the obstacle than the margin less a metre, and
the wall (nobody gets round it) has stopped it.
"""

from __future__ import annotations

import math

import numpy as np

from benchmarks.flights import FlightResult
from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.guidance.behaviours.goto import Goto, GotoBehaviour
from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.world.world import World, WorldObject, range_to
from vision.camera_model import CameraModel, CameraMount

CAMERA = CameraModel.from_horizontal_fov(320, 240, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1)
MARGIN_M, ALLOWED_M = 2.0, 1.0
HEIGHT_M, FLIGHT_S = 2.5, 25.0
RATE_HZ, LATENCY_S = 10.0, 0.08


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
    settings = camera_settings(
        CAMERA,
        MOUNT,
        {
            "detector.enabled": "false",
            "guidance.obstacles": "required",
            "guidance.obstacle_margin_m": str(MARGIN_M),
        },
    )
    scene = Scene(
        World((thing,)),
        {},
        CameraSettings(model=CAMERA, mount=MOUNT, depth=DepthSensor(), seed=seed),
        "campaign",
    )
    flight = LockstepFlight.airborne(
        seed=seed,
        height_m=HEIGHT_M,
        wind_mps=wind_mps,
        camera=lambda vehicle: RenderedCamera(settings, scene, vehicle, rate_hz=RATE_HZ, latency_s=LATENCY_S),
    )
    flight.turn_to(heading)
    goto = GotoBehaviour(
        Goto(
            north_m=(away_m + 10.0) * math.cos(heading),
            east_m=(away_m + 10.0) * math.sin(heading),
            speed_mps=float(rng.uniform(2.0, 4.0)),
        )
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
