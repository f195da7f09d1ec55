"""Fitting frames into the network's input, and boxes back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.letterbox import PADDING, fit


@pytest.mark.parametrize(
    ("frame", "square", "size", "corner"),
    [
        pytest.param((640, 480), False, (640, 480), (0, 0), id="already fits"),
        pytest.param((640, 480), True, (640, 640), (0, 80), id="square pads above and below"),
        pytest.param((640, 426), False, (640, 448), (0, 11), id="rectangle pads to the next 32"),
        pytest.param((381, 500), False, (512, 640), (12, 0), id="enlarged to the image size"),
        pytest.param((640, 427), False, (640, 448), (0, 10), id="the odd pixel goes below"),
        pytest.param((1920, 1080), False, (640, 384), (0, 12), id="reduced"),
        pytest.param((10_000, 3), False, (640, 32), (0, 15), id="a sliver keeps a row"),
    ],
)
def test_letterbox_position_follows_the_convention(
    frame: tuple[int, int], square: bool, size: tuple[int, int], corner: tuple[int, int]
) -> None:
    box = fit(*frame, 640, square=square)
    assert (box.width, box.height) == size
    assert (box.left, box.top) == corner


@given(
    width=st.integers(1, 3000), height=st.integers(1, 3000), cells=st.integers(1, 40), square=st.booleans()
)
def test_frame_is_inside_an_input_of_whole_cells(width: int, height: int, cells: int, square: bool) -> None:
    box = fit(width, height, 32 * cells, square=square)
    assert box.width % 32 == 0
    assert box.height % 32 == 0
    assert max(box.width, box.height) == 32 * cells
    assert 0 <= box.left
    assert box.left + box.resized_width <= box.width
    assert 0 <= box.top
    assert box.top + box.resized_height <= box.height
    if square:
        assert box.width == box.height
    else:
        assert box.width - box.resized_width < 32
        assert box.height - box.resized_height < 32


@given(
    width=st.integers(2, 2000),
    height=st.integers(2, 2000),
    fractions=st.tuples(*[st.floats(0, 1, width=32)] * 4),
)
def test_box_survives_the_round_trip(width: int, height: int, fractions: tuple[float, ...]) -> None:
    box = fit(width, height, 640)
    left, right = sorted((fractions[0] * width, fractions[1] * width))
    top, bottom = sorted((fractions[2] * height, fractions[3] * height))
    frame_box = np.array([[left, top, right, bottom]], np.float32)
    scale = np.array([box.resized_width / width, box.resized_height / height] * 2)
    in_input = frame_box * scale + [box.left, box.top, box.left, box.top]
    np.testing.assert_allclose(box.to_frame(in_input), frame_box, atol=0.01 * max(width, height) / 640 + 1e-3)


def test_boxes_that_leave_the_frame_are_clipped_to_it() -> None:
    box = fit(320, 240, 640)
    assert box.to_frame(np.array([[-50, -50, 900, 900]])).tolist() == [[0, 0, 320, 240]]


def test_no_boxes_stay_no_boxes() -> None:
    assert fit(320, 240, 640).to_frame(np.zeros((0, 4))).shape == (0, 4)


def test_padding_is_grey_and_colours_are_kept() -> None:
    image = np.zeros((16, 64, 3), np.uint8)
    image[:] = (10, 20, 30)  # blue, green, red
    box = fit(64, 16, 64, square=True)
    boxed = box.apply(image)
    assert boxed.shape == (64, 64, 3)
    assert boxed[box.top, 0].tolist() == [10, 20, 30]
    assert boxed[0, 0].tolist() == [PADDING] * 3
    assert (boxed == PADDING).all(axis=2).sum() == 64 * 64 - 16 * 64


@pytest.mark.parametrize("size", [(64, 16), (33, 50), (50, 33), (128, 96), (64, 64)])
def test_reused_buffer_gives_the_same_result(size: tuple[int, int]) -> None:
    box = fit(*size, 64)
    buffer = box.blank()
    random = np.random.default_rng(0)
    for _ in range(3):
        image = random.integers(0, 256, (size[1], size[0], 3), np.uint8)
        again = box.apply(image, buffer)
        np.testing.assert_array_equal(again, box.apply(image))
        assert again is buffer or again is image


def test_a_frame_that_fits_is_not_copied() -> None:
    image = np.zeros((64, 96, 3), np.uint8)
    assert fit(96, 64, 96).apply(image) is image


def test_frame_is_not_modified() -> None:
    image = np.random.default_rng(0).integers(0, 256, (32, 64, 3), np.uint8)
    before = image.copy()
    fit(64, 32, 64, square=True).apply(image)
    np.testing.assert_array_equal(image, before)


def test_a_network_of_larger_strides_is_given_multiples_of_them() -> None:
    box = fit(640, 426, 640, stride=64)
    assert (box.width, box.height) == (640, 448)
    with pytest.raises(ValueError, match="multiple of 64"):
        fit(640, 480, 96, stride=64)
