"""Labelled images: repeatable from a seed, visible labels."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mavlink_sim.camera.renderer import Rendered
from mavlink_sim.datasets.training_scenes import (
    LEARNED_SIDE_PX,
    MIN_AREA_PX,
    MIN_SIDE_PX,
    Boxes,
    ClassIds,
    flight_frame,
    random_scene,
    render_dataset,
    training_frame,
    training_scene,
    world_frame,
)
from mavlink_sim.world.shapes import CLASS_NAMES
from mavlink_sim.world.textures import Image

Scenes = list[tuple[Image, Boxes, ClassIds]]


@pytest.fixture(scope="module")
def scenes() -> Scenes:
    return list(render_dataset(24, 7, 256, 256))


def test_a_scene_follows_from_its_generator_alone() -> None:
    first = random_scene(np.random.default_rng(5), 192, 160)
    random_scene(np.random.default_rng(6), 256, 192)
    again = random_scene(np.random.default_rng(5), 192, 160)
    both: Iterable[tuple[NDArray[Any], NDArray[Any]]] = zip(first, again, strict=True)
    for one, other in both:
        assert np.array_equal(one, other)


def test_image_i_is_independent_of_count() -> None:
    short = list(render_dataset(2, 3, 128, 128))
    long = list(render_dataset(3, 3, 128, 128))
    assert np.array_equal(short[1][0], long[1][0])
    assert not np.array_equal(short[0][0], short[1][0])


def test_scenes_have_the_size_and_types_they_promise(scenes: Scenes) -> None:
    for image, boxes, ids in scenes:
        assert image.shape == (256, 256, 3)
        assert image.dtype == np.uint8
        assert image.flags.c_contiguous
        assert boxes.dtype == np.float32
        assert boxes.shape == (len(ids), 4)
        assert ids.dtype == np.int64


def test_labels_are_inside_image_and_large_enough(scenes: Scenes) -> None:
    for _, boxes, ids in scenes:
        sides = boxes[:, 2:] - boxes[:, :2]
        assert (boxes >= 0).all()
        assert (boxes <= 256).all()
        assert (sides >= MIN_SIDE_PX).all()
        assert (sides.prod(axis=1) >= MIN_AREA_PX).all()
        assert ((ids >= 0) & (ids < len(CLASS_NAMES))).all()


def test_most_images_show_several_objects(scenes: Scenes) -> None:
    counts = np.array([len(ids) for _, _, ids in scenes])
    assert 3.0 < counts.mean() < 10.0
    assert counts.max() <= 14
    assert {int(name) for _, _, ids in scenes for name in ids} == set(range(len(CLASS_NAMES)))
    empties = [len(random_scene(np.random.default_rng((1, n)), 64, 64)[2]) == 0 for n in range(40)]
    assert any(empties)


def test_the_focal_length_is_within_what_was_asked() -> None:
    """A longer lens makes objects larger: with only long lenses the boxes grow."""

    def mean_side(focal_px: tuple[float, float]) -> float:
        sides: list[float] = []
        for n in range(12):
            _, boxes, _ = random_scene(np.random.default_rng((2, n)), 256, 256, focal_px)
            sides += np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(axis=1)).tolist()
        return float(np.median(sides))

    assert mean_side((500.0, 600.0)) > mean_side((120.0, 150.0))


@pytest.mark.parametrize("draw", [flight_frame, world_frame, training_frame])
def test_other_frames_follow_from_their_generator_too(draw: Callable[..., Rendered]) -> None:
    first, again = (draw(np.random.default_rng(5), 160, 128) for _ in range(2))
    assert np.array_equal(first.image, again.image)
    assert first.image.shape == (128, 160, 3)
    assert not np.array_equal(first.image, draw(np.random.default_rng(6), 160, 128).image)


def test_too_small_objects_have_negative_id() -> None:
    small = 0
    for n in range(12):
        _, boxes, ids = training_scene(np.random.default_rng((3, n)), 160, 128)
        sides = boxes[:, 2:] - boxes[:, :2]
        assert (sides[ids >= 0] >= LEARNED_SIDE_PX).all()
        assert ((ids >= -len(CLASS_NAMES)) & (ids < len(CLASS_NAMES))).all()
        small += int((ids < 0).sum())
    assert small > 0


def test_flights_have_every_kind_of_distractor_and_far_objects() -> None:
    ranges, names = [], set()
    for n in range(30):
        for item in flight_frame(np.random.default_rng((4, n)), 160, 128).objects:
            names.add(item.world_object.class_name)
            if item.world_object.class_name in CLASS_NAMES:
                ranges.append(item.range_m)
    assert {"autumn_tree", "building", "plate"} < names
    assert max(ranges) > 40.0
    assert min(ranges) < 6.0
