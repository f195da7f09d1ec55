"""Error of the positions of tracks: rendered flights, the bundled detector, the functions that fly.

    python -m benchmarks.geolocation --seeds 1..10 [--processes 2] [--depth] [--mount-deg 0.3] [--json]

Each flight shows four standing objects 12 to 40 m ahead, on level ground. The vehicle flies 10 to 15 m
forward and up to 8 m to the side at 3 m/s, 3 to 8 m above the ground, nose forward, in wind of 2 m/s. Camera:
640x480, 80° across, 20° down on the body, 10 frames a second, image size 320; with `--depth` a stereo camera
of 5 cm. Errors: those of the simulated autopilot's estimate (those of PX4, see
`mavlink_sim/physics/estimate_errors.py`), and of the camera's mount, 0.3° one sigma on each axis (or
`--mount-deg`), constant over a flight.

The truth of a detection is a point in the direction of the object's middle, at the range of the nearest point
of its surface; the object is the one whose true box agrees best. Of a track it is these points fused as the
track's positions are. Seen from elsewhere it is another point of a long object, and where something hides a
part of the object the middle of the rest is elsewhere: so the distance to the object's footprint is printed
too, 0 on it. The range is the mean of the ranges.

`bound_…` is what exact boxes and depth would leave: the true points, located by the flight's own estimate and
the believed mount, with depth at their true distance, else where their ray meets the ground, and fused the
same way.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.flights import add_seeds
from benchmarks.rendered import camera_settings, rendered_scene
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose
from companion.guidance.objects.from_detections import Pose
from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.target import Target
from companion.guidance.objects.tracked_object import TrackedObject
from companion.simulation.campaign import ClusterError, SeedError, map_seeds
from companion.vehicle.state import Vector3
from mavlink_sim.camera.renderer import Rendered
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.world.mesh import surface_range_to
from mavlink_sim.world.world import WorldObject, range_to
from vision.camera_model import CameraModel, CameraMount
from vision.rotation import matrix_from_quaternion
from vision.tracking.association import overlaps

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-20.0))
MOUNT_SIGMA_RAD = math.radians(0.3)
SIZES_M = {
    "car": (4.2, 1.8, 1.5),
    "truck": (6.0, 2.3, 2.6),
    "person": (0.5, 0.5, 1.75),
    "bicycle": (1.7, 0.5, 1.1),
}
CHI_SQUARED_95 = 5.99
MIN_FRAMES = 10


@dataclass(frozen=True, slots=True)
class Located:
    """One track against the truth. Detections that the image's edge may cut off are not fused, nor counted.

    Attributes:
        error_m: of the fused position. relative_m: the same without the vehicle's own position error.
        off_m: its distance to the object's footprint.
        bound_m: the error that remains with exact boxes and depth, of pose and mount.
        single_m: median error of its detections. range_m: mean of them.
        moving: it was taken for moving.
        within_95: the truth is in the 95 % ellipse.
    """

    class_name: str
    count: int
    range_m: float
    error_m: float
    relative_m: float
    off_m: float
    bound_m: float
    single_m: float
    moving: bool
    within_95: bool


class _Shown(NamedTuple):
    """A frame, with the vehicle's true pose at its capture and the error of its estimate."""

    vehicle: Vector3
    ned_from_body: NDArray[np.float64]
    drift: NDArray[np.float64]
    rendered: Rendered


_Locate = Callable[[Target, Sequence[float], _Shown], NDArray[np.float64]]


def flight_of(seed: int, *, depth: bool, mount_sigma_rad: float = MOUNT_SIGMA_RAD) -> list[Located]:
    """The tracks of one flight that were seen whole in at least ten frames; the same seed gives the same."""
    rng = np.random.default_rng((seed, 57))
    placed = [_object(name, number, rng) for number, name in enumerate(SIZES_M)]
    scene, _ = rendered_scene(placed, CAMERA, MOUNT, seed, depth=depth)
    errors = rng.normal(0.0, mount_sigma_rad, 3)
    believed = replace(MOUNT, roll_rad=errors[0], pitch_rad=MOUNT.pitch_rad + errors[1], yaw_rad=errors[2])
    settings = camera_settings(CAMERA, believed, {"detector.image_size": "320", "detector.threads": "1"})

    cameras: list[RenderedCamera] = []

    def camera(vehicle: LockstepVehicle) -> RenderedCamera:
        cameras.append(RenderedCamera(settings, scene, vehicle, depth=depth))
        return cameras[0]

    height_m = float(rng.uniform(3.0, 8.0))
    flight = LockstepFlight.airborne(seed=seed, height_m=height_m, wind_mps=2.0, camera=camera)
    flight.turn_to(0.0)
    seen: dict[int, dict[int, Target]] = {}
    shown: dict[int, _Shown] = {}
    poses: dict[int, Pose] = {}
    before = flight.now_ns, *_poses(flight)

    def collect() -> None:
        nonlocal before
        newest = cameras[0].shown
        if newest is not None and (not shown or shown[max(shown)].rendered is not newest):
            shown[before[0]] = _Shown(*before[1:], newest)  # captured at the beginning of the tick
        before = flight.now_ns, *_poses(flight)
        for target in flight.inputs.steering.targets:
            if target.track_id is not None and target.trusted and target.position_covariance is not None:
                seen.setdefault(target.track_id, {})[target.captured_ns] = target
                if target.captured_ns not in poses:
                    poses[target.captured_ns] = flight.inputs.history.at(target.captured_ns)

    def locate(target: Target, point_ned_m: Sequence[float], frame: _Shown) -> NDArray[np.float64]:
        return _located_by_pose(point_ned_m, frame, poses[target.captured_ns], believed, depth=depth)

    forward_m, right_m = rng.uniform(10.0, 15.0), rng.uniform(-8.0, 8.0)
    flight.fly(f"goto north={forward_m:.1f} east={right_m:.1f} heading=0 speed=3", 30.0, on_tick=collect)
    objects = flight.inputs.steering.objects
    tracks = [
        _located(position, [(target, shown[ns]) for ns, target in of_track.items() if ns in shown], locate)
        for track_id, of_track in seen.items()
        if (position := objects.of_track(track_id)) is not None and position.confirmed and position.located(0)
    ]
    return [track for track in tracks if track is not None]


def _poses(flight: LockstepFlight) -> tuple[Vector3, NDArray[np.float64], NDArray[np.float64]]:
    """The vehicle's true position and attitude, and (2,) metres north and east that its estimate is off."""
    true, estimated = flight.vehicle.truth, flight.vehicle.vehicle.estimate.position
    off = np.array(estimated[:2]) - true.position_ned_m[:2]
    return true.position_ned_m, matrix_from_quaternion(true.quaternion), off


def _object(name: str, number: int, rng: np.random.Generator) -> SceneObject:
    north = 18.0 + 5.0 * number + rng.uniform(-2.0, 2.0)
    east, yaw = rng.uniform(-0.35, 0.35) * north, rng.uniform(-math.pi, math.pi)
    return SceneObject(name, SIZES_M[name], lambda _: ScenePose(float(north), float(east), float(yaw)))


def _located(fused: TrackedObject, seen: list[tuple[Target, _Shown]], locate: _Locate) -> Located | None:
    """The track against the object that most of its boxes show; None: fewer than ten show all of it."""
    truths = [_object_of(target, frame.rendered) for target, frame in seen]
    shown = [item for item in truths if item is not None]
    if not shown:
        return None
    identifier = Counter(item.identifier for item in shown).most_common(1)[0][0]
    of_object = [
        (target, _truth(item, frame.vehicle), frame)
        for (target, frame), item in zip(seen, truths, strict=True)
        if item is not None and item.identifier == identifier and not target.cut
    ]
    if len(of_object) < MIN_FRAMES:
        return None
    singles = [
        math.dist(target.position_ned_m[:2], truth)
        for target, truth, _ in of_object
        if target.position_ned_m is not None
    ]
    shifted = [(target, truth + frame.drift, frame) for target, truth, frame in of_object]
    item = next(item for item in shown if item.identifier == identifier)
    # Depth is measured at the object's middle height, the ground at its foot.
    by_pose = [
        (target, locate(target, (*truth, -item.height_m / 2), frame), frame)
        for target, truth, frame in of_object
    ]
    truth, relative, bound = (
        points[-1][1] if fused.moving else _fused(points) for points in (of_object, shifted, by_pose)
    )
    position = np.array(fused.position_at(0)[:2])
    error = position - truth
    major_m, minor_m, orientation = fused.ellipse_at(0)
    axis = np.array((math.cos(orientation), math.sin(orientation)))
    along, across = error @ axis, error @ (-axis[1], axis[0])
    return Located(
        item.class_name,
        len(of_object),
        round(float(np.mean([target.ground_range_m for target, _, _ in of_object])), 2),
        round(math.hypot(*error), 3),
        round(math.hypot(*(position - relative)), 3),
        round(range_to(item, fused.position_at(0)), 3),
        round(math.hypot(*(bound - truth)), 3),
        round(float(np.median(singles)), 3),
        fused.moving,
        bool((along / major_m) ** 2 + (across / minor_m) ** 2 <= CHI_SQUARED_95),
    )


def _fused(of_object: list[tuple[Target, NDArray[np.float64], _Shown]]) -> NDArray[np.float64]:
    """(2,) the true points of a track's detections, fused as the track is."""
    tracks, position = ObjectTable(), None
    for target, (north, east), frame in of_object:
        exact = replace(target, position_ned_m=(float(north), float(east), 0.0), track_id=0)
        tracks.update([exact], frame.vehicle, target.captured_ns)
        position = tracks.of_track(0)
    assert position is not None
    return np.array(position.position_at(0)[:2])


def _located_by_pose(
    point_ned_m: Sequence[float], frame: _Shown, pose: Pose, believed: CameraMount, *, depth: bool
) -> NDArray[np.float64]:
    """(2,) metres north and east: where a true point is by the estimated pose and the believed mount."""
    lens = frame.vehicle + frame.ned_from_body @ MOUNT.position_frd_m
    north, east, down = point_ned_m
    seen = np.array((north, east, down if depth else 0.0)) - lens
    in_camera = MOUNT.ned_from_optical(frame.ned_from_body).T @ seen
    offset = believed.ned_from_optical(pose.ned_from_body) @ in_camera
    own = pose.ned_from_body @ believed.position_frd_m
    if not depth:
        offset *= (pose.height_m - own[2]) / offset[2]
    located: NDArray[np.float64] = np.array(pose.position_ned_m[:2]) + own[:2] + offset[:2]
    return located


def _object_of(target: Target, rendered: Rendered) -> WorldObject | None:
    """The object in the target's box; None: no box agrees by an IoU of 0.5."""
    if not rendered.objects:
        return None
    overlap = overlaps(np.array([seen.xyxy for seen in rendered.objects]), np.array([target.box_xyxy]))[:, 0]
    best = int(overlap.argmax())
    return rendered.objects[best].world_object if overlap[best] >= 0.5 else None


def _truth(item: WorldObject, vehicle: Vector3) -> NDArray[np.float64]:
    """(2,) metres north and east of the point whose position is measured."""
    middle, own = np.array(item.position_ned_m[:2]), np.array(vehicle[:2])
    direction = (middle - own) / np.hypot(*(middle - own))
    point: NDArray[np.float64] = own + direction * surface_range_to(item, vehicle)
    return point


def summary(found: list[Located]) -> dict[str, float]:
    """Medians and 95th percentiles."""
    share = np.array([each.error_m / each.range_m for each in found])
    errors = np.array([each.error_m for each in found])
    relative = np.array([each.relative_m / each.range_m for each in found])
    off = np.array([each.off_m / each.range_m for each in found])
    bound = np.array([each.bound_m / each.range_m for each in found])
    singles = np.array([each.single_m / each.range_m for each in found])
    return {
        "tracks": len(found),
        "median_m": round(float(np.median(errors)), 3),
        "p95_m": round(float(np.percentile(errors, 95)), 3),
        "median_of_range": round(float(np.median(share)), 4),
        "p68_of_range": round(float(np.percentile(share, 68)), 4),
        "p95_of_range": round(float(np.percentile(share, 95)), 4),
        "within_3_percent": round(float(np.mean(share <= 0.03)), 3),
        "relative_median_of_range": round(float(np.median(relative)), 4),
        "relative_p95_of_range": round(float(np.percentile(relative, 95)), 4),
        "relative_within_3_percent": round(float(np.mean(relative <= 0.03)), 3),
        "bound_median_of_range": round(float(np.median(bound)), 4),
        "bound_p95_of_range": round(float(np.percentile(bound, 95)), 4),
        "bound_within_3_percent": round(float(np.mean(bound <= 0.03)), 3),
        "off_median_of_range": round(float(np.median(off)), 4),
        "off_p95_of_range": round(float(np.percentile(off, 95)), 4),
        "off_within_3_percent": round(float(np.mean(off <= 0.03)), 3),
        "single_median_of_range": round(float(np.median(singles)), 4),
        "within_95_ellipse": round(float(np.mean([each.within_95 for each in found])), 3),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns the exit code: 2 for a cluster that does not exist, or a seed that fails."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.geolocation", description="Error of the positions of tracks"
    )
    add_seeds(parser, "1..3")
    parser.add_argument("--depth", action="store_true", help="a camera with depth")
    parser.add_argument(
        "--mount-deg",
        type=float,
        default=math.degrees(MOUNT_SIGMA_RAD),
        help="one sigma of the mount's error",
    )
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object per flight, then the summary"
    )
    given = parser.parse_args(arguments)
    found = []
    try:
        flights = map_seeds(
            partial(flight_of, depth=given.depth, mount_sigma_rad=math.radians(given.mount_deg)),
            given.seeds,
            processes=given.processes,
            ray=given.ray,
        )
        for seed, of_flight in zip(given.seeds, flights, strict=True):
            found += of_flight
            for each in of_flight:
                row = json.dumps({"seed": seed, **asdict(each)}) if given.json else f"{seed:3d} {each}"
                print(row, flush=True)
    except (ClusterError, SeedError) as error:
        print(error, file=sys.stderr)
        return 2
    print(json.dumps(summary(found)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
