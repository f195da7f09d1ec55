"""Mirrored and rotated images: lens and mount stay those of the image."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.camera.renderer import Rendered, Renderer
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.camera_model import CameraCalibration, CameraModel, CameraMount
from vision.geolocation import PixelRays
from vision.markers import MarkerDetector, MarkerKind
from vision.orientation import ROTATIONS_DEG, Orientation
from vision.rotation import matrix_from_euler
from vision.sources import Capture, EndOfStream, RawFrame, SequentialSource, SourceSettings

LENS = CameraModel(640, 480, 455.0, 490.0, 301.0, 251.0, (-0.12, 0.03, 0.004, -0.003))
ORIENTATIONS = [Orientation(angle, mirror) for angle in ROTATIONS_DEG for mirror in (False, True)]
orientations = st.sampled_from(ORIENTATIONS)
RATIONAL = CameraModel(
    *(640, 480, 330.0, 331.0, 318.0, 242.0),
    (0.6, 0.08, 0.004, -0.003, 0.002, 0.92, 0.22, 0.012),
    "rational_polynomial",
)
FISHEYE = CameraModel(*(640, 480, 240.0, 250.0, 321.0, 238.0), (-0.02, 0.004, -0.002, 0.0003), "equidistant")
IDEAL_FISHEYE = CameraModel(*(640, 480, 240.0, 250.0, 321.0, 238.0), (0.0,) * 4, "equidistant")
lenses = st.sampled_from([LENS, RATIONAL, FISHEYE, IDEAL_FISHEYE])


def moved(pixel: tuple[int, int], orientation: Orientation) -> tuple[int, int]:
    """Where a pixel (column, row) of a 640x480 image goes, found in an image."""
    image = np.zeros((480, 640), np.float32)
    image[pixel[1], pixel[0]] = 1.0
    row, column = np.argwhere(orientation.pixels(image))[0]
    return int(column), int(row)


def test_image_is_mirrored_and_then_rotated_clockwise() -> None:
    image = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
    assert Orientation(90).pixels(image).tolist() == [[4, 1], [5, 2], [6, 3]]
    assert Orientation(180).pixels(image).tolist() == [[6, 5, 4], [3, 2, 1]]
    assert Orientation(0, mirror=True).pixels(image).tolist() == [[3, 2, 1], [6, 5, 4]]
    assert Orientation(90, mirror=True).pixels(image).tolist() == [[6, 3], [5, 2], [4, 1]]
    for orientation in ORIENTATIONS:
        image = orientation.pixels(np.zeros((480, 640, 3), np.uint8))
        model = orientation.model(LENS)
        assert image.dtype == np.uint8
        assert image.shape == (model.height, model.width, 3)


@settings(max_examples=60, deadline=None)
@given(lenses, orientations, st.integers(0, 639), st.integers(0, 479))
def test_ray_of_a_pixel_turns_with_the_image(
    lens: CameraModel, orientation: Orientation, column: int, row: int
) -> None:
    (before,) = lens.rays(np.array([[column, row]]))
    (after,) = orientation.model(lens).rays(np.array([moved((column, row), orientation)]))
    turn = matrix_from_euler(0.0, 0.0, math.radians(orientation.rotate_deg))
    flipped = before * ((-1.0, 1.0, 1.0) if orientation.mirror else (1.0, 1.0, 1.0))
    np.testing.assert_allclose(after, turn @ flipped, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(ROTATIONS_DEG),
    st.floats(-math.pi, math.pi),
    st.floats(-1.5, 1.5),
    st.floats(-math.pi, math.pi),
    st.integers(0, 639),
    st.integers(0, 479),
)
def test_direction_on_the_body_does_not_change(
    rotate_deg: int, roll: float, pitch: float, yaw: float, column: int, row: int
) -> None:
    orientation = Orientation(rotate_deg)
    mount = CameraMount(0.1, 0.2, 0.3, roll, pitch, yaw)
    turned = orientation.calibration(CameraCalibration(LENS, mount))
    assert turned.mount is not None
    (before,) = LENS.rays(np.array([[column, row]])) @ mount.body_from_optical.T
    pixel = np.array([moved((column, row), orientation)])
    (after,) = turned.model.rays(pixel) @ turned.mount.body_from_optical.T
    np.testing.assert_allclose(after, before, atol=1e-6)
    assert (turned.mount.forward_m, turned.mount.right_m, turned.mount.down_m) == (0.1, 0.2, 0.3)


class OneFrame(Capture):
    """A camera that brings its calibration, and delivers one image with depth."""

    def __init__(self, raw: RawFrame, calibration: CameraCalibration) -> None:
        self._frames = [raw]
        self.calibration = calibration

    def read(self, timeout_s: float) -> RawFrame | None:
        if not self._frames:
            raise EndOfStream
        return self._frames.pop()

    def close(self) -> None:
        """Nothing is open."""


PLATE_NED = (5.0, 0.7, 0.0)


@cache
def rendered_marker(mount: CameraMount) -> Rendered:
    plate = WorldObject(0, "plate", PLATE_NED, 0.4, printed=Print("4X4_50", 7, 0.8))
    world = World((plate,), Ground(("concrete",), 0, 256, 0.05))
    return Renderer(world, LENS, mount).render((0.0, 0.0, -3.0), np.eye(3))


@pytest.mark.parametrize("orientation", ORIENTATIONS, ids=str)
def test_ground_point_is_ranged_equally_by_a_rotated_camera(orientation: Orientation) -> None:
    """A camera fixed with a roll, its image rotated back: the marker's place on the ground stays."""
    mount = CameraMount(0.1, -0.05, 0.0, math.radians(orientation.rotate_deg), math.radians(-35.0), 0.0)
    rendered = rendered_marker(mount)
    # Seen through a mirror, the camera delivers a mirror image and is calibrated with it.
    seen = Orientation(0, orientation.mirror)
    capture = OneFrame(
        RawFrame(seen.pixels(rendered.image), 1, seen.pixels(rendered.depth_m)),
        CameraCalibration(seen.model(LENS), mount),
    )
    wanted = SourceSettings(rotate_deg=orientation.rotate_deg, mirror=orientation.mirror)
    with SequentialSource("test", lambda: capture, wanted) as source:
        frame = source.read()
    assert frame is not None
    assert frame.depth_m is not None
    calibration = source.calibration
    assert calibration is not None
    assert calibration.mount is not None
    assert calibration.mount.roll_rad == pytest.approx(0.0, abs=1e-12)
    assert (frame.width, frame.height) == (calibration.model.width, calibration.model.height)
    (marker,) = MarkerDetector(MarkerKind("4X4_50", 0.8)).detect(frame.image, calibration.model)
    assert marker.identifier == 7
    pixel = calibration.model.project(np.array([marker.position_camera_m]))
    rays = PixelRays.of(calibration.model, calibration.mount, np.eye(3), pixel)
    column, row = np.rint(pixel[0]).astype(int)
    body_ned = np.array([0.0, 0.0, -3.0])
    np.testing.assert_allclose(rays.on_ground(3.0)[0] + body_ned, PLATE_NED, atol=0.02)
    np.testing.assert_allclose(
        rays.at_depth(frame.depth_m[[row], [column]])[0] + body_ned, PLATE_NED, atol=0.03
    )
