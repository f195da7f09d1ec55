"""Error of the alignment of two rendered views, and whether `determined` separates good from bad ones.

    python -m benchmarks.cloud_alignment --pairs 20 --seed 500 [--json]

Conditions: true depth of the built-in camera up to 20 m, the mean of 2x2 pixels, 2 to 4 m above the ground.
The second view is up to 0.2 m away along each axis and turned by up to 2.3 degrees about each; the start is
the first one's pose. Scenes: `obstacle_course` (walls, boxes, poles), `village`, a demo world for each seed
(flat ground with a few cars and people). `determined`: as `align` says.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.camera.renderer import DEFAULT_CAMERA, DEFAULT_MOUNT, Renderer
from mavlink_sim.camera.scene_file import load_scene
from mavlink_sim.world.world import demo_world
from vision.point_cloud import PointCloud, align, cloud_from_depth
from vision.point_cloud.registration import Method
from vision.rotation import matrix_from_euler

SCENES = ("obstacle_course", "village", "demo")
METHODS: tuple[Method, ...] = ("plane_icp", "gicp")


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two clouds in their vehicles' body frames, and the true pose of the second in the first one's."""

    source: PointCloud
    target: PointCloud
    rotation: NDArray[np.float64]
    translation_m: NDArray[np.float64]


def pair(scene: str, seed: int) -> Pair:
    """Two views of a scene; the same seed gives the same."""
    rng = np.random.default_rng(seed)
    roll_rad, pitch_rad, yaw_rad = rng.uniform(-1, 1, 3) * (0.05, 0.05, 0.3)
    attitude = matrix_from_euler(roll_rad, pitch_rad, yaw_rad)
    position = np.array([rng.uniform(-1, 3), rng.uniform(-2, 2), rng.uniform(-4, -2)])
    rotation, step = matrix_from_euler(*rng.uniform(-0.04, 0.04, 3)), rng.uniform(-0.2, 0.2, 3)
    renderer = _renderer(scene, seed)
    return Pair(
        _cloud(renderer, position + attitude @ step, attitude @ rotation),
        _cloud(renderer, position, attitude),
        rotation,
        step,
    )


@cache
def _bundled(scene: str) -> Renderer:
    return Renderer(load_scene(scene).world_at(0.0))


def _renderer(scene: str, seed: int) -> Renderer:
    return Renderer(demo_world(seed)) if scene == "demo" else _bundled(scene)


def _cloud(renderer: Renderer, position: NDArray[np.float64], attitude: NDArray[np.float64]) -> PointCloud:
    north, east, down = position.tolist()
    rendered = renderer.render((north, east, down), attitude)
    return cloud_from_depth(
        np.asarray(rendered.depth_m, np.float32),
        DEFAULT_CAMERA,
        frame="body",
        mount=DEFAULT_MOUNT,
        range_m=(0.3, 20.0),
        average=2,
    )


def angle_deg(rotation: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Angle between two (3, 3) rotations."""
    return math.degrees(math.acos(min(1.0, (float(np.trace(rotation.T @ other)) - 1.0) / 2.0)))


def measure(pairs: int, seed: int) -> dict[str, list[tuple[float, float]]]:
    """Scene, method and whether it is determined → errors in metres and degrees."""
    errors: dict[str, list[tuple[float, float]]] = {}
    for scene in SCENES:
        for number in range(seed, seed + pairs):
            views = pair(scene, number)
            for method in METHODS:
                found = align(views.source, views.target, method=method)
                kind = "determined" if found.determined else "undetermined"
                error_m = float(np.linalg.norm(found.translation_m - views.translation_m))
                error = (error_m, angle_deg(found.rotation, views.rotation))
                errors.setdefault(f"{scene} {method} {kind}", []).append(error)
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=500)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    errors = measure(arguments.pairs, arguments.seed)
    if arguments.json:
        print(json.dumps(errors))
        return
    print(f"{'':36s} pairs  m p50   worst  deg p50  worst")
    for name, rows in sorted(errors.items()):
        (middle_m, middle_deg), (worst_m, worst_deg) = np.percentile(rows, (50, 100), axis=0)
        print(
            f"{name:36s} {len(rows):5d}  {middle_m:.3f}  {worst_m:.3f}  {middle_deg:7.2f}  {worst_deg:5.2f}"
        )


if __name__ == "__main__":
    main()
