"""The two training runs of the bundled weights, and their evaluation on scenes that training has not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from vision.evaluation.metrics import ImageResult, Score, score_detections
from vision.training.scene_batches import (
    Augmentation,
    SceneKey,
    SceneSource,
    collate,
    draw_scene,
    network_input,
)
from vision.training.training import Stage, TrainingSettings
from vision.yolo.architecture import YoloModel
from vision.yolo.postprocess import select_boxes

HELD_OUT_SEED = 10_000_000
"""Seed of the evaluation scenes. No training seed comes near it."""

HELD_OUT_SIZE = (640, 480)
"""Width and height of those scenes, pixels: the size of the simulated vehicle's camera."""

NMS_IOU = 0.45
"""NMS threshold of a network of these scenes, in its metadata. With 0.7 some objects get two boxes."""
DEFAULT_RECIPE = TrainingSettings(
    class_names=("person", "bicycle", "car", "truck", "boat", "dog", "chair"),
    depth_multiple=1 / 3,
    width_multiple=0.1875,
    max_channels=1024,
    # Small images have the same field of view: as many objects for a quarter of the work, at half the
    # pixels. Then the frames' full size; and, because small objects were missed, both again. Scenes
    # repeat with new augmentation.
    stages=(
        Stage(320, 256, 16, 3970, scenes=12_000),
        Stage(640, 480, 8, 3900, scenes=6_000, decay_steps=3900),
        Stage(320, 256, 16, 5474, scenes=12_000),
        Stage(320, 256, 16, 3800, scenes=8_000, decay_steps=3400),
        Stage(640, 480, 8, 1300, scenes=4_000, decay_steps=1300, rate=0.25),
        Stage(320, 256, 16, 1450, scenes=3_000, decay_steps=1450, rate=0.4),
        Stage(320, 256, 16, 4800, scenes=12_000),
        Stage(320, 256, 16, 2000, scenes=8_000, decay_steps=1900),
        Stage(640, 480, 8, 1100, scenes=4_000, decay_steps=1100, rate=0.25),
    ),
    learning_rate=3e-3,
    seed=1,
    threads=1,
    workers=1,
)
"""The first run: large objects from anywhere (`random_scene`), from random weights."""

REFINEMENT = replace(
    DEFAULT_RECIPE,
    # A scene of the camera's size is expensive to draw and gives many images: whole at half its pixels,
    # and parts of it at up to 1.3 times its pixels.
    stages=(
        Stage(320, 256, 16, 4315, scenes=6_000, decay_steps=4315, drawn=(640, 480)),
        Stage(320, 256, 16, 8147, scenes=4_000, decay_steps=8147, rate=0.75, drawn=(640, 480)),
    ),
    learning_rate=2e-3,
    warmup_steps=150,
    augmentation=Augmentation(
        zoom_probability=0.6, zoom_min=0.9, zoom_max=1.3, min_side_px=5.0, min_area_px=60.0
    ),
    seed=2,
    bfloat16=True,
)
"""The second run, from the first one's weights: views of a flight, near and far, and many distractors
(`training_scene`)."""


@torch.inference_mode()
def evaluate(
    model: YoloModel,
    scenes: SceneSource,
    seed: int,
    count: int,
    width: int,
    height: int,
    *,
    confidence: float = 0.001,
    iou: float = 0.7,
) -> Score:
    """Mean average precision over `count` scenes of `width` × `height` pixels (multiples of 32).

    Args:
        model: is put into evaluation mode.
        scenes: draws the scenes.
        seed: of the held-out set; far from every training seed.
        confidence: detections below it are ignored; low, so that the whole recall range is covered.
        iou: NMS IoU threshold.

    Raises:
        ValueError: the size is not a multiple of 32, or the source returns an invalid scene.
    """
    if width % 32 or height % 32:
        raise ValueError(f"evaluation scenes must be multiples of 32 pixels, got {width}x{height}")
    model.eval()
    results = []
    for index in range(count):
        scene = draw_scene(scenes, SceneKey(seed, index, width, height), len(model.class_names))
        images, _ = collate([scene])
        true_ids = np.asarray(scene[2], np.int64)
        found = select_boxes(model, model(network_input(images)), confidence=confidence, iou=iou)
        results.append(
            ImageResult(
                found.xyxy,
                found.confidence,
                found.class_id,
                np.asarray(scene[1], np.float32),
                np.where(true_ids < 0, ~true_ids, true_ids),
                true_ids < 0,
            )
        )
    return score_detections(results, model.class_names)
