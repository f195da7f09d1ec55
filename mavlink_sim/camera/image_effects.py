"""Effects of lens and sensor on an image: blur, exposure, colour cast, contrast, noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mavlink_sim.world.textures import Image


@dataclass(frozen=True, slots=True)
class ImageEffects:
    """Effects in the order in which they are applied.

    Attributes:
        blur_sigma_px: of a Gaussian, 0 for none.
        motion_px, motion_rad: length and direction of a straight smear.
        exposure: multiplies brightness.
        white_balance: multiplies blue, green, red.
        contrast: 1 leaves it; pivots on mid grey.
        gamma: 1 leaves it; above 1 darkens the middle.
        grey: 0 colour … 1 monochrome.
        noise_sigma: standard deviation of the sensor's noise in grey levels.
    """

    blur_sigma_px: float = 0.0
    motion_px: float = 0.0
    motion_rad: float = 0.0
    exposure: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    contrast: float = 1.0
    gamma: float = 1.0
    grey: float = 0.0
    noise_sigma: float = 0.0


MILD_EFFECTS = ImageEffects(noise_sigma=2.0)
"""A camera without effects."""


@lru_cache(maxsize=1)
def _noise_bank() -> NDArray[np.int16]:
    """(1200, 1600, 3) noise of standard deviation 64, partly common to the channels."""
    rng = np.random.default_rng(99)
    common = rng.standard_normal((1200, 1600, 1), dtype=np.float32)
    own = rng.standard_normal((1200, 1600, 3), dtype=np.float32)
    return np.asarray(np.rint(64.0 * (0.8 * common + 0.6 * own)), np.int16)


def _scaled(noise: NDArray[np.int16], sigma: float) -> NDArray[np.int16]:
    return np.asarray(cv2.addWeighted(noise, sigma / 64.0, noise, 0.0, 0.0), np.int16)


class Sensor:
    """Applies the effects to the images of one camera."""

    def __init__(self, effects: ImageEffects) -> None:
        self._effects = effects
        self._has_exposed = False
        self._halves: tuple[Image, Image] | None = None

    def expose(self, image: Image, rng: np.random.Generator) -> Image:
        """A new image (H, W, 3) uint8 with the effects; `rng` draws the noise."""
        effects = self._effects
        if effects.blur_sigma_px > 0.05:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), effects.blur_sigma_px), np.uint8)
        if effects.motion_px > 1.0:
            smear = _smear(effects.motion_px, effects.motion_rad)
            image = np.asarray(cv2.filter2D(image, -1, smear), np.uint8)
        if effects.grey > 0.0:
            grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
            image = np.asarray(cv2.addWeighted(image, 1.0 - effects.grey, grey, effects.grey, 0.0), np.uint8)
        gains = effects.exposure * np.array(effects.white_balance)
        if effects.contrast != 1.0 or effects.gamma != 1.0 or bool(np.any(gains != 1.0)):
            level = (np.arange(256, dtype=np.float64)[:, None] / 255.0 * gains).clip(0.0, 1.0)
            level = (level**effects.gamma - 0.5) * effects.contrast + 0.5
            table = np.clip(np.rint(level * 255.0), 0, 255).astype(np.uint8)
            image = np.asarray(cv2.LUT(image, table[None]), np.uint8)
        return self._with_noise(image, rng) if effects.noise_sigma > 0.0 else image

    def _with_noise(self, image: Image, rng: np.random.Generator) -> Image:
        height, width = image.shape[:2]
        bank = _noise_bank()
        repeats = (-(-height // bank.shape[0]), -(-width // bank.shape[1]), 1)
        top = int(rng.integers(repeats[0] * bank.shape[0] - height + 1))
        left = int(rng.integers(repeats[1] * bank.shape[1] - width + 1))
        piece = (slice(top, top + height), slice(left, left + width))
        if (
            not self._has_exposed
        ):  # many cameras of training scenes capture one image: precomputed halves would not pay
            self._has_exposed = True
            bank = np.tile(bank, repeats) if repeats != (1, 1, 1) else bank
            noise = _scaled(bank[piece], self._effects.noise_sigma)
            return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), np.uint8)
        if self._halves is None or self._halves[0].shape[0] < height or self._halves[0].shape[1] < width:
            self._halves = _halves(np.tile(_scaled(bank, self._effects.noise_sigma), repeats))
        more, less = self._halves
        return np.asarray(cv2.subtract(cv2.add(image, more[piece]), less[piece]), np.uint8)


def _halves(noise: NDArray[np.int16]) -> tuple[Image, Image]:
    """The positive and the negative part of noise, in eight bits, which saturate as an image does.

    Adding them takes a third of the time of signed noise.
    """
    more, less = (np.clip(half, 0, 255).astype(np.uint8) for half in (noise, -noise))
    return more, less


def _smear(length_px: float, direction_rad: float) -> NDArray[np.float32]:
    side = math.ceil(length_px) | 1
    kernel = np.zeros((side, side), np.float32)
    middle, half = side // 2, length_px / 2
    reach = np.array([math.cos(direction_rad), math.sin(direction_rad)]) * half
    start, end = np.rint(middle - reach).astype(int), np.rint(middle + reach).astype(int)
    cv2.line(kernel, start.tolist(), end.tolist(), 1.0)
    smear: NDArray[np.float32] = kernel / kernel.sum()
    return smear
