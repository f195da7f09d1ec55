"""Time from a depth image to filtered clusters, on rendered frames.

    python -m benchmarks.point_cloud --frames 60 --seed 11 [--json]

Conditions: 640x480 frames in memory, as in `benchmarks.range_error`, of a stereo camera with a 5 cm baseline.
`points`: in NED with colour, 0.3 to 20 m, each the mean of 4x4 pixels. `scene`: `scene_of` with voxels of
0.1 m: voxel grid, ground plane, statistical outliers, clusters with both boxes. `cpu`: of all threads.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np

from benchmarks.range_error import View, views
from mavlink_sim.camera.renderer import DEFAULT_CAMERA, DEFAULT_MOUNT
from vision.point_cloud import cloud_from_depth, scene_of
from vision.rotation import matrix_from_quaternion

DOWN = np.array([0.0, 0.0, 1.0])
RANGE_M, AVERAGE, VOXEL_M = (0.3, 20.0), 4, 0.1


def timed(view: View) -> dict[str, float]:
    """Milliseconds of both stages, and what they gave, for one frame."""
    cpu_s, begin_s = time.process_time(), time.perf_counter()
    cloud = cloud_from_depth(
        view.depth_m,
        DEFAULT_CAMERA,
        image=view.image,
        frame="ned",
        mount=DEFAULT_MOUNT,
        ned_from_body=matrix_from_quaternion(view.attitude),
        range_m=RANGE_M,
        average=AVERAGE,
    )
    middle_s = time.perf_counter()
    scene = scene_of(cloud, DOWN, voxel_m=VOXEL_M)
    end_s = time.perf_counter()
    return {
        "points_ms": (middle_s - begin_s) * 1e3,
        "scene_ms": (end_s - middle_s) * 1e3,
        "total_ms": (end_s - begin_s) * 1e3,
        "cpu_ms": (time.process_time() - cpu_s) * 1e3,
        "points": len(cloud),
        "voxels": len(scene.voxels),
        "above_ground": len(scene.objects),
        "clusters": len(scene.clusters),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    frames = list(views(arguments.seed, arguments.frames))
    timed(frames[0])  # the rays of the camera are computed once
    results = [timed(view) for view in frames]
    table = {
        name: [
            round(float(value), 1) for value in np.percentile([each[name] for each in results], (50, 95, 100))
        ]
        for name in results[0]
    }
    if arguments.json:
        print(json.dumps(table))
        return
    print(f"{'':14s} {'p50':>9s} {'p95':>9s} {'max':>9s}")
    for name, values in table.items():
        print(f"{name:14s} " + " ".join(f"{value:9.1f}" for value in values))


if __name__ == "__main__":
    main()
