"""Identical images are found, by their content alone."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.frame import Frame
from vision.frame_changes import MAX_ROWS, FrameChanges


def image(seed: int, height: int = 48) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, 64, 3), dtype=np.uint8)


def depth(seed: int) -> np.ndarray:
    values = np.random.default_rng(seed).uniform(1.0, 20.0, (48, 64)).astype(np.float32)
    values[:, ::3] = np.nan
    return values


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 2)), min_size=1, max_size=12))
def test_stamps_are_those_of_the_first_identical_image(shown: list[tuple[int, int]]) -> None:
    changes = FrameChanges()
    for index, (colour, depth_seed) in enumerate(shown):
        frame = changes.stamped(Frame(image(colour), index, index, depth(depth_seed)))
        for stamp, kind in ((frame.image_since_ns, 0), (frame.depth_since_ns, 1)):
            first = index
            while first and shown[first - 1][kind] == shown[index][kind]:
                first -= 1
            assert stamp == first
    pairs = list(pairwise(shown))
    assert changes.repeated["image"] == sum(one[0] == two[0] for one, two in pairs)
    assert changes.repeated["depth"] == sum(one[1] == two[1] for one, two in pairs)


@pytest.mark.parametrize("height", [48, MAX_ROWS + 1])
def test_one_changed_pixel_is_a_new_image(height: int) -> None:
    changes, before = FrameChanges(), image(0, height)
    after = before.copy()
    after[0, 5, 1] ^= 1
    stamps = [
        changes.stamped(Frame(shown, stamp, 0)).image_since_ns for stamp, shown in ((1, before), (2, after))
    ]
    assert stamps == [1, 2]


def test_a_reused_buffer_is_compared_by_its_content() -> None:
    changes, buffer = FrameChanges(), image(0)
    changes.stamped(Frame(buffer, 1, 0))
    buffer += 1
    assert changes.stamped(Frame(buffer, 2, 1)).image_since_ns == 2


def test_unknown_depth_everywhere_is_no_repetition() -> None:
    changes, sky = FrameChanges(), np.full((48, 64), np.nan, np.float32)
    stamps = [changes.stamped(Frame(image(n), n, n, sky)).depth_since_ns for n in (1, 2, 3)]
    assert stamps == [1, 2, 3]
    assert changes.repeated["depth"] == 0


def untextured(kind: str) -> np.ndarray:
    shown = np.zeros((480, 64, 3), np.uint8)
    if kind == "sky":
        shown[:] = np.linspace(230, 120, 480, dtype=np.uint8)[:, None, None]
    elif kind == "level horizon":
        shown[:240], shown[240:] = (178, 178, 178), (90, 110, 80)
    elif kind == "night with a lamp":
        shown[300:308, 40:44] = 255
    return shown


@pytest.mark.parametrize("kind", ["black", "sky", "level horizon", "night with a lamp"])
def test_image_without_texture_is_no_repetition(kind: str) -> None:
    changes, shown = FrameChanges(), untextured(kind)
    stamps = [changes.stamped(Frame(shown, n, n)).image_since_ns for n in (1, 2, 3)]
    assert stamps == [1, 2, 3]
    assert changes.repeated["image"] == 0


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_clipped_image_with_some_texture_is_a_repetition(share: float) -> None:
    changes, shown = FrameChanges(), image(0)
    shown[round(share * len(shown)) :] = 0
    stamps = [changes.stamped(Frame(shown, n, n)).image_since_ns for n in (1, 2, 3)]
    assert stamps == [1, 1, 1]


def test_another_size_is_a_new_image() -> None:
    changes = FrameChanges()
    changes.stamped(Frame(np.zeros((48, 64, 3), np.uint8), 1, 0))
    assert changes.stamped(Frame(np.zeros((24, 32, 3), np.uint8), 2, 1)).image_since_ns == 2
