from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.camera.depth_camera import DepthSensor, measured_depth
from mavlink_sim.camera.renderer import DEFAULT_CAMERA
from tests.vision.point_cloud.clouds import SMALL, mounts, rotations, seeds
from vision.camera_model import CameraModel, CameraMount
from vision.point_cloud import PointCloud, cloud_from_depth


def depth_image(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth_m = rng.uniform(0.5, 30.0, (SMALL.height, SMALL.width)).astype(np.float32)
    holes = rng.choice(np.array([np.nan, np.inf, 0.0, -1.0], np.float32), depth_m.shape)
    return np.where(rng.random(depth_m.shape) < 0.2, holes, depth_m)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_projected_points_are_the_known_pixels(seed: int) -> None:
    depth_m = depth_image(seed)
    cloud = cloud_from_depth(depth_m, SMALL)
    rows, columns = np.nonzero(np.isfinite(depth_m) & (depth_m > 0.0))
    assert len(cloud) == len(rows)
    assert np.abs(SMALL.project(cloud.points) - np.column_stack([columns, rows])).max() < 0.01
    np.testing.assert_array_equal(cloud.points[:, 2], depth_m[rows, columns])


def test_pixels_of_a_fisheye_across_its_axis_give_no_points() -> None:
    wide = CameraModel(200, 200, 60.0, 60.0, 99.5, 99.5, (0.01, 0.0, 0.0, 0.0), "equidistant")
    cloud = cloud_from_depth(np.full((200, 200), 2.0, np.float32), wide)
    assert 0.5 < len(cloud) / 40_000 < 0.9  # of the square the circle of some 180 degrees
    pixels = wide.project(cloud.points)
    assert np.abs(pixels - np.rint(pixels)).max() < 0.01
    np.testing.assert_allclose(cloud.points[:, 2], 2.0, rtol=1e-6)


@given(seeds, mounts, rotations)
@settings(max_examples=30, deadline=None)
def test_camera_to_body_to_ned_equals_the_single_step(
    seed: int, mount: CameraMount, ned_from_body: np.ndarray
) -> None:
    depth_m = depth_image(seed)
    fixed = replace(mount, stabilized=False)
    camera = cloud_from_depth(depth_m, SMALL, stamp_ns=7)
    body = cloud_from_depth(depth_m, SMALL, frame="body", mount=fixed)
    ned = cloud_from_depth(depth_m, SMALL, frame="ned", mount=fixed, ned_from_body=ned_from_body)
    np.testing.assert_allclose(camera.in_body(fixed).points, body.points, atol=1e-4)
    stepped = camera.in_body(fixed).in_ned(ned_from_body)
    np.testing.assert_allclose(stepped.points, ned.points, atol=1e-4)
    assert (stepped.frame, stepped.stamp_ns) == ("ned", 7)


@given(seeds, mounts, rotations)
@settings(max_examples=20, deadline=None)
def test_ned_points_follow_a_stabilized_mount(
    seed: int, mount: CameraMount, ned_from_body: np.ndarray
) -> None:
    depth_m = depth_image(seed)
    ned = cloud_from_depth(depth_m, SMALL, frame="ned", mount=mount, ned_from_body=ned_from_body)
    optical = cloud_from_depth(depth_m, SMALL).points.astype(np.float64)
    expected = optical @ mount.ned_from_optical(ned_from_body).T + ned_from_body @ mount.position_frd_m
    np.testing.assert_allclose(ned.points, expected, atol=1e-4)


def test_a_wall_ahead_is_forward_in_the_body() -> None:
    camera = CameraModel.from_horizontal_fov(9, 7, 1.0)
    mount = CameraMount(forward_m=0.5, down_m=-0.1)
    cloud = cloud_from_depth(np.full((7, 9), 4.0, np.float32), camera, frame="body", mount=mount)
    np.testing.assert_allclose(cloud.points[:, 0], 4.5, atol=1e-5)
    middle = cloud.points[9 * 3 + 4]
    np.testing.assert_allclose(middle, (4.5, 0.0, -0.1), atol=1e-5)
    assert cloud.points[0, 1] < 0.0 < cloud.points[8, 1]  # left, right


def test_colours_are_rgb_of_the_points_pixels() -> None:
    depth_m = np.full((SMALL.height, SMALL.width), np.nan, np.float32)
    depth_m[4, 6] = 2.0
    image = np.zeros((SMALL.height, SMALL.width, 3), np.uint8)
    image[4, 6] = (10, 20, 30)
    cloud = cloud_from_depth(depth_m, SMALL, image=image)
    assert cloud.colours is not None
    assert cloud.colours.tolist() == [[30, 20, 10]]


def test_range_limits_the_pixels() -> None:
    depth_m = np.full((SMALL.height, SMALL.width), 5.0, np.float32)
    depth_m[:, ::2] = 12.0
    assert len(cloud_from_depth(depth_m, SMALL, range_m=(0.0, 5.0))) == 30 * 20
    assert len(cloud_from_depth(depth_m, SMALL, range_m=(6.0, 12.0))) == 30 * 20


def test_averaging_keeps_a_tilted_plane_and_its_colours() -> None:
    rows, columns = np.mgrid[: SMALL.height, : SMALL.width]
    rays = SMALL.rays(np.column_stack([columns.ravel(), rows.ravel()]))
    normal = np.array([0.1, -0.2, -1.0])
    depth_m = (-4.0 / (rays @ normal) * rays[:, 2]).reshape(rows.shape).astype(np.float32)
    image = np.full((*rows.shape, 3), (1, 2, 3), np.uint8)
    cloud = cloud_from_depth(depth_m, SMALL, image=image, average=3)
    assert len(cloud) == 10 * 13
    assert np.abs(cloud.points @ normal + 4.0).max() < 0.02
    # The first point is at the centre of the first 3 x 3 pixels.
    np.testing.assert_allclose(SMALL.project(cloud.points)[0], (1.0, 1.0), atol=0.05)
    assert cloud.colours is not None
    assert (cloud.colours == (3, 2, 1)).all()


def test_averaging_reduces_a_stereo_cameras_noise() -> None:
    sensor = DepthSensor(dropout=0.0)
    true_m = np.full((DEFAULT_CAMERA.height, DEFAULT_CAMERA.width), 9.7, np.float32)
    depth_m = measured_depth(true_m, DEFAULT_CAMERA.fx, sensor, np.random.default_rng(3))
    single = cloud_from_depth(depth_m, DEFAULT_CAMERA).points[:, 2]
    mean = cloud_from_depth(depth_m, DEFAULT_CAMERA, average=4).points[:, 2]
    assert np.abs(np.median(mean) - 9.7) < 0.03
    assert mean.std() < 0.4 * single.std()


def test_averaging_makes_no_points_between_two_surfaces() -> None:
    depth_m = np.full((SMALL.height, SMALL.width), 3.0, np.float32)
    depth_m[:, 18:] = 9.0  # the edge is inside of a square of 4 x 4
    depth_m[::7] = np.nan
    points = cloud_from_depth(depth_m, SMALL, average=4).points
    assert len(points) > 50
    assert set(np.round(points[:, 2], 4).tolist()) == {3.0, 9.0}


def test_a_depth_image_without_depth_gives_no_points() -> None:
    cloud = cloud_from_depth(
        np.full((30, 40), np.nan, np.float32), SMALL, image=np.zeros((30, 40, 3), np.uint8)
    )
    assert len(cloud) == 0
    assert cloud.colours is not None
    assert cloud.colours.shape == (0, 3)


@given(seeds, st.integers(0, 20))
def test_select_keeps_points_and_colours_together(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(20, 3)).astype(np.float32)
    cloud = PointCloud(points, (points * 10).astype(np.int8).view(np.uint8))
    chosen = rng.permutation(20)[:count]
    part = cloud.select(chosen)
    np.testing.assert_array_equal(part.points, points[chosen])
    assert part.colours is not None
    assert cloud.colours is not None
    np.testing.assert_array_equal(part.colours, cloud.colours[chosen])
