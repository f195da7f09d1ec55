"""Evaluation of a model on rendered scenes that training has not seen."""

from __future__ import annotations

import numpy as np
import torch

from vision.yolo.architecture import YoloModel
from vision.yolo.metrics import ImageResult, Score, score_detections
from vision.yolo.postprocess import select_boxes
from vision.yolo.scene_batches import SceneKey, SceneSource, collate, draw_scene, network_input


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
