"""The default world and the training scenes are unchanged: models are trained on these images.

The record has mean brightnesses of squares of 32 pixels, so that rounding on another processor passes, while
one moved or recoloured object does not. This file run as a program writes a new record, which invalidates the
measured scores of trained models.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mavlink_sim.camera.image_effects import MILD_EFFECTS
from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.datasets.training_scenes import random_scene
from mavlink_sim.world.world import demo_world
from vision.rotation import matrix_from_euler

RECORD = Path(__file__).with_name("golden_images.json")
POSES = (((0.0, 0.0, -5.0), (0.0, 0.0, 1.0)), ((-8.0, 4.0, -12.0), (0.1, -0.3, 1.5)))
RANDOM_SEEDS = range(8)
TOLERANCE = 0.05
"""Grey levels: one pixel of a square (1024 in all channels) changed by 150 shows."""


def _squares(image: NDArray[np.uint8]) -> list[float]:
    height, width = image.shape[0] // 32, image.shape[1] // 32
    cut = image[: height * 32, : width * 32].reshape(height, 32, width, 32, 3)
    means: list[float] = np.round(cut.mean(axis=(1, 3, 4)), 3).ravel().tolist()
    return means


def _demo(number: int) -> dict[str, list[float]]:
    position, angles = POSES[number]
    renderer = Renderer(demo_world(1), effects=MILD_EFFECTS)
    frame = renderer.render(position, matrix_from_euler(*angles))
    depth = np.nan_to_num(1.0 / frame.depth_m)
    return {
        "image": _squares(frame.image),
        "inverse_depth": np.round(depth[::32, ::32], 5).ravel().tolist(),
        "boxes": [edge for item in frame.objects for edge in item.xyxy],
    }


def _random(seed: int) -> dict[str, list[float]]:
    image, boxes, ids = random_scene(np.random.default_rng((7, seed)), 256, 256)
    return {"image": _squares(image), "boxes": boxes.ravel().tolist(), "ids": ids.tolist()}


def _record() -> dict[str, dict[str, list[float]]]:
    demo = {f"demo {number}": _demo(number) for number in range(len(POSES))}
    return {**demo, **{f"random {seed}": _random(seed) for seed in RANDOM_SEEDS}}


def _compare(now: dict[str, list[float]], then: dict[str, list[float]]) -> None:
    assert len(now["image"]) == len(then["image"])
    assert np.abs(np.subtract(now["image"], then["image"])).max() < TOLERANCE
    assert now.get("ids") == then.get("ids")
    assert len(now["boxes"]) == len(then["boxes"])
    assert np.allclose(now["boxes"], then["boxes"], atol=1.01)
    assert np.allclose(now.get("inverse_depth", ()), then.get("inverse_depth", ()), atol=1e-4)


@pytest.mark.parametrize("number", range(len(POSES)))
def test_the_default_world_is_drawn_as_recorded(number: int) -> None:
    _compare(_demo(number), json.loads(RECORD.read_text("utf-8"))[f"demo {number}"])


@pytest.mark.parametrize("seed", RANDOM_SEEDS)
def test_a_training_scene_is_drawn_as_recorded(seed: int) -> None:
    _compare(_random(seed), json.loads(RECORD.read_text("utf-8"))[f"random {seed}"])


if __name__ == "__main__":
    RECORD.write_text(json.dumps(_record()) + "\n", encoding="utf-8")
