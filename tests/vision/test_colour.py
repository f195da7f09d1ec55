"""The colour of a box by its pixels."""

from __future__ import annotations

import numpy as np
import pytest

from vision.colour import COLOURS, colour_of

# BGR.
SAMPLES = {
    "black": (20, 18, 22),
    "white": (235, 240, 238),
    "grey": (120, 122, 125),
    "red": (30, 25, 200),
    "orange": (20, 130, 240),
    "yellow": (30, 220, 235),
    "green": (50, 160, 40),
    "blue": (200, 80, 30),
    "purple": (170, 40, 120),
    "pink": (190, 90, 240),
    "brown": (25, 60, 110),
}


@pytest.mark.parametrize("name", COLOURS)
def test_colour_of_a_box_with_background_and_noise(name: str) -> None:
    rng = np.random.default_rng(3)
    image = np.full((80, 120, 3), (70, 130, 90), np.int16)
    image[20:60, 30:90] = SAMPLES[name]
    image[30:36, 40:80] = (40, 35, 30)  # windows
    noisy = np.clip(image + rng.normal(0, 6, image.shape), 0, 255).astype(np.uint8)
    assert colour_of(noisy, (28.0, 18.0, 92.0, 62.0)) == name


def test_tiny_or_outside_box_has_no_colour() -> None:
    image = np.zeros((40, 40, 3), np.uint8)
    assert colour_of(image, (10.0, 10.0, 13.0, 13.0)) is None
    assert colour_of(image, (60.0, 60.0, 90.0, 90.0)) is None
