"""A world's objects: positions and ranges, sizes and faces, marker plates as OpenCV finds them."""

from __future__ import annotations

import math
import pickle

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.camera.object_view import palette_of
from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.depth_sort import clip_polygon, depth_sort_tree
from mavlink_sim.world.fiducials import Print, marker_cells
from mavlink_sim.world.shapes import BUILDERS, CLASS_NAMES, VARIANTS, shape_of, variant_of
from mavlink_sim.world.solids import Body, ground_shadows
from mavlink_sim.world.world import Ground, Light, World, WorldObject, demo_world, range_to
from vision.camera_model import CameraModel, CameraMount
from vision.marker_dictionaries import DICTIONARIES
from vision.rotation import matrix_from_euler

SEEDS = range(12)


@pytest.fixture(scope="module", params=SEEDS)
def world(request: pytest.FixtureRequest) -> World:
    return demo_world(request.param)


def cars(world: World) -> list[WorldObject]:
    return [item for item in world.objects if item.class_name == "car"]


def test_a_world_has_every_class_and_one_or_two_cars(world: World) -> None:
    assert {item.class_name for item in world.objects} >= set(CLASS_NAMES)
    assert 1 <= len(cars(world)) <= 2


def test_cars_stand_18_to_35_metres_from_the_origin(world: World) -> None:
    for car in cars(world):
        assert 18.0 <= math.hypot(*car.position_ned_m[:2]) <= 35.0


def test_no_object_within_6_m_of_origin(world: World) -> None:
    assert min(range_to(item, (0.0, 0.0, 0.0)) for item in world.objects) > 6.0


def test_no_object_between_origin_and_car(world: World) -> None:
    for car in cars(world):
        north, east, _ = car.position_ned_m
        for step in range(1, 18):
            point = (north * step / 20, east * step / 20, 0.0)
            others = (range_to(item, point) for item in world.objects if item is not car)
            assert min(others) > 0.0


def test_objects_do_not_overlap(world: World) -> None:
    for item in world.objects:
        for other in world.objects:
            if other is not item:
                assert range_to(item, other.position_ned_m) > 0.0


def test_identifiers_number_the_objects(world: World) -> None:
    assert [item.identifier for item in world.objects] == list(range(len(world.objects)))


def test_seed_makes_same_world_again_and_another_seed_another() -> None:
    assert demo_world(3) == demo_world(3)
    assert demo_world(3) != demo_world(4)


def test_world_pickle_is_small() -> None:
    world = demo_world(1)
    packed = pickle.dumps(world)
    assert pickle.loads(packed) == world
    assert len(packed) < 20_000


@given(
    yaw=st.floats(-math.pi, math.pi),
    bearing=st.floats(-math.pi, math.pi),
    distance=st.floats(0.0, 60.0),
    north=st.floats(-50.0, 50.0),
    scale=st.floats(0.5, 2.0),
)
def test_range_is_least_distance_to_any_point_of_footprint(
    yaw: float, bearing: float, distance: float, north: float, scale: float
) -> None:
    car = WorldObject(0, "car", (north, -7.0, 0.0), yaw, scale, 3)
    point = (north + distance * math.cos(bearing), -7.0 + distance * math.sin(bearing), -12.0)
    rear, front, left, right = car.footprint_m
    c, s = math.cos(yaw), math.sin(yaw)
    steps = [i / 60 for i in range(61)]
    sampled = math.inf
    for a in steps:
        for b in steps:
            x, y = rear + (front - rear) * a, left + (right - left) * b
            sampled = min(
                sampled, math.hypot(north + c * x - s * y - point[0], -7.0 + s * x + c * y - point[1])
            )
    assert range_to(car, point) == pytest.approx(sampled, abs=0.1 * scale)


def test_range_ahead_of_car_is_to_its_bumper() -> None:
    car = WorldObject(0, "car", (10.0, 0.0, 0.0), math.pi, 1.0, 0)
    _, front, _, _ = car.footprint_m
    assert range_to(car, (0.0, 0.0, -3.0)) == pytest.approx(10.0 - front)
    assert range_to(car, (10.0, 0.0, 0.0)) == 0.0


SIZES_M = {
    "person": ((0.25, 1.7), (0.4, 2.1), (1.4, 2.2)),
    "bicycle": ((1.5, 2.0), (0.4, 0.8), (0.95, 1.2)),
    "car": ((3.6, 4.9), (1.7, 2.2), (1.35, 1.95)),
    "truck": ((6.3, 8.1), (2.2, 3.2), (2.7, 3.6)),
    "boat": ((3.4, 6.8), (1.3, 5.0), (0.5, 6.6)),
    "dog": ((0.8, 1.6), (0.15, 0.5), (0.5, 1.2)),
    "chair": ((0.4, 1.0), (0.4, 0.9), (0.7, 1.2)),
}


@pytest.mark.parametrize("class_name", CLASS_NAMES)
def test_variants_have_realistic_sizes(class_name: str) -> None:
    for variant in range(0, VARIANTS[class_name], 3):
        shape = shape_of(class_name, variant)
        length, width, height = shape.high - shape.low
        for size, (least, most) in zip((length, width, height), SIZES_M[class_name], strict=True):
            assert least <= size <= most, (variant, length, width, height)


@pytest.mark.parametrize("class_name", sorted(BUILDERS))
def test_shapes_stand_on_the_ground(class_name: str) -> None:
    shape = shape_of(class_name, 1)
    assert -0.1 <= shape.high[2] < 0.6
    assert shape.low[2] < -0.1


@pytest.mark.parametrize("class_name", sorted(BUILDERS))
def test_every_face_is_flat_and_looks_along_its_normal(class_name: str) -> None:
    shape = shape_of(class_name, 0)
    for face in range(len(shape.normals)):
        points = shape.corners[shape.first[face] : shape.first[face + 1]]
        assert np.abs(points @ shape.normals[face] - shape.offsets[face]).max() < 0.03
    assert np.linalg.norm(shape.normals, axis=1) == pytest.approx(1.0)


def test_faces_of_a_closed_solid_look_outwards() -> None:
    body = Body()
    body.box((1.0, 2.0, 0.5), (2.0, 1.0, 1.0), "wood", yaw_rad=0.7)
    middle = np.array([1.0, 2.0, 0.5])
    for face in body.solids[0].faces:
        normal, offset = face.plane()
        assert normal @ middle < offset


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000), eye=st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-9, 9)))
def test_separate_boxes_painted_far_to_near(seed: int, eye: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(seed)
    body = Body()
    for x in (-3.0, 0.0, 3.0):
        for y in (-3.0, 3.0):
            size = rng.uniform(0.5, 2.5, 3)
            body.box((x, y, float(rng.uniform(-2, 2))), (size[0], size[1], size[2]), "wood")
    order = depth_sort_tree(body.solids).back_to_front(np.array(eye))
    assert sorted(order) == list(range(6))
    position = {solid: index for index, solid in enumerate(order)}
    for near in range(6):
        for far in range(6):
            if near != far and _covers(body.solids[near].corners, body.solids[far].corners, np.array(eye)):
                assert position[near] > position[far]


def _covers(near: np.ndarray, far: np.ndarray, eye: np.ndarray) -> bool:
    """Whether a ray from the eye meets box `near` before box `far` (axis-aligned boxes)."""
    low, high = near.min(axis=0), near.max(axis=0)
    for weight in (0.05, 0.5, 0.95):
        for target in far * weight + far.mean(axis=0) * (1 - weight):
            with np.errstate(divide="ignore", invalid="ignore"):
                a, b = (low - eye) / (target - eye), (high - eye) / (target - eye)
            enter = np.nanmax(np.minimum(a, b))
            leave = np.nanmin(np.maximum(a, b))
            if 1e-6 < enter < leave - 1e-6 and leave < 1.0 - 1e-6:
                return True
    return False


@given(st.floats(0.05, math.pi / 2), st.floats(-math.pi, math.pi))
def test_shadow_ends_where_ray_over_top_meets_ground(elevation: float, azimuth: float) -> None:
    level = math.cos(elevation)
    sun = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
    mast = np.array([(0.0, 0.0, 0.0), (0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 2.0)])
    reach = np.linalg.norm(ground_shadows(mast, (0, len(mast)), sun)[0], axis=1).max()
    assert reach == pytest.approx(2.0 / math.tan(max(elevation, 0.05)), rel=0.02, abs=0.02)


@given(
    st.floats(0, 2 * math.pi),
    st.floats(-3, 3),
    st.lists(st.floats(0, 2 * math.pi), min_size=3, max_size=9, unique=True),
)
def test_a_clipped_polygon_lies_on_the_kept_side(direction: float, offset: float, turns: list[float]) -> None:
    points = np.array([(math.cos(turn), math.sin(turn)) for turn in sorted(turns)])
    normal = np.array([math.cos(direction), math.sin(direction)])
    kept = clip_polygon(points, normal, offset)
    assert (kept @ normal >= offset - 1e-9).all()
    assert len(kept) <= len(points) + 1
    if (points @ normal >= offset).all():
        assert len(kept) == len(points)


def test_variants_and_colours_follow_from_the_appearance_alone() -> None:
    shape = shape_of("car", variant_of("car", 7))
    assert palette_of("car", shape.slots, 7) == palette_of("car", shape.slots, 7)
    colours = {palette_of("car", shape.slots, 7 + 24 * n)[shape.slots.index("paint")] for n in range(30)}
    assert len(colours) > 10


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
