"""Model of a stereo depth camera: disparity steps and noise, range limits, and pixels without depth.

A stereo pair of baseline b and focal length f (pixels) measures the disparity d = f · b / z and reports it in
fixed steps, so that the error of z grows with z² (Gallup et al. 2008, "Variable baseline/resolution stereo").
Depth is that of the left camera: points hidden from the right camera by a nearer object have none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from mavlink_sim.world.textures import Plane


@dataclass(frozen=True, slots=True)
class DepthSensor:
    """A depth camera. The defaults are of the size of a small active stereo camera.

    Attributes:
        baseline_m: between the cameras; 0 gives true depth, without steps, noise or occlusion.
        step_px: the disparity's resolution.
        noise_px: standard deviation of the disparity.
        minimum_m, maximum_m: range outside which there is no depth.
        dropout: share of the pixels within range that have no depth, in patches, 0..1.
    """

    baseline_m: float = 0.05
    step_px: float = 0.125
    noise_px: float = 0.08
    minimum_m: float = 0.3
    maximum_m: float = 40.0
    dropout: float = 0.01

    def __post_init__(self) -> None:
        if not 0.0 <= self.baseline_m <= 2.0:
            raise ValueError(f"a depth camera's baseline must be 0 to 2 m, got {self.baseline_m}")
        if not 0.0 <= self.step_px <= 4.0 or not 0.0 <= self.noise_px <= 10.0:
            raise ValueError(
                f"disparity's step must be 0 to 4 px and its noise 0 to 10 px, "
                f"got {self.step_px} and {self.noise_px}"
            )
        if not 0.0 <= self.minimum_m < self.maximum_m:
            raise ValueError(
                f"a depth camera's range must run upwards from 0 m or more, "
                f"got {self.minimum_m} to {self.maximum_m}"
            )
        if not 0.0 <= self.dropout < 1.0:
            raise ValueError(f"a depth camera's dropout must be 0 to below 1, got {self.dropout}")


def measured_depth(
    true_depth_m: Plane, focal_px: float, sensor: DepthSensor, rng: np.random.Generator
) -> Plane:
    """The sensor's depth (H, W), float32 metres, NaN where none.

    Args:
        true_depth_m: (H, W) float32, NaN where there is nothing.
        focal_px: horizontal focal length.
        rng: draws noise and dropouts.
    """
    depth = true_depth_m
    if sensor.baseline_m > 0.0:
        scale = np.float32(focal_px * sensor.baseline_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            disparity = np.nan_to_num(scale / true_depth_m, posinf=0.0)
        hidden = _hidden_from_the_right(disparity)
        if sensor.noise_px > 0.0:
            disparity += np.float32(sensor.noise_px) * _noise(disparity.shape, rng)
        if sensor.step_px > 0.0:
            disparity = np.rint(disparity * np.float32(1.0 / sensor.step_px)) * np.float32(sensor.step_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = scale / disparity
        depth[hidden | (disparity <= 0.0) | np.isnan(true_depth_m)] = np.nan
    else:
        depth = depth.copy()
    with np.errstate(invalid="ignore"):
        depth[(depth < sensor.minimum_m) | (depth > sensor.maximum_m)] = np.nan
    if sensor.dropout > 0.0:
        depth[_patches(depth.shape, sensor.dropout, rng)] = np.nan
    return np.asarray(depth, np.float32)


def _hidden_from_the_right(disparity: Plane) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Pixels that a nearer object to their right hides from the right camera."""
    at_right = np.arange(disparity.shape[1], dtype=np.float32) - disparity
    leftmost = np.minimum.accumulate(at_right[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(disparity.shape, np.bool_)
    # Half a pixel of tolerance: a slanted surface does not hide itself.
    hidden[:, :-1] = leftmost[:, 1:] < at_right[:, :-1] - 0.5
    return hidden


@lru_cache(maxsize=1)
def _noise_bank() -> Plane:
    """(1024, 1024) normal noise: drawing it for each frame would take longer than the frame."""
    return np.random.default_rng(98).standard_normal((1024, 1024), np.float32)


def _noise(shape: tuple[int, ...], rng: np.random.Generator) -> Plane:
    """(H, W) float32 normal noise of deviation 1: a part of the bank, repeated where it is too small."""
    bank = _noise_bank()
    top, left = (int(start) for start in rng.integers(1024, size=2))
    rows, columns = (top + np.arange(shape[0])) % 1024, (left + np.arange(shape[1])) % 1024
    return np.asarray(bank.take(rows, axis=0).take(columns, axis=1), np.float32)


def _patches(
    shape: tuple[int, ...], share: float, rng: np.random.Generator
) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """A mask that covers about `share` of the image with spots of a few pixels."""
    height, width = shape
    coarse = rng.random((-(-height // 6) + 1, -(-width // 6) + 1), np.float32)
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    limit = float(np.quantile(smooth[::3, ::3], 1.0 - share))
    return np.asarray(smooth > limit, np.bool_)
