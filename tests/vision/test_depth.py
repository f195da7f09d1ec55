from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mavlink_sim.camera.depth_camera import DepthSensor, measured_depth
from vision.camera_model import CameraModel, CameraMount
from vision.depth import depth_millimetres, depth_summary, nearest_points, surfaces
from vision.rotation import matrix_from_euler
from vision.sources.depth_images import to_metres

HEIGHT, WIDTH = 48, 64
SMALL = CameraModel.from_horizontal_fov(WIDTH, HEIGHT, math.radians(70.0))
CAMERA = CameraModel.from_horizontal_fov(320, 240, math.radians(70.0))
COLUMNS, ROWS = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
RAYS = CAMERA.rays(np.column_stack([COLUMNS.ravel(), ROWS.ravel()])).T
RAYS /= RAYS[2]  # (3, pixels), at unit depth
LEVEL = np.array([0.0, 1.0, 0.0])


def depth_of(background_m: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), background_m, np.float32)


def depth_at(depth_m: np.ndarray, *box: float) -> float:
    return float(nearest_points(depth_m, np.array([box]), SMALL, LEVEL)[0, 2])


def test_range_is_the_objects_not_the_backgrounds() -> None:
    depth_m = depth_of(30.0)
    depth_m[10:30, 20:40] = 7.0
    # A box a third larger than the object on every side.
    assert depth_at(depth_m, 13, 3, 47, 37) == pytest.approx(7.0)


def test_thin_object_is_nearer_than_its_background() -> None:
    depth_m = depth_of(30.0)
    depth_m[:, 28:32] = 5.0
    assert depth_at(depth_m, 22, 0, 38, 48) == pytest.approx(5.0)


def test_unknown_pixels_do_not_count() -> None:
    depth_m = depth_of(9.0)
    depth_m[::2] = np.nan
    depth_m[1::4] = 0.0
    depth_m[3, :] = np.inf
    assert depth_at(depth_m, 0, 0, 64, 48) == pytest.approx(9.0)


def test_single_near_outliers_are_ignored() -> None:
    depth_m = depth_of(12.0)
    depth_m[20:24, 30:34] = 0.3
    assert depth_at(depth_m, 10, 5, 54, 43) == pytest.approx(12.0)


def test_a_box_of_almost_unknown_depth_has_no_range() -> None:
    depth_m = depth_of(np.nan)
    depth_m[24, 32] = 4.0
    assert math.isnan(depth_at(depth_m, 0, 0, 64, 48))


def test_boxes_outside_the_image_or_not_finite_have_no_range() -> None:
    boxes = np.array([[100, 100, 120, 120], [-50, -50, -10, -10], [np.nan, 0, 10, 10], [0, 0, np.inf, 10]])
    assert np.isnan(nearest_points(depth_of(5.0), boxes, SMALL, LEVEL)).all()


def test_no_boxes_give_no_points() -> None:
    points = nearest_points(depth_of(5.0), np.zeros((0, 4), np.float32), SMALL, LEVEL)
    assert points.shape == (0, 3)
    assert points.dtype == np.float32


def test_a_box_of_one_pixel_has_that_pixels_point() -> None:
    depth_m = depth_of(5.0)
    depth_m[7, 9] = 2.5
    (point,) = nearest_points(depth_m, np.array([[9.2, 7.2, 9.8, 7.8]]), SMALL, LEVEL)
    ray = SMALL.rays(np.array([[9, 7]]))[0]
    assert point == pytest.approx(ray / ray[2] * 2.5, rel=1e-5)


corner = st.floats(-100, 200)


@given(st.tuples(corner, corner, corner, corner), st.floats(0.125, 100, width=32))
def test_every_box_on_a_wall_has_its_depth_or_none(
    box: tuple[float, float, float, float], wall_m: float
) -> None:
    found_m = depth_at(depth_of(wall_m), *box)
    assert math.isnan(found_m) or found_m == pytest.approx(wall_m, rel=1e-5)
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    if 0 <= x < WIDTH - 1 and 0 <= y < HEIGHT - 1:
        assert found_m == pytest.approx(wall_m, rel=1e-5)


@dataclass(frozen=True)
class Scene:
    """A cuboid on level ground before a camera whose lens is above the origin.

    Attributes:
        depth_m: (240, 320) exact. box: edges around the visible part of the cuboid.
        down: gravity in the optical frame. ned_from_optical: (3, 3).
        true_m: horizontal, from the lens to the cuboid.
    """

    depth_m: np.ndarray
    box: tuple[float, float, float, float]
    down: np.ndarray
    ned_from_optical: np.ndarray
    true_m: float


def cuboid_scene(
    *,
    north_m: float = 8.0,
    east_m: float = 0.0,
    yaw_rad: float = 0.0,
    size_m: tuple[float, float, float] = (4.4, 1.8, 1.5),
    height_m: float = 4.0,
    pitch_rad: float = math.radians(-25.0),
    roll_rad: float = 0.0,
) -> Scene:
    """By intersecting each pixel's ray with the ground and with the cuboid (slab method)."""
    ned_from_optical = CameraMount().ned_from_optical(matrix_from_euler(roll_rad, pitch_rad, 0.0))
    directions = ned_from_optical @ RAYS
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    to_cuboid = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    origin = to_cuboid @ np.array([[-north_m], [-east_m], [-height_m]])
    length, width, tall = size_m
    low, high = np.array([[-length / 2], [-width / 2], [-tall]]), np.array([[length / 2], [width / 2], [0.0]])
    with np.errstate(divide="ignore", invalid="ignore"):
        ground_m = np.where(directions[2] > 1e-6, height_m / directions[2], np.nan)
        slopes = to_cuboid @ directions
        first, second = (low - origin) / slopes, (high - origin) / slopes
    enters, leaves = np.minimum(first, second).max(axis=0), np.maximum(first, second).min(axis=0)
    seen = (leaves >= enters) & (enters > 0.0)
    depth_m = np.where(seen, enters, ground_m).reshape(CAMERA.height, CAMERA.width).astype(np.float32)
    where = np.nonzero(seen.reshape(depth_m.shape))
    box = (0.0, 0.0, 0.0, 0.0)
    if len(where[0]):
        box = (where[1].min(), where[0].min(), where[1].max() + 1.0, where[0].max() + 1.0)
    outside = np.maximum(np.abs(origin[:2, 0]) - (length / 2, width / 2), 0.0)
    return Scene(depth_m, box, ned_from_optical[2], ned_from_optical, float(np.hypot(*outside)))


def ground_range_m(scene: Scene, depth_m: np.ndarray, box: tuple[float, float, float, float]) -> float:
    (point,) = nearest_points(depth_m, np.array([box]), CAMERA, scene.down, lens_height_m=4.0)
    north, east, _ = scene.ned_from_optical @ point
    return math.hypot(north, east)


def inside(scene: Scene, margin: float = 4.0) -> bool:
    left, top, right, bottom = scene.box
    near_edge = min(left, top, CAMERA.width - right, CAMERA.height - bottom) < margin
    return not near_edge and (right - left) * (bottom - top) > 200.0


@settings(max_examples=60, deadline=None)
@given(
    yaw_rad=st.floats(-math.pi, math.pi),
    north_m=st.floats(4.0, 14.0),
    east_m=st.floats(-3.0, 3.0),
    pitch_deg=st.floats(-45.0, -10.0),
    roll_deg=st.floats(-10.0, 10.0),
)
def test_nearest_corner_of_a_rotated_cuboid_is_found(
    yaw_rad: float, north_m: float, east_m: float, pitch_deg: float, roll_deg: float
) -> None:
    scene = cuboid_scene(
        yaw_rad=yaw_rad,
        north_m=north_m,
        east_m=east_m,
        pitch_rad=math.radians(pitch_deg),
        roll_rad=math.radians(roll_deg),
    )
    assume(inside(scene))
    assume(scene.true_m > 2.0)
    assert ground_range_m(scene, scene.depth_m, scene.box) == pytest.approx(scene.true_m, abs=0.15)


def middle_error_m(scene: Scene, column: float, *, north_m: float, east_m: float) -> float:
    """Across the line of sight, of a column at half the box's height."""
    row = (scene.box[1] + scene.box[3]) / 2 - 0.5
    north, east, _ = scene.ned_from_optical @ CAMERA.rays(np.array([[column - 0.5, row]]))[0]
    off_rad = math.atan2(east, north) - math.atan2(east_m, north_m)
    return abs(off_rad) * math.hypot(north_m, east_m)


@pytest.mark.parametrize("baseline_m", [None, 0.1])
@pytest.mark.parametrize("east_m", [-2.0, 0.0, 2.0])
def test_middle_of_a_long_object_is_not_that_of_its_box(east_m: float, baseline_m: float | None) -> None:
    rng, boxes_m, middles_m = np.random.default_rng(3), [], []
    at = {"north_m": 11.0, "east_m": east_m}
    for yaw_rad in (0.3, 0.5, 0.7, 2.3, 2.5, 2.7):
        scene = cuboid_scene(yaw_rad=yaw_rad, size_m=(7.0, 2.4, 2.5), height_m=5.0, **at)
        depth_m = scene.depth_m
        if baseline_m is not None:
            depth_m = measured_depth(depth_m, CAMERA.fx, DepthSensor(baseline_m=baseline_m), rng)
        _, (column,) = surfaces(depth_m, np.array([scene.box]), CAMERA, scene.down)
        boxes_m.append(middle_error_m(scene, (scene.box[0] + scene.box[2]) / 2, **at))
        middles_m.append(middle_error_m(scene, float(column), **at))
    assert np.mean(boxes_m) > 0.5
    assert np.mean(middles_m) < 0.5 * np.mean(boxes_m)


def test_background_beside_a_narrow_object_does_not_move_its_middle() -> None:
    depth_m = depth_of(30.0)
    depth_m[10:40, 28:34] = 6.0
    _, (column,) = surfaces(depth_m, np.array([[28, 10, 36, 40]]), SMALL, LEVEL)
    assert abs(column - 32.0) < 1.0


def test_middle_is_the_boxs_where_one_end_has_no_depth() -> None:
    depth_m = depth_of(6.0)
    depth_m[:, 28:34] = 9.0
    depth_m[:, 20:28] = np.nan
    _, (column,) = surfaces(depth_m, np.array([[20, 10, 44, 40]]), SMALL, LEVEL)
    assert column == 32.0


def test_range_is_over_ground_and_not_along_the_axis() -> None:
    scene = cuboid_scene(yaw_rad=0.7, north_m=6.0, height_m=4.0, pitch_rad=math.radians(-35.0))
    (point,) = nearest_points(scene.depth_m, np.array([scene.box]), CAMERA, scene.down)
    assert ground_range_m(scene, scene.depth_m, scene.box) == pytest.approx(scene.true_m, abs=0.1)
    assert float(point[2]) > scene.true_m + 0.5


def test_ground_below_a_box_that_is_too_large_is_not_the_object() -> None:
    scene = cuboid_scene(north_m=9.0, yaw_rad=0.4)
    left, top, right, bottom = scene.box
    larger = (left - 5, top - 5, right + 5, bottom + 12)
    assert ground_range_m(scene, scene.depth_m, larger) == pytest.approx(scene.true_m, abs=0.15)


def test_lens_height_gives_the_ground_of_a_cut_off_box() -> None:
    scene = cuboid_scene(north_m=8.0)
    left, top, right, _ = scene.box
    down_to_the_edge = np.array([[left, top, right, float(CAMERA.height)]])
    ranges_m = [
        math.hypot(*(scene.ned_from_optical @ point)[:2])
        for height_m in (4.0, None)
        for point in nearest_points(scene.depth_m, down_to_the_edge, CAMERA, scene.down, height_m)
    ]
    assert ranges_m[0] == pytest.approx(scene.true_m, abs=0.15)
    assert ranges_m[1] < scene.true_m - 0.5


@pytest.mark.parametrize("yaw_rad", [0.0, 0.5, 1.2])
def test_noise_of_a_stereo_camera_does_not_make_it_nearer(yaw_rad: float) -> None:
    scene = cuboid_scene(north_m=13.0, yaw_rad=yaw_rad)
    rng = np.random.default_rng(1)
    errors_m = []
    for _ in range(10):
        measured = measured_depth(scene.depth_m, CAMERA.fx, DepthSensor(baseline_m=0.1), rng)
        errors_m.append(ground_range_m(scene, measured, scene.box) - scene.true_m)
    assert abs(float(np.median(errors_m))) < 0.25
    assert max(map(abs, errors_m)) < 0.6


@pytest.mark.parametrize("size_m", [(0.5, 0.5, 1.75), (4.4, 1.8, 1.5)], ids=["person", "car"])
def test_noise_does_not_bias_far_ranges(size_m: tuple[float, float, float]) -> None:
    scene = cuboid_scene(north_m=18.0, yaw_rad=0.6, size_m=size_m, height_m=5.0)
    rng, errors = np.random.default_rng(2), []
    for _ in range(20):
        measured = measured_depth(scene.depth_m, CAMERA.fx, DepthSensor(baseline_m=0.1), rng)
        errors.append(ground_range_m(scene, measured, scene.box) / scene.true_m - 1.0)
    assert abs(float(np.mean(errors))) < 0.015
    assert float(np.std(errors)) < 0.015


@pytest.mark.parametrize(("north_m", "yaw_rad"), [(8.5, 0.6), (8.5, 1.2), (10.0, 1.2)])
def test_noise_of_the_ground_in_a_rolled_box_is_not_the_object(north_m: float, yaw_rad: float) -> None:
    """The ground in its lower corners is nearer than the object."""
    scene = cuboid_scene(
        north_m=north_m, yaw_rad=yaw_rad, height_m=5.5, pitch_rad=math.radians(-25), roll_rad=math.radians(13)
    )
    left, top, right, bottom = scene.box
    larger = (left - 4, top - 4, right + 4, bottom + 4)
    rng = np.random.default_rng(3)
    for _ in range(10):
        measured = measured_depth(scene.depth_m, CAMERA.fx, DepthSensor(), rng)
        assert abs(ground_range_m(scene, measured, larger) - scene.true_m) < 0.3


def test_object_in_front_is_not_the_one_behind_it() -> None:
    depth_m = depth_of(30.0)
    depth_m[5:25, 10:50] = 18.0
    depth_m[15:35, 20:40] = 14.0
    behind, front = (10, 5, 50, 25), (20, 15, 40, 35)
    both = nearest_points(depth_m, np.array([behind, front]), SMALL, LEVEL)[:, 2]
    assert both.tolist() == pytest.approx([18.0, 14.0])
    assert depth_at(depth_m, *behind) == pytest.approx(14.0)  # not detected
    # Two boxes of one object hide nothing from each other, nor does a box that hides all of another.
    for box in ((10, 5, 50, 27), (5, 5, 55, 40)):
        found = nearest_points(depth_m, np.array([behind, box]), SMALL, LEVEL)[:, 2]
        assert found.tolist() == pytest.approx([14.0, 14.0])


def test_second_box_of_an_object_does_not_hide_it() -> None:
    """A car at 6 m with trees at 30 m: a loose box, and a tight one whose lower edge is a pixel lower."""
    camera = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
    ground_m = 1.5 * 500.0 / np.maximum(np.arange(480) - 240, 1.0)
    depth_m = np.repeat(np.minimum(30.0, ground_m)[:, None], 640, axis=1)
    left, top, right, bottom = 170, 249, 470, 365
    depth_m[top:bottom, left:right] = 6.0
    noise = np.random.default_rng(1).normal(0.0, 0.01, depth_m.shape)
    depth_m = (1.0 / (1.0 / depth_m + noise)).astype(np.float32)
    tight = (left - 3, top, right + 3, bottom + 1)
    for loose_px in (30, 50, 64, 200):  # IoU 0.79, 0.69, 0.64, 0.37
        loose = (left - 3, top - loose_px, right + 3, bottom)
        points = nearest_points(depth_m, np.array([loose, tight]), camera, LEVEL)
        assert points[:, 2].tolist() == pytest.approx([6.0, 6.0], abs=0.2)


@pytest.mark.parametrize(("columns", "expected_m"), [(12, 14.0), (24, 18.0)])
def test_mostly_hidden_object_keeps_the_nearer_range(columns: int, expected_m: float) -> None:
    behind, front = (10, 5, 50, 25), (20, 15, 40, 35)
    depth_m = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    depth_m[5:15, 20 : 20 + columns] = 18.0  # 15 or 30 % of the box
    depth_m[15:35, 20:40] = 14.0
    points = nearest_points(depth_m, np.array([behind, front]), SMALL, LEVEL)
    assert points[0, 2] == pytest.approx(expected_m)


def test_small_object_in_front_is_ignored() -> None:
    scene = cuboid_scene(north_m=10.0)
    left, top, *_ = map(int, scene.box)
    depth_m = scene.depth_m.copy()
    depth_m[top + 4 : top + 12, left + 10 : left + 13] = 3.0
    assert ground_range_m(scene, depth_m, scene.box) == pytest.approx(scene.true_m, abs=0.15)


def test_summary_of_a_depth_image() -> None:
    depth_m = np.full((480, 640), np.nan, np.float32)
    depth_m[:, 160:] = 3.42
    depth_m[0, 160:164] = (0.0, np.inf, -1.0, np.nan)
    summary = depth_summary(depth_m)
    assert summary.centre_m == pytest.approx(3.42)
    assert summary.valid_share == pytest.approx(0.75 - 4 / (480 * 640))
    depth_m[238, 320] = 100.0  # a wrong pixel
    assert depth_summary(depth_m).centre_m == pytest.approx(3.42)
    depth_m[:, :321] = 0.0  # more than half of the centre is unknown
    assert math.isnan(depth_summary(depth_m).centre_m)
    assert depth_summary(np.zeros((1, 1), np.float32)).valid_share == 0.0


def test_every_whole_millimetre_is_exact() -> None:
    millimetres = np.arange(2**16, dtype=np.uint16).reshape(256, 256)
    depth_m = to_metres(millimetres, None)
    assert math.isnan(depth_m[0, 0])
    assert math.isnan(depth_m[-1, -1])  # 65535: no measurement
    millimetres[-1, -1] = 0
    np.testing.assert_array_equal(depth_millimetres(depth_m), millimetres)


def test_other_depth_is_rounded_and_unknown_stays_unknown() -> None:
    unknown = [0.0, -0.0, -1.0, math.nan, math.inf, -math.inf, 0.0004, 65.536, 1e30]
    depth_m = np.array([[1.2344, 1.2346, 65.5351, *unknown]], np.float32)
    millimetres = depth_millimetres(depth_m)
    assert millimetres.dtype == np.dtype("<u2")
    assert millimetres.tolist() == [[1234, 1235, 65535, *[0] * len(unknown)]]
    assert np.isnan(to_metres(millimetres, None)[0, 3:]).all()
