"""Marker plates: found by OpenCV's detector at their geometric position."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.fiducials import DICTIONARIES, Print, marker_cells
from mavlink_sim.world.world import Ground, Light, World, WorldObject
from vision.camera_model import CameraModel, CameraMount
from vision.rotation import matrix_from_euler

GROUND = Ground(("concrete",), 0, 256, 0.05)
CAMERA = CameraModel.from_horizontal_fov(480, 360, math.radians(70.0))
DOWN = matrix_from_euler(0.0, -math.pi / 2, 0.0)


def detected(image: np.ndarray, dictionary: str) -> dict[int, np.ndarray]:
    book = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, identifiers, _ = cv2.aruco.ArucoDetector(book, parameters).detectMarkers(image)
    if identifiers is None:
        return {}
    return {
        int(number): points.reshape(4, 2)
        for number, points in zip(np.ravel(identifiers), corners, strict=True)
    }


def corners_of(plate: WorldObject) -> np.ndarray:
    """(4, 3) NED corners of the black square in OpenCV's order: from the upper left, clockwise."""
    assert plate.printed is not None
    half, side = plate.printed.size_m / 2, plate.printed.board_side_m
    c, s = math.cos(plate.yaw_rad), math.sin(plate.yaw_rad)
    if plate.printed.standing:
        local = [
            (0.002, y, -side / 2 + z) for y, z in ((half, -half), (-half, -half), (-half, half), (half, half))
        ]
    else:
        local = [(x, y, -0.004) for x, y in ((half, -half), (half, half), (-half, half), (-half, -half))]
    return np.array([(c * x - s * y, s * x + c * y, z) for x, y, z in local]) + plate.position_ned_m


@pytest.mark.parametrize("dictionary", DICTIONARIES)
def test_every_dictionary_is_found_by_opencv(dictionary: str) -> None:
    plate = WorldObject(0, "plate", (0.0, 0.0, 0.0), 0.4, printed=Print(dictionary, 3, 0.8))
    image = Renderer(World((plate,), GROUND), CAMERA, CameraMount()).render((0.0, 0.0, -2.0), DOWN).image
    assert 3 in detected(image, dictionary)


@settings(max_examples=25, deadline=None)
@given(
    yaw=st.floats(-math.pi, math.pi),
    height=st.floats(2.0, 6.0),
    north=st.floats(-0.5, 0.5),
    identifier=st.integers(0, 49),
)
def test_lying_marker_found_within_a_pixel(yaw: float, height: float, north: float, identifier: int) -> None:
    plate = WorldObject(0, "plate", (north, 0.2, 0.0), yaw, printed=Print("4X4_50", identifier, 0.6))
    renderer = Renderer(World((plate,), GROUND), CAMERA, CameraMount())
    image = renderer.render((0.0, 0.0, -height), DOWN).image
    view = renderer.view((0.0, 0.0, -height), DOWN)
    projected = (corners_of(plate) - view.eye) @ view.pixel_from_ned.T
    wanted = projected[:, :2] / projected[:, 2:]
    found = detected(image, "4X4_50")
    assert identifier in found
    assert np.abs(found[identifier] - wanted).max() < 1.5


@settings(max_examples=10, deadline=None)
@given(turn=st.floats(-0.9, 0.9), distance=st.floats(2.0, 6.0), lift=st.floats(0.0, 1.5))
def test_standing_marker_found_at_its_position(turn: float, distance: float, lift: float) -> None:
    plate = WorldObject(
        0, "plate", (distance, 0.1, -lift), math.pi + turn, printed=Print("APRILTAG_36h11", 7, 0.7, True)
    )
    # In full light: a plate in the shade is darker than the ground behind it, and detectors find its rim.
    world = World((plate,), GROUND, Light(sun_azimuth_rad=math.pi + turn, sun_elevation_rad=0.4, sun=0.9))
    renderer = Renderer(world, CAMERA, CameraMount())
    image = renderer.render((0.0, 0.0, -1.0), np.eye(3)).image
    view = renderer.view((0.0, 0.0, -1.0), np.eye(3))
    projected = (corners_of(plate) - view.eye) @ view.pixel_from_ned.T
    wanted = projected[:, :2] / projected[:, 2:]
    if wanted.min() < 2 or (wanted > (477, 357)).any():
        return
    found = detected(image, "APRILTAG_36h11")
    assert 7 in found
    assert np.abs(found[7] - wanted).max() < 1.8


def test_standing_marker_invisible_from_behind() -> None:
    plate = WorldObject(0, "plate", (3.0, 0.0, 0.0), 0.0, printed=Print("4X4_50", 7, 0.8, True))
    rendered = Renderer(World((plate,), GROUND), CAMERA, CameraMount()).render((0.0, 0.0, -0.5), np.eye(3))
    assert [item.world_object.identifier for item in rendered.objects] == [0]
    assert not detected(rendered.image, "4X4_50")


def test_the_white_margin_is_one_cell_wide() -> None:
    cells = marker_cells("4X4_50", 0)
    assert cells.shape == (8, 8)
    assert np.all(cells[0] == 1.0)
    assert np.all(cells[1, 1:-1] < 0.1)
    assert Print("4X4_50", 0, 0.6).board_side_m == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("dictionary", "identifier", "size", "message"),
    [
        ("4X4_51", 0, 0.5, "4X4_51.*4X4_50"),
        ("4X4_50", 50, 0.5, "50.*4X4_50.*0 to 49"),
        ("4X4_50", 0, 0.0, "0.01 to 50 m"),
    ],
)
def test_invalid_print_refused(dictionary: str, identifier: int, size: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Print(dictionary, identifier, size)


def test_only_plates_have_prints_and_only_structures_a_size() -> None:
    with pytest.raises(ValueError, match="a plate must have a print"):
        WorldObject(0, "plate", (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="a car has its own size"):
        WorldObject(0, "car", (0.0, 0.0, 0.0), size_m=(1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="size must be three lengths"):
        WorldObject(0, "wall", (0.0, 0.0, 0.0), size_m=(1.0, 0.0, 1.0))


def test_wall_has_given_size_and_position() -> None:
    wall = WorldObject(0, "wall", (5.0, 0.0, 0.0), math.pi, size_m=(3.0, 0.2, 0.5))
    assert wall.footprint_m == pytest.approx((-0.1, 0.1, -1.5, 1.5))
    assert wall.height_m == pytest.approx(0.5)
    rendered = Renderer(World((wall,), GROUND), CAMERA, CameraMount()).render((0.0, 0.0, -0.4), np.eye(3))
    assert rendered.depth_m[180, 240] == pytest.approx(4.9, abs=0.01)


def test_shadow_of_raised_object_is_away_from_sun() -> None:
    def dark(height: float) -> np.ndarray:
        block = WorldObject(0, "box", (0.0, 0.0, -height), size_m=(0.4, 0.4, 0.1))
        images = [
            Renderer(World(objects, GROUND), CAMERA, CameraMount()).render((0.0, 0.0, -20.0), DOWN)
            for objects in ((block,), ())
        ]
        ground = cv2.erode((images[0].depth_m > 19.9).astype(np.uint8), np.ones((5, 5))) > 0
        lost = images[1].image.astype(int).sum(axis=2) - images[0].image.astype(int).sum(axis=2)
        rows, columns = np.nonzero((lost > 20) & ground)
        return np.array([rows.mean(), columns.mean()])

    # The sun stands in the south-west at 48°, so the shadow moves to the north-east: up and to the right.
    moved = dark(7.0) - dark(2.0)
    metres = np.array([-moved[0], moved[1]]) * 20.0 / CAMERA.fx
    assert metres == pytest.approx(np.full(2, 5.0 / math.tan(math.radians(48)) / math.sqrt(2)), abs=0.25)
