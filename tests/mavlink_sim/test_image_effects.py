"""What a sensor does to the images of one camera."""

from __future__ import annotations

import numpy as np
import pytest

from mavlink_sim.camera.image_effects import ImageEffects, Sensor

IMAGES = {
    "black": np.zeros((48, 64, 3), np.uint8),
    "white": np.full((48, 64, 3), 255, np.uint8),
    "every grey": np.arange(48 * 64 * 3, dtype=np.uint32).astype(np.uint8).reshape(48, 64, 3),
    "wider than the stock of noise": np.full((16, 1700, 3), 128, np.uint8),
}


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("sigma", [0.7, 2.0, 9.0, 100.0])
def test_noise_is_independent_of_image_count(name: str, sigma: float) -> None:
    image, effects = IMAGES[name], ImageEffects(noise_sigma=sigma)
    one = Sensor(effects).expose(image, np.random.default_rng(5))
    camera = Sensor(effects)
    camera.expose(image, np.random.default_rng(4))
    assert np.array_equal(camera.expose(image, np.random.default_rng(5)), one)
    assert not np.array_equal(camera.expose(image, np.random.default_rng(6)), one)


def test_noise_has_given_deviation() -> None:
    grey = np.full((480, 640, 3), 128, np.uint8)
    camera = Sensor(ImageEffects(noise_sigma=5.0))
    for seed in range(3):
        noisy = camera.expose(grey, np.random.default_rng(seed)).astype(np.float64)
        assert abs(noisy.std() - 5.0) < 0.1
        assert abs(noisy.mean() - 128.0) < 0.1


def test_images_of_other_sizes_have_noise() -> None:
    camera = Sensor(ImageEffects(noise_sigma=4.0))
    for size in ((30, 40), (30, 40), (1300, 40), (30, 1700), (30, 40)):
        grey = np.full((*size, 3), 128, np.uint8)
        assert 3.5 < float(camera.expose(grey, np.random.default_rng(1)).std()) < 4.5
