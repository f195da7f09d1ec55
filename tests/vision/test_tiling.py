"""Tiled detection: no small object is lost, none is found twice, and small frames are one pass."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vision.detections import Detections
from vision.object_detector import Timing
from vision.pipeline import FrameDetector
from vision.tiling import Tile, TiledDetector, merge_passes, tiles_of

NAMES = ("car", "dog")
Edge = Callable[[Tile], int]


@dataclass
class Patches:
    """Detects the bright rectangles of an image that are at least `smallest` of its width."""

    class_names: tuple[str, ...] = NAMES
    smallest: float = 0.0
    asked: list[tuple[int, int]] = field(default_factory=list)
    last_timing: Timing | None = None

    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections:
        import cv2

        height, width = image_bgr.shape[:2]
        self.asked.append((width, height))
        self.last_timing = Timing(1.0, 10.0, 2.0)
        _, _, boxes, _ = cv2.connectedComponentsWithStats((image_bgr[:, :, 0] > 128).astype(np.uint8))
        found = [(x, y, x + w, y + h) for x, y, w, h, _ in boxes[1:] if w >= self.smallest * width]
        xyxy = np.array(found, np.float32).reshape(-1, 4)
        return Detections(
            xyxy, np.full(len(xyxy), 0.8, np.float32), np.zeros(len(xyxy), np.int64), self.class_names
        )


def make_image(width: int, height: int, *boxes: tuple[int, int, int, int]) -> NDArray[np.uint8]:
    image = np.zeros((height, width, 3), np.uint8)
    for left, top, right, bottom in boxes:
        image[top:bottom, left:right] = 255
    return image


def same_boxes(found: Detections, boxes: list[tuple[int, int, int, int]]) -> bool:
    return sorted(map(tuple, found.xyxy.round().astype(int).tolist())) == sorted(boxes)


@settings(max_examples=200, deadline=None)
@given(st.integers(1, 4000), st.integers(1, 3000), st.integers(64, 1000), st.floats(0, 0.8))
def test_tiles_cover_the_frame_with_the_overlap(width: int, height: int, size: int, overlap: float) -> None:
    tiles = tiles_of(width, height, size, overlap)
    axes: tuple[tuple[Edge, Edge, int], ...] = (
        (lambda tile: tile.left, lambda tile: tile.right, width),
        (lambda tile: tile.top, lambda tile: tile.bottom, height),
    )
    for start, end, length in axes:
        spans = sorted({(start(tile), end(tile)) for tile in tiles})
        assert spans[0][0] == 0
        assert spans[-1][1] == length
        assert all(b - a == min(size, length) for a, b in spans)
        for (_, first_end), (second_start, _) in itertools.pairwise(spans):
            assert first_end - second_start >= overlap * size - 1


def test_full_hd_takes_eight_tiles_and_a_whole_frame() -> None:
    detector = Patches()
    tiled = TiledDetector(detector)
    tiled.detect(make_image(1920, 1080))
    assert detector.asked == [(640, 640)] * 8 + [(1920, 1080)]
    assert tiled.last_timing is not None
    assert (tiled.last_timing.preprocess_ms, tiled.last_timing.inference_ms) == (9.0, 90.0)


def test_frame_not_larger_than_a_tile_is_one_pass() -> None:
    detector = Patches()
    tiled: FrameDetector = TiledDetector(detector)
    assert len(tiled.detect(make_image(640, 480, (10, 10, 40, 40)))) == 1
    assert detector.asked == [(640, 480)]
    assert tiled.class_names == NAMES


def test_small_object_is_found_in_a_tile() -> None:
    small = (1500, 700, 1512, 712)
    image = make_image(1920, 1080, small)
    coarse = Patches(smallest=0.015)
    assert len(coarse.detect(image)) == 0
    assert same_boxes(TiledDetector(coarse).detect(image), [small])


def test_an_object_in_the_overlap_is_found_once() -> None:
    boxes = [(440, 300, 520, 380), (560, 500, 630, 560), (100, 460, 180, 520)]
    assert same_boxes(TiledDetector(Patches()).detect(make_image(1920, 1080, *boxes)), boxes)


def test_object_larger_than_a_tile_is_found_once() -> None:
    box = (100, 100, 1800, 1000)
    assert same_boxes(TiledDetector(Patches()).detect(make_image(1920, 1080, box)), [box])


def test_pieces_are_merged_without_the_whole_frame() -> None:
    box = (200, 300, 900, 400)
    found = TiledDetector(Patches(), whole_frame=False).detect(make_image(1280, 640, box))
    assert same_boxes(found, [box])


def one_pass(*found: tuple[tuple[int, int, int, int], float], class_id: int = 0) -> Detections:
    return Detections(
        np.array([box for box, _ in found], np.float32).reshape(-1, 4),
        np.array([confidence for _, confidence in found], np.float32),
        np.full(len(found), class_id),
        NAMES,
    )


def test_objects_within_each_other_in_one_pass_stay_two() -> None:
    within = one_pass(((0, 0, 100, 100), 0.9), ((10, 10, 40, 90), 0.8))
    assert len(merge_passes([within, one_pass()], [np.zeros(2, np.bool_), np.zeros(0, np.bool_)])) == 2


def test_whole_box_beats_a_more_confident_piece() -> None:
    half, whole = one_pass(((0, 0, 50, 100), 0.99)), one_pass(((0, 0, 100, 100), 0.5))
    merged = merge_passes([half, whole], [np.array([True]), np.array([False])])
    assert merged.xyxy.tolist() == [[0, 0, 100, 100]]
    other = one_pass(((0, 0, 100, 100), 0.5), class_id=1)
    assert len(merge_passes([half, other], [np.array([True]), np.array([False])])) == 2


@pytest.mark.parametrize(
    ("values", "expected"), [({"tile_size": 10}, "tile_size"), ({"overlap": 0.9}, "overlap")]
)
def test_invalid_tile_settings_are_rejected(values: dict[str, float], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        TiledDetector(Patches(), **values)  # type: ignore[arg-type]
