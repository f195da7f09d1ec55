"""Error of the range to objects: rendered frames, the bundled detector, the functions that fly.

    python -m benchmarks.range_error --frames 300 --seeds 11,12 [--json]

Conditions: the built-in camera (640x480, 70° across, 20° down on the body, no distortion) in demo worlds and
in the scene `village`; 2.5 to 8 m above level ground, roll and pitch of the vehicle up to 10°, objects at all
headings, 3 to 25 m away, in the whole width of the image. Boxes are the detector's (image size 320), those
that agree with the truth in class and by an IoU of 0.5, of objects of which 60 % is seen; boxes that the
image's edge cuts are among them. Depth is that of a stereo camera with a baseline of 5 cm (`DepthSensor`).
The pose is exact, but for the share of errors within the targets' own sigma it has the errors that
`companion/guidance/objects/range_error.py` states: tilt, heading and height above home. The truth is the
horizontal distance from the vehicle to the nearest point of the object's surface, or to its footprint, the
rectangle around it (`--truth footprint`).

Sources: `depth`; `depth_exact`, without the sensor's noise; `ground_plane`; `known_height` with the default
heights, as if nothing were known of the ground.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from companion.guidance.objects.from_detections import StateHistory, targets_from_detections
from companion.guidance.objects.range_error import PoseError
from companion.guidance.objects.target import Target
from companion.settings.perception import DetectorSection
from companion.vehicle.state import Quaternion, Vector3, VehicleState
from mavlink_sim.camera.depth_camera import DepthSensor, measured_depth
from mavlink_sim.camera.image_effects import MILD_EFFECTS
from mavlink_sim.camera.renderer import DEFAULT_CAMERA, DEFAULT_MOUNT, Renderer, VisibleObject
from mavlink_sim.camera.scene_file import load_scene
from mavlink_sim.world.mesh import surface_range_to
from mavlink_sim.world.shapes import CLASS_NAMES
from mavlink_sim.world.world import World, WorldObject, demo_world, range_to
from vision.attitude import quaternion_from_euler
from vision.depth import nearest_points
from vision.detections import Detections
from vision.detector import Detector
from vision.pipeline import FrameDetector
from vision.rotation import matrix_from_quaternion
from vision.tracking.association import overlaps

CAPTURED_NS = 1_000_000_000
HEIGHT_M, RANGE_M, TILT_RAD = (2.5, 8.0), (3.0, 25.0), math.radians(10.0)
# Near frames are where most is decided: this share of them is within 15 m.
NEAR_SHARE, NEAR_M = 0.6, 15.0
VILLAGE_SHARE, CAR_SHARE, FRAMES_PER_WORLD = 0.2, 0.4, 12
LEAST_VISIBLE, LEAST_IOU, EDGE_PX = 0.6, 0.5, 1.0
BANDS = {
    "depth": ((3.0, 6.0), (6.0, 10.0), (10.0, 15.0), (3.0, 15.0)),
    "depth_exact": ((3.0, 6.0), (6.0, 10.0), (10.0, 15.0), (3.0, 15.0)),
    "ground_plane": ((5.0, 10.0), (10.0, 15.0), (15.0, 25.0), (5.0, 25.0)),
    "known_height": ((5.0, 10.0), (10.0, 15.0), (15.0, 25.0), (5.0, 25.0)),
}
TRUTHS = ("surface", "footprint")


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One frame and what is in it.

    Attributes:
        image: (H, W, 3) uint8 BGR. depth_m: (H, W) float32, what the sensor says; exact_m: without its noise.
        position_ned_m: of the vehicle. attitude: (w, x, y, z), body FRD to NED.
        estimated: both as an estimator with errors states them.
        objects: those seen.
    """

    image: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    exact_m: NDArray[np.float32]
    position_ned_m: Vector3
    attitude: Quaternion
    estimated: tuple[Vector3, Quaternion]
    objects: list[VisibleObject]


@dataclass(frozen=True, slots=True)
class Sample:
    """One range against the truth.

    Attributes:
        true_m: horizontal, from the vehicle. error_m: what was measured less that; NaN: nothing was measured.
        noisy_m: the same with the estimated pose. sigma_m: the target's own `range_sigma_m` then.
        cut: the object goes beyond the image's edge.
    """

    source: str
    class_name: str
    true_m: float
    error_m: float
    noisy_m: float
    sigma_m: float
    cut: bool


@dataclass(frozen=True, slots=True)
class Row:
    """The errors of one source in one band of true ranges, metres."""

    source: str
    group: str
    count: int
    median_m: float
    median_abs_m: float
    p95_abs_m: float
    within_one_sigma: float
    within_two_sigma: float


def views(seed: int, count: int) -> Iterator[View]:
    """Frames of random worlds from random poses; the same seed gives the same."""
    rng = np.random.default_rng((seed, 41))
    drawn = 0
    while drawn < count:
        renderer = _renderer(rng)
        for _ in range(FRAMES_PER_WORLD):
            view = _view(renderer, rng)
            if view is not None and drawn < count:
                drawn += 1
                yield view


def _renderer(rng: np.random.Generator) -> Renderer:
    if rng.random() < VILLAGE_SHARE:
        world = load_scene("village").world_at(float(rng.uniform(0.0, 60.0)))
    else:
        world = demo_world(int(rng.integers(2**30)))
    return Renderer(world, effects=MILD_EFFECTS, rng=np.random.default_rng(rng.integers(2**30)))


def _view(renderer: Renderer, rng: np.random.Generator) -> View | None:
    """None: no pose was found from which the object drawn is in the image."""
    item = _object(renderer.world, rng)
    for _ in range(60):
        range_m = rng.uniform(RANGE_M[0], NEAR_M if rng.random() < NEAR_SHARE else RANGE_M[1])
        from_object_rad, off_rad = rng.uniform(-math.pi, math.pi), math.radians(rng.uniform(-38.0, 38.0))
        roll_rad, pitch_rad = rng.uniform(-TILT_RAD, TILT_RAD, 2)
        position = _place(item, float(range_m), float(from_object_rad), -float(rng.uniform(*HEIGHT_M)))
        yaw_rad = from_object_rad + math.pi + off_rad
        attitude = quaternion_from_euler(roll_rad, pitch_rad, yaw_rad)
        ned_from_body = matrix_from_quaternion(attitude)
        eye = np.array(position) + ned_from_body @ DEFAULT_MOUNT.position_frd_m
        middle = np.array(item.position_ned_m) - (0.0, 0.0, item.height_m / 2)
        x, y = DEFAULT_CAMERA.project((middle - eye) @ DEFAULT_MOUNT.ned_from_optical(ned_from_body))[0]
        if -40.0 < x < DEFAULT_CAMERA.width + 40.0 and -40.0 < y < DEFAULT_CAMERA.height + 20.0:
            break
    else:
        return None
    rendered = renderer.render(position, ned_from_body)
    exact_m = rendered.depth_m.astype(np.float32, copy=False)
    depth_m = measured_depth(exact_m, DEFAULT_CAMERA.fx, DepthSensor(), rng)
    image = np.ascontiguousarray(rendered.image)
    error, noise = PoseError(), rng.spawn(1)[0]
    tilt_rad = noise.normal(0.0, error.tilt_rad, 2)
    estimated = (
        (position[0], position[1], position[2] + float(noise.normal(0.0, error.height_m))),
        quaternion_from_euler(
            float(roll_rad + tilt_rad[0]),
            float(pitch_rad + tilt_rad[1]),
            float(yaw_rad + noise.normal(0.0, error.heading_rad)),
        ),
    )
    return View(image, depth_m, exact_m, position, attitude, estimated, rendered.objects)


def _object(world: World, rng: np.random.Generator) -> WorldObject:
    wanted = ("car",) if rng.random() < CAR_SHARE else CLASS_NAMES
    items = [item for item in world.objects if item.class_name in wanted]
    return items[int(rng.integers(len(items)))]


def _place(
    item: WorldObject, range_m: float, bearing_rad: float, down_m: float
) -> tuple[float, float, float]:
    """In a direction from the object's middle, so far from its footprint."""
    away_m = range_m
    for _ in range(20):
        north = item.position_ned_m[0] + away_m * math.cos(bearing_rad)
        east = item.position_ned_m[1] + away_m * math.sin(bearing_rad)
        away_m += range_m - range_to(item, (north, east))
    return north, east, down_m


def samples(view: View, detector: FrameDetector, truth: str = "surface") -> list[Sample]:
    """Every source's range to every object that the detector has found in a frame."""
    detections = detector.detect(view.image)
    matched = list(_matched(detections, view))
    exact, estimated = (
        {
            "depth": _targets(_with_depth(detections, view, view.depth_m), pose),
            "depth_exact": _targets(_with_depth(detections, view, view.exact_m), pose),
            "ground_plane": _targets(detections, pose),
            "known_height": _targets(detections, pose, ground=False),
        }
        for pose in ((view.position_ned_m, view.attitude), view.estimated)
    )
    measured = []
    for index, seen in matched:
        item = seen.world_object
        from_m = view.position_ned_m
        true_m = surface_range_to(item, from_m) if truth == "surface" else range_to(item, from_m)
        left, top, right, bottom = seen.xyxy
        inside = min(left, top, DEFAULT_CAMERA.width - right, DEFAULT_CAMERA.height - bottom) > EDGE_PX
        for source, targets in exact.items():
            noisy = estimated[source][index]
            error_m, noisy_m = (
                target.ground_range_m - true_m
                if target.range_source == source.removesuffix("_exact")
                else math.nan
                for target in (targets[index], noisy)
            )
            measured.append(
                Sample(source, item.class_name, true_m, error_m, noisy_m, noisy.range_sigma_m, not inside)
            )
    return measured


def _matched(detections: Detections, view: View) -> Iterator[tuple[int, VisibleObject]]:
    names = np.array(detections.names)
    for seen in view.objects:
        item = seen.world_object
        if item.class_name not in CLASS_NAMES or seen.visible_fraction < LEAST_VISIBLE or not len(detections):
            continue
        overlap = np.where(
            names == item.class_name, overlaps(detections.xyxy, np.array([seen.xyxy]))[:, 0], 0.0
        )
        if overlap.max() >= LEAST_IOU:
            yield int(overlap.argmax()), seen


def _with_depth(detections: Detections, view: View, depth_m: NDArray[np.float32]) -> Detections:
    ned_from_body = matrix_from_quaternion(view.attitude)
    lens_height_m = -view.position_ned_m[2] - float(ned_from_body[2] @ DEFAULT_MOUNT.position_frd_m)
    down = DEFAULT_MOUNT.ned_from_optical(ned_from_body)[2]
    nearest = nearest_points(depth_m, detections.xyxy, DEFAULT_CAMERA, down, lens_height_m)
    return replace(detections, nearest_camera_m=nearest)


def _targets(
    detections: Detections, pose: tuple[Vector3, Quaternion], *, ground: bool = True
) -> tuple[Target, ...]:
    """Without `ground`, home is taken to be at the vehicle's height, and the ground gives no range."""
    (position_ned_m, attitude), history = pose, StateHistory()
    history.add(
        VehicleState(
            attitude_ns=CAPTURED_NS,
            position_ns=CAPTURED_NS,
            attitude=attitude,
            position_ned_m=position_ned_m,
            home_position_ned_m=(0.0, 0.0, 0.0 if ground else position_ned_m[2]),
        )
    )
    heights_m = DetectorSection().heights()
    return targets_from_detections(
        detections.records(), CAPTURED_NS, DEFAULT_CAMERA, DEFAULT_MOUNT, history, heights_m
    )


def rows(measured: Iterable[Sample]) -> list[Row]:
    """By source and band of true ranges; of the widest band also by class, and what the image cuts."""
    measured = list(measured)
    table = []
    for source, bands in BANDS.items():
        own = [sample for sample in measured if sample.source == source and math.isfinite(sample.error_m)]
        groups = {f"{low:g}-{high:g} m": _within(own, low, high) for low, high in bands}
        every = _within(own, *bands[-1])
        middle_m = float(np.median([sample.true_m for sample in every])) if every else 0.0
        groups["near half"] = [sample for sample in every if sample.true_m < middle_m]
        groups["far half"] = [sample for sample in every if sample.true_m >= middle_m]
        groups["cut by the edge"] = [sample for sample in every if sample.cut]
        for name in CLASS_NAMES:
            groups[name] = [sample for sample in every if sample.class_name == name]
        table += [_row(source, group, chosen) for group, chosen in groups.items() if chosen]
    return table


def _within(chosen: list[Sample], low_m: float, high_m: float) -> list[Sample]:
    return [sample for sample in chosen if low_m <= sample.true_m < high_m]


def _row(source: str, group: str, chosen: list[Sample]) -> Row:
    errors = np.array([sample.error_m for sample in chosen])
    of_sigma = np.array([abs(each.noisy_m) / each.sigma_m for each in chosen if math.isfinite(each.noisy_m)])
    return Row(
        source,
        group,
        len(chosen),
        round(float(np.median(errors)), 3),
        round(float(np.median(np.abs(errors))), 3),
        round(float(np.percentile(np.abs(errors), 95)), 3),
        *(round(float(np.mean(of_sigma <= sigmas)), 3) for sigmas in (1.0, 2.0)),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Error of the range to detected objects")
    parser.add_argument("--frames", type=int, default=300, help="frames of each seed")
    parser.add_argument("--seeds", default="1", help="comma separated")
    parser.add_argument("--truth", choices=TRUTHS, default="surface", help="what the range is compared to")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    seeds = [int(seed) for seed in arguments.seeds.split(",")]
    detector = Detector(image_size=320, threads=1)
    measured = [
        sample
        for seed in seeds
        for view in views(seed, arguments.frames)
        for sample in samples(view, detector, arguments.truth)
    ]
    table = rows(measured)
    if arguments.json:
        print(
            json.dumps({"seeds": seeds, "frames": arguments.frames, "rows": [asdict(row) for row in table]})
        )
        return
    print(
        f"{'source':13} {'group':16} {'n':>5} {'median':>8} {'|median|':>8} {'|p95|':>7} {'in 1 sigma':>10} "
        f"{'in 2 sigma':>10}"
    )
    for row in table:
        print(
            f"{row.source:13} {row.group:16} {row.count:5d} {row.median_m:+8.2f} {row.median_abs_m:8.2f} "
            f"{row.p95_abs_m:7.2f} {row.within_one_sigma:10.2f} {row.within_two_sigma:10.2f}"
        )


if __name__ == "__main__":
    main()
