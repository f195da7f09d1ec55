"""Projection and its inverse, for every distortion model, and against OpenCV's."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.camera_model import DISTORTION_MODELS, CameraModel, DistortionModel, pixels_without_rays

PLAIN = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
BARREL = CameraModel(640, 480, 500.0, 505.0, 322.0, 236.0, (-0.35, 0.12, 0.001, -0.002, -0.02))
FOUR = CameraModel(640, 480, 500.0, 505.0, 322.0, 236.0, (-0.3, 0.1, 0.001, -0.002))
RATIONAL = CameraModel(
    640,
    480,
    *(330.0, 331.0, 318.0, 242.0),
    (0.6, 0.08, 0.0004, -0.0003, 0.002, 0.92, 0.22, 0.012),
    "rational_polynomial",
)
FISHEYE = CameraModel(640, 480, 195.0, 196.0, 321.0, 238.0, (-0.02, 0.004, -0.002, 0.0003), "equidistant")
LENSES = {"plain": PLAIN, "barrel": BARREL, "four": FOUR, "rational": RATIONAL, "fisheye": FISHEYE}


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
@given(x=st.floats(-0.5, 639.5), y=st.floats(-0.5, 479.5), range_m=st.floats(0.1, 1000.0))
def test_point_on_a_pixels_ray_is_seen_at_that_pixel(
    camera: CameraModel, x: float, y: float, range_m: float
) -> None:
    ray = camera.rays(np.array([[x, y]]))
    assert np.linalg.norm(ray) == pytest.approx(1.0)
    assert np.abs(camera.project(ray * range_m) - (x, y)).max() < 1e-5


@pytest.mark.parametrize("camera", [BARREL, FOUR, RATIONAL], ids=["barrel", "four", "rational"])
def test_pinhole_models_project_as_opencv(camera: CameraModel) -> None:
    points = np.random.default_rng(1).uniform((-1, -1, 2), (1, 1, 4), (200, 3))
    zero, lens = np.zeros(3), np.array(camera.distortion)
    expected, _ = cv2.projectPoints(points, zero, zero, camera.matrix, lens)
    assert np.allclose(camera.project(points), expected.reshape(-1, 2), atol=1e-9)


def test_fisheye_projects_as_opencv() -> None:
    points = np.random.default_rng(1).uniform((-1, -1, 0.1), (1, 1, 1), (200, 3))
    zero = np.zeros(3)
    lens = np.array(FISHEYE.distortion)
    expected, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, FISHEYE.matrix, lens)
    assert np.allclose(FISHEYE.project(points), expected.reshape(-1, 2), atol=1e-9)


def test_fisheye_sees_beyond_90_degrees_and_its_axis() -> None:
    aside, ahead = np.array([math.sin(1.7), 0.0, math.cos(1.7)]), np.array([0.0, 0.0, 2.0])
    pixels = FISHEYE.project(np.array([aside, ahead, np.zeros(3)]))
    assert np.allclose(FISHEYE.rays(pixels[:1]), aside)
    assert np.allclose(pixels[1], (FISHEYE.cx, FISHEYE.cy))
    assert np.isnan(pixels[2]).all()


def test_fisheye_ends_where_its_polynomial_turns() -> None:
    camera = CameraModel(640, 480, 200.0, 200.0, 320.0, 240.0, (-0.2, 0.0, 0.0, 0.0), "equidistant")
    turning = math.sqrt(1 / 0.6)  # of θ − 0.2 θ³
    rim = 200.0 * (turning - 0.2 * turning**3)
    inside, outside = camera.rays(np.array([[320.0 + rim - 0.5, 240.0], [320.0 + rim + 0.5, 240.0]]))
    assert np.isfinite(inside).all()
    assert np.isnan(outside).all()
    beyond = np.array([[math.sin(turning + 0.01), 0.0, math.cos(turning + 0.01)]])
    assert np.isnan(camera.project(beyond)).all()


def test_pixel_where_the_image_is_folded_has_no_ray() -> None:
    camera = CameraModel(640, 480, 300.0, 300.0, 320.0, 240.0, (-0.5, 0.0, 0.0, 0.0))
    rays = camera.rays(np.array([[320.0, 240.0], [639.0, 479.0]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


@pytest.mark.parametrize("camera", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_coefficients_may_be_a_list(camera: CameraModel) -> None:
    given = replace(camera, distortion=list(camera.distortion))  # type: ignore[arg-type]
    assert given == camera
    assert hash(given) == hash(camera)
    assert np.isfinite(given.rays(np.array([[10.0, 20.0]]))).all()


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_scaled_camera_has_the_same_rays(camera: CameraModel) -> None:
    half = camera.scaled(320, 240)
    assert half.distortion_model == camera.distortion_model
    pixels = np.array([[3.0, 5.0], [630.0, 400.0], [200.0, 100.0]])
    assert np.allclose(half.rays((pixels + 0.5) / 2 - 0.5), camera.rays(pixels))


def test_field_of_view_of_each_model() -> None:
    assert pytest.approx(math.radians(80.0)) == PLAIN.horizontal_fov_rad
    ideal = CameraModel(640, 480, 200.0, 200.0, 319.5, 239.5, (0.0,) * 4, "equidistant")
    assert ideal.horizontal_fov_rad == pytest.approx(640 / 200)
    assert not ideal.rectilinear
    assert PLAIN.rectilinear


# Coefficients within which lenses are, and beyond: most of them fold the image somewhere.
_RANGES: dict[DistortionModel, tuple[float, ...]] = {
    "plumb_bob": (0.5, 0.4, 0.005, 0.005, 0.3),
    "rational_polynomial": (1.0, 0.4, 0.005, 0.005, 0.1, 1.0, 0.4, 0.1),
    "equidistant": (0.3, 0.3, 0.3, 0.3),
}


@st.composite
def any_lens(draw: st.DrawFn) -> CameraModel:
    kind = draw(st.sampled_from(DISTORTION_MODELS))
    coefficients = tuple(draw(st.floats(-most, most)) for most in _RANGES[kind])
    return CameraModel(640, 480, 300.0, 305.0, 322.0, 236.0, coefficients, kind)


@given(camera=any_lens(), seed=st.integers(0, 1000))
def test_a_ray_is_exact_or_missing_for_any_coefficients(camera: CameraModel, seed: int) -> None:
    pixels = np.random.default_rng(seed).uniform((-0.5, -0.5), (639.5, 479.5), (50, 2))
    rays = camera.rays(pixels)
    seen = np.isfinite(rays).all(axis=1)
    assert np.isnan(rays[~seen]).all()
    assert np.abs(camera.project(rays[seen]) - pixels[seen]).max(initial=0.0) < 1e-5
    # A direction further out is never seen nearer to the centre.
    across = np.column_stack([np.sin(angles := np.linspace(0.0, 3.1, 400)), 0.0 * angles, np.cos(angles)])
    columns = replace(camera, distortion=_untilted(camera)).project(across)[:, 0]
    visible = np.isfinite(columns)
    assert (np.diff(columns[visible]) >= -1e-9).all()
    assert not visible[int(np.argmin(visible)) :].any() or visible.all()


def _untilted(camera: CameraModel) -> tuple[float, ...]:
    if camera.distortion_model == "equidistant":
        return camera.distortion
    return (*camera.distortion[:2], 0.0, 0.0, *camera.distortion[4:])


FOLDED = {
    "plumb_bob": replace(PLAIN, distortion=(-0.4, 0.0, 0.0, 0.0)),
    "rising again": replace(PLAIN, distortion=(-0.5, 0.0, 0.0, 0.0, 0.06)),
    "rational": replace(
        PLAIN, distortion=(-0.4, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0), distortion_model="rational_polynomial"
    ),
    "equidistant": CameraModel(640, 480, 300.0, 300.0, 320.0, 240.0, (0.1, -0.4, 0.0, 0.0), "equidistant"),
}


@pytest.mark.parametrize("camera", FOLDED.values(), ids=FOLDED)
def test_fold_inside_the_image_is_named(camera: CameraModel) -> None:
    sentence = pixels_without_rays(camera)
    found = re.search(r"folds the image (\d+) px from its centre \((\d+) degrees", sentence)
    assert found is not None
    rim_px, angle_deg = map(int, found.groups())
    columns = np.array([rim_px - 3, rim_px + 3]) + camera.cx
    inside, outside = camera.rays(np.column_stack([columns, [camera.cy] * 2]))
    assert math.degrees(math.atan2(inside[0], inside[2])) == pytest.approx(angle_deg, abs=7)
    assert np.isnan(outside).all()
    beyond = math.radians(angle_deg + 2)
    assert np.isnan(camera.project(np.array([[math.sin(beyond), 0.0, math.cos(beyond)]]))).all()


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_lens_without_a_fold_has_no_sentence(camera: CameraModel) -> None:
    assert pixels_without_rays(camera) == ""


def test_circle_of_a_fisheye_beyond_90_degrees_is_no_fold() -> None:
    circle = CameraModel(640, 480, 120.0, 120.0, 320.0, 240.0, (-0.06, 0.0, 0.0, 0.0), "equidistant")
    assert np.isnan(circle.rays(np.array([[0.0, 0.0]]))).all()
    assert pixels_without_rays(circle) == ""
