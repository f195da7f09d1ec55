"""The stated sigma of a range holds: of 5,000 simulated targets, 63 to 73 % of the errors are within it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.guidance.objects import range_error
from companion.guidance.objects.from_detections import (
    CONTACT_INSET_M,
    MIN_DEPRESSION_RAD,
    StateHistory,
    _contact_px,
    targets_from_detections,
)
from companion.guidance.objects.target import RangeSource, Target
from companion.vehicle.state import VehicleState
from vision.attitude import quaternion_from_euler
from vision.camera_model import CameraModel, CameraMount
from vision.detections import DetectionRecord
from vision.geolocation import DEPTH_OF_WIDTH
from vision.rotation import matrix_from_quaternion

CAMERA = CameraModel.from_horizontal_fov(1280, 960, math.radians(80))
COUNT = 1_700  # 5,100 in all
T0 = 5_000_000_000
ERROR = range_error.PoseError()
Vector = NDArray[np.float64]


class View(NamedTuple):
    """A pose above level ground, from which an object at a range is in the image.

    Attributes:
        ned_from_optical: true rotation.
        foot: from the vehicle to the object's ground contact, NED.
        tall_m: its height. width_px: of its box.
        roll_rad: of the image.
    """

    euler: Vector
    mount: CameraMount
    ned_from_optical: Vector
    foot: Vector
    tall_m: float
    width_px: float
    roll_rad: float


class Ranged(NamedTuple):
    """A box as detected, and the truth: horizontal range and height below of the point, and its depth."""

    xyxy: tuple[float, float, float, float]
    true_m: float
    drop_m: float
    depth_m: float = math.nan
    nearest: Vector | None = None
    known_m: float | None = None


def random_view(rng: np.random.Generator) -> View:
    range_m, height_m = rng.uniform(3.0, 60.0), rng.uniform(2.0, 30.0)
    tall_m, wide_m = rng.uniform(0.8, 3.5), rng.uniform(0.4, 2.5)
    bearing, euler = rng.uniform(-math.pi, math.pi), rng.uniform(-0.3, 0.3, 3)
    depression = math.atan2(height_m - tall_m / 2, range_m)
    # The mount points at the object, and the attitude off it.
    mount = CameraMount(pitch_rad=-depression)
    euler[2] += bearing
    rotation = mount.ned_from_optical(matrix_from_quaternion(quaternion_from_euler(*euler)))
    foot = np.array((range_m * math.cos(bearing), range_m * math.sin(bearing), height_m))
    width_px = wide_m / math.hypot(range_m, height_m) * CAMERA.fx
    return View(euler, mount, rotation, foot, tall_m, width_px, math.asin(rotation[2, 0]))


def pixel(view: View, point: Vector) -> Vector:
    x, y = CAMERA.project(point @ view.ned_from_optical)[0]
    return np.array((x, y))


def edge_px(rng: np.random.Generator, height_px: float) -> float:
    return float(rng.normal(0.0, range_error.edge_sigma_px(height_px, CAMERA.width)))


def box_about(middle: float, top: float, bottom: float, width: float) -> tuple[float, float, float, float]:
    """Edges are half a pixel beyond the centres of pixels."""
    return (middle + 0.5 - width / 2, top + 0.5, middle + 0.5 + width / 2, bottom + 0.5)


def by_ground(view: View, rng: np.random.Generator) -> Ranged:
    (x, bottom), (_, top) = pixel(view, view.foot), pixel(view, view.foot - (0.0, 0.0, view.tall_m))
    size = np.array([view.width_px]), np.array([bottom - top])
    middle = x - float(_contact_px(*size, view.roll_rad)[0])
    middle -= rng.normal(0.0, range_error.CONTACT_SIGMA * view.width_px)
    inset_m = rng.normal(CONTACT_INSET_M, range_error.INSET_SIGMA_M)
    true_m = math.hypot(*view.foot[:2]) - inset_m
    return Ranged(
        box_about(middle, top, bottom + edge_px(rng, bottom - top), view.width_px), true_m, view.foot[2]
    )


def by_depth(view: View, rng: np.random.Generator) -> Ranged:
    point = view.foot - (0.0, 0.0, rng.uniform(0.0, view.tall_m))
    optical = point @ view.ned_from_optical
    sigma_m = range_error.depth_noise_m(optical[2])
    x, y = CAMERA.project(optical)[0]
    box = box_about(x, y - 10.0, y + 10.0, view.width_px)
    measured = optical * (1.0 + rng.normal(0.0, sigma_m) / optical[2])
    return Ranged(box, math.hypot(*point[:2]), point[2], optical[2], measured)


def by_size(view: View, rng: np.random.Generator) -> Ranged:
    x, bottom = pixel(view, view.foot)
    x -= rng.normal(0.0, range_error.CONTACT_SIGMA * view.width_px)
    range_m = math.hypot(*view.foot[:2])
    slope = (view.tall_m - view.foot[2]) / range_m
    if slope < 0.0:  # from above, the top of the box is the far edge
        share = rng.normal(DEPTH_OF_WIDTH, range_error.DEPTH_OF_WIDTH_SIGMA)
        ends = CAMERA.rays(np.array([(x - view.width_px / 2, bottom), (x + view.width_px / 2, bottom)]))
        ends = ends @ view.ned_from_optical.T
        first, second = np.arctan2(ends[:, 1], ends[:, 0])
        slope /= 1.0 + share * abs(math.remainder(second - first, math.tau))
    top = bottom
    for _ in range(6):  # Newton: the row of that slope in the same column
        at, beyond = (slope_of(view, x, row) for row in (top, top - 1.0))
        top -= (slope - at) / (beyond - at)
    height_px = bottom - top
    box = box_about(x, top + edge_px(rng, height_px), bottom + edge_px(rng, height_px), view.width_px)
    known_m = view.tall_m / (1.0 + rng.normal(0.0, range_error.SIZE_SIGMA_SHARE))
    return Ranged(box, range_m, view.foot[2], known_m=known_m)


def slope_of(view: View, x: float, y: float) -> float:
    north, east, down = CAMERA.rays(np.array((x, y)))[0] @ view.ned_from_optical.T
    return float(-down / math.hypot(north, east))


def ranged_target(view: View, ranged: Ranged, rng: np.random.Generator) -> Target:
    """The target of a detection, by the pose as estimated."""
    euler = view.euler + rng.normal(0.0, (ERROR.tilt_rad, ERROR.tilt_rad, ERROR.heading_rad))
    height_m = view.foot[2] + rng.normal(0.0, ERROR.height_m)
    below_m = 0.0 if ranged.known_m is None else -height_m  # without ground: home is at its height
    history = StateHistory()
    history.add(
        VehicleState(
            attitude_ns=T0,
            position_ns=T0,
            attitude=quaternion_from_euler(*euler),
            position_ned_m=(0.0, 0.0, -height_m),
            home_position_ned_m=(0.0, 0.0, below_m),
        )
    )
    left, top, right, bottom = ranged.xyxy
    record = DetectionRecord(
        class_id=0,
        class_name="thing",
        confidence=0.9,
        xyxy=list(ranged.xyxy),
        center=[(left + right) / 2, (top + bottom) / 2],
        depth_m=None if ranged.nearest is None else float(ranged.nearest[2]),
        nearest_camera_m=None if ranged.nearest is None else ranged.nearest.tolist(),
    )
    heights_m = {} if ranged.known_m is None else {"thing": ranged.known_m}
    (target,) = targets_from_detections([record], T0, CAMERA, view.mount, history, heights_m)
    return target


def errors(
    source: RangeSource, measure: Callable[[View, np.random.Generator], Ranged], seed: int
) -> tuple[Vector, Vector]:
    """(N,) true ranges, and (N, 3) errors of range, distance and depth in sigma; NaN without a depth."""
    rng = np.random.default_rng(seed)
    found: list[tuple[float, ...]] = []
    while len(found) < COUNT:
        view = random_view(rng)
        depression = math.atan2(view.foot[2], math.hypot(*view.foot[:2]))
        if source is RangeSource.GROUND_PLANE and depression < 2.0 * MIN_DEPRESSION_RAD:
            continue
        ranged = measure(view, rng)
        if not (np.isfinite(ranged.xyxy).all() and ranged.true_m > 1.0):
            continue
        left, top, right, bottom = ranged.xyxy
        if min(left, top, CAMERA.width - right, CAMERA.height - bottom) < 5.0:
            continue
        target = ranged_target(view, ranged, rng)
        if target.range_source is source:
            distance_m = math.hypot(ranged.true_m, ranged.drop_m)
            found.append(
                (
                    ranged.true_m,
                    (target.ground_range_m - ranged.true_m) / target.range_sigma_m,
                    (target.distance_m - distance_m) / target.distance_sigma_m,
                    (target.depth_m - ranged.depth_m) / target.depth_sigma_m,
                )
            )
    found_m = np.array(found)
    return found_m[:, 0], found_m[:, 1:]


@pytest.mark.parametrize(
    ("source", "measure"),
    [
        (RangeSource.GROUND_PLANE, by_ground),
        (RangeSource.DEPTH, by_depth),
        (RangeSource.KNOWN_HEIGHT, by_size),
    ],
    ids=["ground", "depth", "known height"],
)
def test_two_thirds_of_the_errors_are_within_one_sigma(
    source: RangeSource, measure: Callable[[View, np.random.Generator], Ranged]
) -> None:
    true_m, in_sigma = errors(source, measure, seed=23)
    near = true_m < np.median(true_m)
    for each in in_sigma.T[: 3 if source is RangeSource.DEPTH else 2]:
        within = np.abs(each) <= 1.0
        for share in (within.mean(), within[near].mean(), within[~near].mean()):
            assert 0.63 <= share <= 0.73
        assert abs(float(np.median(each))) < 0.15
    assert true_m.min() < 5.0
    assert true_m.max() > 50.0
