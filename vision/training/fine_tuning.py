"""Fine-tuning on labelled images: more classes for a trained network, and training images from files."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from vision.class_names import fold_name
from vision.detections import Detections
from vision.evaluation.datasets import Dataset, read_image
from vision.letterbox import fit_into
from vision.tracking.association import overlaps
from vision.training.losses import BINS
from vision.training.published import model_family_of
from vision.training.scene_batches import KEPT_BYTES, NO_AUGMENTATION, LabelledImage, augment
from vision.yolo.architecture import YoloModel, build

SURE_SCORE, DOUBTED_SCORE = 0.4, 0.1
"""Boxes that the starting model finds of a class without labels: an object from the first score, neither
object nor background from the second."""
SAME_OBJECT_IOU = 0.5
MOSAIC_SHARE = 0.5
"""Share of the images that are composed of four."""
NEW_SHARE = 0.5
"""Share of the images and tiles that show a new class, if any does: the others are known already."""
_TILE = replace(NO_AUGMENTATION, zoom_probability=1.0, min_side_px=4.0)


@dataclass(frozen=True, slots=True, eq=False)
class TrainingImage:
    """An image file and its objects: boxes (N, 4) float32, pixels xyxy of the file's image; class ids (N,)
    int64 of the network, ~class for an object that is not to be learned."""

    path: Path
    boxes: NDArray[np.float32]
    class_ids: NDArray[np.int64]


def extend_classes(model: YoloModel, names: Sequence[str], *, seed: int = 0) -> YoloModel:
    """A copy of a network that also knows the classes `names`; those that it knows are not added.

    Names are compared by `fold_name`. All weights are kept. A new class has random weights, of `seed`, in
    the last convolution of the class branches, and the prior probability of an untrained network.

    Raises:
        ValueError: the network has an end-to-end head, or one without distributions of the sides.
    """
    if model.end_to_end or model.reg_max != BINS:
        raise ValueError(
            f"a {model_family_of(model)} network with the head {model.description.rows[-1].layer} cannot be "
            "trained, its head has another loss; expected YOLOv8 or YOLO11 with Detect"
        )
    folded = {fold_name(name): name for name in names}
    known = {fold_name(name) for name in model.class_names}
    added = tuple(name for key, name in folded.items() if key not in known)
    rows = model.description.head
    last_convolution = model.detect.cv3[0][-1]  # type: ignore[index]
    description = replace(
        model.description,
        class_names=model.class_names + added,
        # By default it depends on the number of classes, as may the argument of the last row.
        class_width=last_convolution.in_channels,
        head=(*rows[:-1], replace(rows[-1], arguments=("nc",))),
    )
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(seed)
        extended = build(description)
    weights = extended.state_dict()
    for name, old in model.state_dict().items():
        # The last convolutions' new rows are behind the old ones. (A counter of batches has no rows.)
        (weights[name][: len(old)] if old.ndim else weights[name]).copy_(old)
    return extended


def training_images(
    dataset: Dataset, model_names: Sequence[str], detect: Callable[[NDArray[np.uint8]], Detections]
) -> Iterator[TrainingImage]:
    """Read the images of a data set one after the other, and number their objects as the network does.

    Args:
        dataset: its class names are among `model_names`.
        model_names: the extended network's classes.
        detect: the starting model. It finds the objects of those of its classes that have no label in the
            whole set; without them, these objects would be learned as background.

    Raises:
        DatasetError: an image cannot be read.
    """
    index_of = {fold_name(name): index for index, name in reversed(list(enumerate(model_names)))}
    numbers = np.array([index_of[fold_name(name)] for name in dataset.class_names or model_names], np.int64)
    labelled = {int(numbers[class_id]) for sample in dataset.samples for class_id in sample.class_ids}
    for sample in dataset.samples:
        image = read_image(sample.image)
        boxes, ids = sample.boxes_in(image.shape[1], image.shape[0]), numbers[sample.class_ids]
        ids = np.where(sample.ignored, ~ids, ids)
        if len(labelled) < len(model_names):
            boxes, ids = _with_found(boxes, ids, detect(image), labelled)
        yield TrainingImage(sample.image, boxes, ids)


def _with_found(
    boxes: NDArray[np.float32], ids: NDArray[np.int64], found: Detections, labelled: Collection[int]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Add what the starting model found of classes without labels, where there is no labelled object."""
    new = ~np.isin(found.class_id, list(labelled)) & (found.confidence >= DOUBTED_SCORE)
    new &= overlaps(found.xyxy, boxes).max(axis=1, initial=0.0) < SAME_OBJECT_IOU
    found_ids = np.where(found.confidence >= SURE_SCORE, found.class_id, ~found.class_id)
    return np.concatenate([boxes, found.xyxy[new]]), np.concatenate([ids, found_ids[new]])


class LabelledScenes:
    """A `SceneSource` of labelled images: one letterboxed, or a mosaic of parts of four.

    Args:
        known: number of classes that the starting model knows; the ids from there on are new.
    """

    def __init__(self, images: Sequence[TrainingImage], known: int) -> None:
        self._images = tuple(images)
        self._with_new = [i for i, item in enumerate(self._images) if (item.class_ids >= known).any()]
        self._read: dict[tuple[int, int, int], LabelledImage] = {}
        self._margin = KEPT_BYTES

    def __call__(self, rng: np.random.Generator, width: int, height: int) -> LabelledImage:
        if rng.random() >= MOSAIC_SHARE:
            return augment(rng, self._random(rng, width, height), NO_AUGMENTATION, (width, height))
        canvas = np.empty((height, width, 3), np.uint8)
        column, row = (rng.uniform(0.3, 0.7, 2) * (width, height)).astype(int).tolist()
        boxes, ids = [], []
        for left, right in ((0, column), (column, width)):
            for top, bottom in ((0, row), (row, height)):
                scene = self._random(rng, width, height)
                tile, tile_boxes, tile_ids = augment(rng, scene, _TILE, (right - left, bottom - top))
                canvas[top:bottom, left:right] = tile
                boxes.append(tile_boxes + np.array([left, top, left, top], np.float32))
                ids.append(tile_ids)
        return canvas, np.concatenate(boxes), np.concatenate(ids)

    def _random(self, rng: np.random.Generator, width: int, height: int) -> LabelledImage:
        """One of the images, enlarged or reduced to fit into the size, without padding."""
        index = int(rng.integers(len(self._images)))
        if self._with_new and rng.random() < NEW_SHARE:
            index = self._with_new[int(rng.integers(len(self._with_new)))]
        scene = self._read.get((index, width, height))
        if scene is None:
            scene = _scaled(self._images[index], width, height)
            if scene[0].nbytes <= self._margin:
                self._read[index, width, height] = scene
                self._margin -= scene[0].nbytes
        return scene


def _scaled(item: TrainingImage, width: int, height: int) -> LabelledImage:
    image = read_image(item.path)
    box = fit_into(image.shape[1], image.shape[0], width, height)
    size = (box.resized_width, box.resized_height)
    scale = np.array(size * 2) / np.array([image.shape[1], image.shape[0]] * 2)
    boxes = (item.boxes * scale).astype(np.float32)
    return cv2.resize(image, size).astype(np.uint8, copy=False), boxes, item.class_ids
