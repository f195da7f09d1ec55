"""Distortion and shutter against the geometry; the effects of the sensor; depth as a stereo camera's."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.camera.depth_camera import DepthSensor, measured_depth
from mavlink_sim.camera.image_effects import ImageEffects, Sensor
from mavlink_sim.camera.lens import CameraMotion, Shutter
from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.camera_model import CameraModel, CameraMount
from vision.rotation import matrix_from_euler

GROUND = Ground(("concrete",), 0, 256, 0.05)
PLAIN = CameraModel.from_horizontal_fov(160, 120, math.radians(80.0))
BARREL = (-0.2, 0.05, 0.001, -0.002)
LEVEL = np.eye(3)


def bent(distortion: tuple[float, ...]) -> CameraModel:
    return CameraModel(160, 120, PLAIN.fx, PLAIN.fy, 81.0, 58.5, distortion)


@settings(max_examples=20, deadline=None)
@given(
    k1=st.floats(-0.1, 0.15),
    k2=st.floats(0.0, 0.05),
    tangential=st.floats(-0.003, 0.003),
    pitch=st.floats(-1.5, -0.3),
    yaw=st.floats(-3.0, 3.0),
)
def test_point_on_ground_is_seen_where_camera_model_projects_it(
    k1: float, k2: float, tangential: float, pitch: float, yaw: float
) -> None:
    camera, mount = bent((k1, k2, tangential, -tangential)), CameraMount()
    attitude = matrix_from_euler(0.1, pitch, yaw)
    rendered = Renderer(World((), GROUND), camera, mount).render((1.0, 2.0, -6.0), attitude)
    assert rendered.image.shape == (120, 160, 3)
    ahead = attitude @ mount.body_from_optical @ np.array([0.0, 0.0, 1.0])
    middle = ahead[:2] / ahead[2] * 6.0
    north, east = (axis.ravel() for axis in np.meshgrid(np.linspace(-4, 4, 13), np.linspace(-4, 4, 13)))
    offsets = np.column_stack([middle[0] + north, middle[1] + east, np.full(len(north), 6.0)])
    optical = offsets @ (attitude @ mount.body_from_optical)
    pixels = camera.project(optical)
    # Far outside the image the polynomial may bend points back into it.
    plane = np.hypot(*(optical[:, :2] / optical[:, 2:]).T)
    inside = (pixels > 1).all(axis=1) & (pixels < (158, 118)).all(axis=1) & (optical[:, 2] > 0) & (plane < 1)
    assert inside.any()
    columns, rows = np.rint(pixels[inside]).astype(int).T
    around = np.array([rendered.depth_m[rows + i, columns + j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    depth = optical[inside, 2]
    assert np.all(around.min(axis=0) - 1e-3 <= depth)
    assert np.all(depth <= around.max(axis=0) + 1e-3)


def test_distorted_box_contains_projected_corners() -> None:
    camera, mount = bent(BARREL), CameraMount()
    car = WorldObject(0, "car", (9.0, 4.0, 0.0), 0.7)
    attitude = matrix_from_euler(0.0, -0.15, 0.0)
    renderer = Renderer(World((car,), GROUND), camera, mount)
    rendered = renderer.render((0.0, 0.0, -2.0), attitude)
    (seen,) = rendered.objects
    shape = car.shape
    c, s = math.cos(car.yaw_rad), math.sin(car.yaw_rad)
    turned = shape.corners @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + car.position_ned_m
    optical = (turned - (0.0, 0.0, -2.0)) @ (attitude @ mount.body_from_optical)
    points = camera.project(optical)
    low, high = points.min(axis=0), points.max(axis=0)
    assert np.abs(np.array(seen.xyxy) - (low[0], low[1], high[0] + 1, high[1] + 1)).max() < 1.6
    assert seen.visible_fraction > 0.97
    assert seen.pixel_count < (high - low).prod()


def test_identity_lens_gives_the_pinhole_image() -> None:
    world = World((WorldObject(0, "car", (9.0, 1.0, 0.0), 0.7),), GROUND)
    plain = Renderer(world, PLAIN).render((0.0, 0.0, -3.0), LEVEL)
    still = Renderer(world, PLAIN, shutter=Shutter(0.01, 0.02)).render((0.0, 0.0, -3.0), LEVEL)
    assert np.abs(plain.image.astype(int) - still.image).mean() < 2.0  # the ground's dither differs
    assert np.allclose(plain.depth_m, still.depth_m, rtol=1e-4, equal_nan=True)
    assert plain.objects[0].xyxy == still.objects[0].xyxy
    assert plain.objects[0].visible_fraction == pytest.approx(still.objects[0].visible_fraction, abs=0.01)


def pole_columns(rendered_labels: np.ndarray) -> np.ndarray:
    """Mean column of the pole in each row in which it is seen."""
    rows = np.flatnonzero(rendered_labels.any(axis=1))
    return np.array([np.flatnonzero(rendered_labels[row]).mean() for row in rows])


@pytest.mark.parametrize("rate_radps", [2.0, -2.0])
def test_under_a_turning_rolling_shutter_uprights_lean(rate_radps: float) -> None:
    world = World((WorldObject(0, "wall", (6.0, 0.0, 0.0), math.pi, size_m=(0.3, 0.3, 8.0)),), GROUND)
    renderer = Renderer(world, PLAIN, CameraMount(), shutter=Shutter(0.0, 0.03))
    motion = CameraMotion(angular_velocity_radps=(0.0, rate_radps, 0.0))
    rendered = renderer.render((0.0, 0.0, -3.0), LEVEL, motion=motion)
    near = np.nan_to_num(rendered.depth_m, nan=99.0) < 6.2
    near[70:] = False  # below, the ground is near too
    columns = pole_columns(near)
    # From the first row to the 70th the camera turns to the right, so that objects move to the left.
    expected = -rate_radps * 0.03 * 70 / 120 * PLAIN.fx
    assert columns[-1] - columns[0] == pytest.approx(expected, abs=1.2)


def test_rolling_shutter_sideways_shears_ground_by_depth() -> None:
    camera = CameraModel.from_horizontal_fov(320, 240, math.radians(80.0))
    down = matrix_from_euler(0.0, -math.pi / 2, 0.0)
    for height in (2.0, 4.0):
        plate = WorldObject(0, "plate", (0.0, 0.0, 0.0), 0.0, printed=Print("4X4_50", 9, 0.4 * height))
        renderer = Renderer(World((plate,), GROUND), camera, CameraMount(), shutter=Shutter(0.0, 0.03))
        motion = CameraMotion(velocity_mps=(8.0, 0.0, 0.0))
        image = renderer.render((0.0, 0.0, -height), down, motion=motion).image
        book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        corners, identifiers, _ = cv2.aruco.ArucoDetector(book).detectMarkers(image)
        assert np.ravel(identifiers).tolist() == [9]
        upper_left, _, _, lower_left = corners[0].reshape(4, 2)
        rows = lower_left[1] - upper_left[1]
        # Lower rows are read later, when the camera is farther to the right.
        expected = -8.0 * 0.03 * rows / 240 * camera.fx / height
        assert lower_left[0] - upper_left[0] == pytest.approx(expected, abs=1.5)


def test_exposure_blurs_only_along_motion() -> None:
    world = World((), Ground(("paving",), 0, 256, 0.05))
    looking_down = matrix_from_euler(0.0, -math.pi / 2, 0.0)
    renderer = Renderer(world, PLAIN, CameraMount(), shutter=Shutter(0.02))

    def detail(motion: CameraMotion) -> tuple[float, float]:
        image = renderer.render((0.0, 0.0, -3.0), looking_down, motion=motion).image.astype(int)
        return float(np.abs(np.diff(image, axis=1)).mean()), float(np.abs(np.diff(image, axis=0)).mean())

    sharp, smeared = detail(CameraMotion()), detail(CameraMotion(velocity_mps=(15.0, 0.0, 0.0)))
    assert smeared[0] / sharp[0] < 0.6 * smeared[1] / sharp[1]


IMAGES = {
    "black": np.zeros((48, 64, 3), np.uint8),
    "white": np.full((48, 64, 3), 255, np.uint8),
    "every grey": np.arange(48 * 64 * 3, dtype=np.uint32).astype(np.uint8).reshape(48, 64, 3),
    "wider than the stock of noise": np.full((16, 1700, 3), 128, np.uint8),
}


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("sigma", [0.7, 2.0, 9.0, 100.0])
def test_noise_is_independent_of_image_count(name: str, sigma: float) -> None:
    image, effects = IMAGES[name], ImageEffects(noise_sigma=sigma)
    one = Sensor(effects).expose(image, np.random.default_rng(5))
    camera = Sensor(effects)
    camera.expose(image, np.random.default_rng(4))
    assert np.array_equal(camera.expose(image, np.random.default_rng(5)), one)
    assert not np.array_equal(camera.expose(image, np.random.default_rng(6)), one)


def test_noise_has_given_deviation() -> None:
    grey = np.full((480, 640, 3), 128, np.uint8)
    camera = Sensor(ImageEffects(noise_sigma=5.0))
    for seed in range(3):
        noisy = camera.expose(grey, np.random.default_rng(seed)).astype(np.float64)
        assert abs(noisy.std() - 5.0) < 0.1
        assert abs(noisy.mean() - 128.0) < 0.1


def test_images_of_other_sizes_have_noise() -> None:
    camera = Sensor(ImageEffects(noise_sigma=4.0))
    for size in ((30, 40), (30, 40), (1300, 40), (30, 1700), (30, 40)):
        grey = np.full((*size, 3), 128, np.uint8)
        assert 3.5 < float(camera.expose(grey, np.random.default_rng(1)).std()) < 4.5


FOCAL_PX = 400.0
QUIET = DepthSensor(noise_px=0.0, dropout=0.0, minimum_m=0.1, maximum_m=100.0)


def flat(depth_m: float) -> np.ndarray:
    return np.full((48, 64), depth_m, np.float32)


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@given(st.floats(0.5, 60.0))
def test_the_error_is_half_a_step_of_disparity_at_most(depth_m: float) -> None:
    got = measured_depth(flat(depth_m), FOCAL_PX, QUIET, rng())[10, 10]
    disparity = FOCAL_PX * QUIET.baseline_m / depth_m
    if disparity < QUIET.step_px / 2:
        assert np.isnan(got)
    else:
        assert abs(FOCAL_PX * QUIET.baseline_m / got - disparity) <= QUIET.step_px / 2 + 1e-3


def test_depth_steps_grow_with_square_of_range() -> None:
    slope = np.tile(np.linspace(2.0, 20.0, 4000, dtype=np.float32), (2, 1))
    levels = np.unique(measured_depth(slope, FOCAL_PX, QUIET, rng()))
    levels = levels[np.isfinite(levels)]
    assert len(levels) == pytest.approx((10.0 - 1.0) / 0.125, abs=2)
    gaps = np.diff(levels)
    middle = (levels[1:] + levels[:-1]) / 2
    assert np.allclose(gaps, middle**2 * 0.125 / (FOCAL_PX * 0.05), rtol=0.05)


def test_noise_grows_with_the_square_of_the_range() -> None:
    sensor = DepthSensor(step_px=0.0, noise_px=0.1, dropout=0.0, minimum_m=0.1, maximum_m=100.0)
    near, far = (np.nanstd(measured_depth(flat(z), FOCAL_PX, sensor, rng())) for z in (2.0, 8.0))
    assert near == pytest.approx(4.0 * 0.1 / 20.0, rel=0.1)
    assert far / near == pytest.approx(16.0, rel=0.1)


def test_occluded_pixels_have_no_depth() -> None:
    depth = flat(10.0)
    depth[:, 30:40] = 2.0
    got = measured_depth(depth, FOCAL_PX, QUIET, rng())
    # Disparities 10 and 2: the strip of 8 pixels to the left of the near object.
    assert np.isnan(got[:, 23:30]).all()
    assert np.isfinite(got[:, :21]).all()
    assert np.isfinite(got[:, 30:]).all()


def test_out_of_range_and_in_the_sky_there_is_no_depth() -> None:
    sensor = DepthSensor(minimum_m=1.0, maximum_m=8.0, noise_px=0.0, dropout=0.0)
    for depth_m in (0.5, 9.0, np.nan, np.inf):
        assert np.isnan(measured_depth(flat(depth_m), FOCAL_PX, sensor, rng())).all()
    assert np.isfinite(measured_depth(flat(4.0), FOCAL_PX, sensor, rng())).all()


@pytest.mark.parametrize("share", [0.01, 0.1, 0.4])
def test_dropout_share_matches_setting(share: float) -> None:
    sensor = DepthSensor(dropout=share, noise_px=0.0)
    lost = [
        np.isnan(measured_depth(np.full((240, 320), 4.0, np.float32), FOCAL_PX, sensor, rng())).mean()
        for _ in range(3)
    ]
    assert np.mean(lost) == pytest.approx(share, rel=0.35)


def test_zero_baseline_gives_true_depth_unmodified() -> None:
    depth = flat(3.3)
    got = measured_depth(depth, FOCAL_PX, DepthSensor(baseline_m=0.0, dropout=0.2), rng())
    assert np.all(depth == np.float32(3.3))
    assert np.nanmax(got) == np.nanmin(got) == np.float32(3.3)
    measured_depth(depth, FOCAL_PX, DepthSensor(), rng())
    assert np.all(depth == np.float32(3.3))


def test_the_same_draws_give_the_same_depth() -> None:
    first, again = (measured_depth(flat(5.0), FOCAL_PX, DepthSensor(), rng()) for _ in range(2))
    assert np.array_equal(first, again, equal_nan=True)
    assert first.dtype == np.float32
