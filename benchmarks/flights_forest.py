"""Flights of `goto` through a rendered forest, around the trees (`guidance.avoid`).

The goal is 40 m away; between it and the start 45 trees stand at random, 3 m or more apart, over 40 by 30 m.
Depth comes six times a second with a stereo camera's noise, 100 ms late, from the real pipeline; grid and
paths are the perception worker's own, simulated time waits meanwhile. Wind up to 3 m/s with gusts, 2 m/s of
speed. A flight succeeds when it arrives without touching a tree.

    python -m benchmarks.flights_forest --seed 3 --output forest.png

flies one and draws it: the trees, what the grid has seen, the path flown, the last planned path.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.flights import FlightResult
from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.guidance.behaviours.goto import Goto, GotoBehaviour
from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.physics.contact import HALF_HEIGHT_M, RADIUS_M
from mavlink_sim.world.obstacles import Obstacles
from mavlink_sim.world.world import Ground, Light, World, WorldObject
from vision.camera_model import CameraModel, CameraMount
from vision.occupancy_grid import CELL_M, SIZE

# The obstacle sectors and the grid use 160 by 120 pixels of any depth image.
CAMERA = CameraModel.from_horizontal_fov(160, 120, math.radians(80.0))
# Half the pixels' width: with half the disparity's errors the depth has those of the 320 by 240 sensor.
SENSOR = DepthSensor(step_px=0.0625, noise_px=0.04)
# The grid ends at 10 m, and at 2 m/s the obstacle limits ignore what is farther than that.
DRAW_WITHIN_M = 12.0
MOUNT = CameraMount(forward_m=0.1)
RATE_HZ = 6.0
MARGIN_M, HEIGHT_M, SPEED_MPS = 1.0, 2.5, 2.0
AWAY_M, WIDTH_M, TREES, APART_M = 40.0, 30.0, 45, 3.0
# No tree stands this near the start or the goal.
CLEAR_M = 4.0
FLIGHT_S = 240.0
# A whole number of pixels for a cell.
PIXELS_PER_M = 15


def forest(seed: int) -> tuple[WorldObject, ...]:
    """The trees; the start is the origin, the goal `AWAY_M` north."""
    rng = np.random.default_rng((seed, 67))
    points: list[tuple[float, float]] = [(0.0, 0.0), (AWAY_M, 0.0)]
    while len(points) < TREES + 2:
        point = (float(rng.uniform(0.0, AWAY_M)), float(rng.uniform(-WIDTH_M / 2, WIDTH_M / 2)))
        gaps = [CLEAR_M, CLEAR_M, *[APART_M] * (len(points) - 2)]
        if all(math.dist(point, other) >= gap for other, gap in zip(points, gaps, strict=True)):
            points.append(point)
    return tuple(
        WorldObject(number, "tree", (*point, 0.0), appearance=int(rng.integers(2**31)))
        for number, point in enumerate(points[2:])
    )


def run(seed: int, each: Callable[[RenderedCamera, LockstepFlight], None] | None = None) -> FlightResult:
    """One flight. `each` is called with every step of guidance."""
    rng = np.random.default_rng((seed, 68))
    flags = {
        "detector.enabled": "false",
        "guidance.obstacles": "required",
        "guidance.obstacle_margin_m": str(MARGIN_M),
        "guidance.avoid": "true",
    }
    settings = camera_settings(CAMERA, MOUNT, flags)
    trees = forest(seed)
    sensed = CameraSettings(
        model=CAMERA, mount=MOUNT, effects=None, depth=SENSOR, draw_within_m=DRAW_WITHIN_M, seed=seed
    )
    # Nothing looks at the colours: a small tile of ground is made faster.
    scene = Scene(World(trees, Ground(tile_texels=64), Light(shadow=0.0)), {}, sensed, "forest")
    cameras: list[RenderedCamera] = []

    def camera_of(vehicle: LockstepVehicle) -> RenderedCamera:
        cameras.append(RenderedCamera(settings, scene, vehicle, rate_hz=RATE_HZ))
        return cameras[0]

    flight = LockstepFlight.airborne(
        seed=seed,
        height_m=HEIGHT_M,
        wind_mps=float(rng.uniform(0.0, 3.0)),
        camera=camera_of,
        scene=scene,
    )
    obstacles = Obstacles(trees, {}, RADIUS_M, HALF_HEIGHT_M)
    flight.turn_to(0.0)
    nearest_m = math.inf

    def on_step() -> None:
        nonlocal nearest_m
        north, east, down = flight.vehicle.truth.position_ned_m
        around = obstacles.ranges_around((north, east, down - HALF_HEIGHT_M), 0.0, 5.0, 0.0)
        nearest_m = min(nearest_m, *around)
        if each is not None:
            each(cameras[0], flight)

    goto = GotoBehaviour(Goto(north_m=AWAY_M, east_m=0.0, speed_mps=SPEED_MPS))
    log = flight.fly(goto, FLIGHT_S, each=lambda moment: on_step())
    there = log.outcome is not None and log.outcome.success
    collisions = flight.vehicle.truth.collisions
    reason = log.outcome.reason if log.outcome is not None else f"not there after {FLIGHT_S:g} s"
    flown_m = sum(
        math.dist(one.truth.position_ned_m[:2], other.truth.position_ned_m[:2])
        for one, other in zip(log.moments[:-1], log.moments[1:], strict=True)
    )
    return FlightResult(
        seed,
        there and not collisions,
        {
            "collisions": float(collisions),
            "nearest_m": nearest_m,
            "seconds": log.moments[-1].seconds if there else math.nan,
            "flown_m": flown_m if there else math.nan,
            "fastest_mps": max(math.hypot(*m.truth.velocity_ned_mps[:2]) for m in log.moments),
        },
        f"{reason}; nearest {nearest_m:.2f} m, {collisions} collisions",
    )


class Map:
    """Draws a flight, north up."""

    def __init__(self, seed: int) -> None:
        self._trees = forest(seed)
        self._south_m, self._west_m = -6.0, -WIDTH_M / 2 - 4.0
        shape = (round((AWAY_M + 12.0) / CELL_M), round((WIDTH_M + 8.0) / CELL_M))
        self._seen: NDArray[np.float32] = np.zeros(shape, np.float32)
        self._flown: list[tuple[float, float]] = []
        self._planned: tuple[tuple[float, float], ...] = ()

    def add(self, camera: RenderedCamera, flight: LockstepFlight) -> None:
        """One moment: everything in the grid, and where the vehicle is."""
        north, east, _ = flight.vehicle.truth.position_ned_m
        self._flown.append((north, east))
        if camera.planning is None:
            return
        if camera.perceived.planned is not None and camera.perceived.planned.points:
            self._planned = camera.perceived.planned.points
        grid = camera.planning.grid
        row = grid.corner[0] - round(self._south_m / CELL_M)
        column = grid.corner[1] - round(self._west_m / CELL_M)
        rows = slice(max(0, row), min(self._seen.shape[0], row + SIZE))
        columns = slice(max(0, column), min(self._seen.shape[1], column + SIZE))
        part = grid.log_odds[
            rows.start - row : rows.stop - row, columns.start - column : columns.stop - column
        ]
        self._seen[rows, columns] = np.where(part != 0.0, part, self._seen[rows, columns])

    def image(self) -> NDArray[np.uint8]:
        """BGR."""
        cells = np.full((*self._seen.shape, 3), 200, np.uint8)
        cells[self._seen < 0.0] = (255, 255, 255)
        cells[self._seen > 0.6] = (60, 60, 60)
        scale = round(PIXELS_PER_M * CELL_M)
        canvas = np.ascontiguousarray(cells.repeat(scale, axis=0).repeat(scale, axis=1)[::-1])
        for tree in self._trees:
            rear, front, left, right = tree.footprint_m
            cv2.circle(canvas, self._pixel(tree.position_ned_m[:2]), 3, (40, 120, 40), -1)
            radius = round(max(front - rear, right - left) / 2 * PIXELS_PER_M)
            cv2.circle(canvas, self._pixel(tree.position_ned_m[:2]), radius, (60, 160, 60), 1, cv2.LINE_AA)
        for points, colour in ((self._planned, (0, 140, 255)), (self._flown, (200, 40, 40))):
            pixels = np.array([self._pixel(point) for point in points], np.int32)
            cv2.polylines(canvas, [pixels], False, colour, 2, cv2.LINE_AA)
        for point, colour in (((0.0, 0.0), (200, 40, 40)), ((AWAY_M, 0.0), (40, 40, 220))):
            cv2.circle(canvas, self._pixel(point), 7, colour, -1, cv2.LINE_AA)
        return canvas.astype(np.uint8, copy=False)

    def _pixel(self, point: Sequence[float]) -> tuple[int, int]:
        height = self._seen.shape[0] * CELL_M
        return (
            round((point[1] - self._west_m) * PIXELS_PER_M),
            round((height - point[0] + self._south_m) * PIXELS_PER_M),
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly one and draw it."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.flights_forest", description="Draw one flight."
    )
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--output", type=Path, required=True, help="PNG file")
    given = parser.parse_args(arguments)
    drawing = Map(given.seed)
    result = run(given.seed, drawing.add)
    print(f"seed {given.seed}: {result.reason}")
    if not cv2.imwrite(str(given.output), drawing.image()):
        print(f"{given.output}: cannot be written", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
