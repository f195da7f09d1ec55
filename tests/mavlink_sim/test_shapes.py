"""Objects: realistic sizes, outward faces, painting order."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.world.depth_sort import clip_polygon, depth_sort_tree
from mavlink_sim.world.materials import palette_of
from mavlink_sim.world.shapes import BUILDERS, CLASS_NAMES, VARIANTS, shape_of, variant_of
from mavlink_sim.world.solids import Body, ground_shadows

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
@given(
    seed=st.integers(0, 10_000),
    eye=st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-9, 9)),
)
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


def test_an_unknown_class_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'zebra'.*autumn_tree, bale, barrel"):
        shape_of("zebra", 0)
