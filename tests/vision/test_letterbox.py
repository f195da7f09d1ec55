"""Fitting frames into the network's input, and boxes back."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vision.letterbox import PADDING, fit, letterbox, to_tensor


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
def test_a_frame_lies_where_networks_expect_it(
    frame: tuple[int, int], square: bool, size: tuple[int, int], corner: tuple[int, int]
) -> None:
    box = fit(*frame, 640, square=square)
    assert (box.width, box.height) == size
    assert (box.left, box.top) == corner


@given(
    width=st.integers(1, 3000),
    height=st.integers(1, 3000),
    cells=st.integers(1, 40),
    square=st.booleans(),
)
def test_the_frame_always_lies_inside_an_input_of_whole_cells(
    width: int, height: int, cells: int, square: bool
) -> None:
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
def test_a_box_comes_back_to_where_it_was(width: int, height: int, fractions: tuple[float, ...]) -> None:
    box = fit(width, height, 640)
    left, right = sorted((fractions[0] * width, fractions[1] * width))
    top, bottom = sorted((fractions[2] * height, fractions[3] * height))
    frame_box = np.array([[left, top, right, bottom]], np.float32)
    np.testing.assert_allclose(
        box.to_frame(box.to_input(frame_box)), frame_box, atol=0.01 * max(width, height) / 640 + 1e-3
    )


def test_boxes_that_leave_the_frame_are_clipped_to_it() -> None:
    box = fit(320, 240, 640)
    assert box.to_frame(np.array([[-50, -50, 900, 900]])).tolist() == [[0, 0, 320, 240]]


def test_no_boxes_stay_no_boxes() -> None:
    assert fit(320, 240, 640).to_frame(np.zeros((0, 4))).shape == (0, 4)


def test_the_padding_is_grey_and_the_picture_is_rgb() -> None:
    image = np.zeros((16, 64, 3), np.uint8)
    image[:] = (10, 20, 30)  # blue, green, red
    pixels, box = letterbox(image, 64, square=True)
    assert pixels.shape == (1, 3, 64, 64)
    assert pixels.dtype == torch.float32
    assert pixels.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(pixels[0, :, box.top, 0] * 255, torch.tensor([30.0, 20.0, 10.0]))
    torch.testing.assert_close(pixels[0, :, 0, 0] * 255, torch.full((3,), float(PADDING)))


def test_the_frame_itself_is_left_as_it_was() -> None:
    image = np.random.default_rng(0).integers(0, 256, (32, 64, 3), np.uint8)
    before = image.copy()
    letterbox(image, 64)
    np.testing.assert_array_equal(image, before)


def test_half_precision_is_filled_directly() -> None:
    assert to_tensor(np.zeros((32, 32, 3), np.uint8), torch.bfloat16).dtype == torch.bfloat16


@pytest.mark.parametrize("size", [0, 31, 100, -32])
def test_an_image_size_that_is_no_multiple_of_32_is_refused(size: int) -> None:
    with pytest.raises(ValueError, match="multiple of 32"):
        fit(640, 480, size)


def test_a_frame_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"is for \(480, 640, 3\), got \(10, 10, 3\)"):
        fit(640, 480).apply(np.zeros((10, 10, 3), np.uint8))


def test_a_frame_without_pixels_is_refused() -> None:
    with pytest.raises(ValueError, match="got 0x480"):
        fit(0, 480)
