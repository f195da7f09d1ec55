"""Batches of scenes, drawn on the fly and augmented; independent of the number of workers."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from vision.training.losses import Truth

PADDING_GREY = 114
"""Padding value of the letterbox, so that training includes such borders."""

LabelledImage = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.int64]]
"""Image (height, width, 3) uint8 BGR; boxes (N, 4) float32 pixels xyxy; class ids (N,) int64.

An id ~class (negative) marks an object that is neither to be detected nor background."""

SceneSource = Callable[[np.random.Generator, int, int], LabelledImage]
"""`(rng, width, height) → (image (height, width, 3) uint8 BGR, boxes (N, 4) pixels xyxy, class ids (N,))`.

A class id ~class marks an object that is not to be learned (`LabelledImage`). All randomness must come from
`rng`. With workers it must be picklable: a module-level function, or a `functools.partial` of one.
"""
KEPT_BYTES = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 4
"""Cache of repeated scenes per drawing process, a quarter of the memory; others are drawn again."""


@dataclass(frozen=True, slots=True)
class Augmentation:
    """Limits of the changes. Fractions are of the original value.

    Attributes:
        mirror: probability of a left–right mirror.
        zoom_probability: probability of a zoom with a shift.
        zoom_min: smallest zoom; below 1 the image gets grey borders.
        zoom_max: largest zoom.
        hue: largest shift of the hue, as a fraction of the colour circle.
        saturation: largest relative change of the saturation.
        brightness: largest relative change of the brightness.
        visible_fraction: an object with less than this share inside the image is no longer labelled.
        min_side_px: nor is one whose box has a smaller side than this.
        min_area_px: nor one whose box has a smaller area.
    """

    mirror: float = 0.5
    zoom_probability: float = 0.5
    zoom_min: float = 0.75
    zoom_max: float = 1.4
    hue: float = 0.015
    saturation: float = 0.4
    brightness: float = 0.25
    visible_fraction: float = 0.35
    min_side_px: float = 0.0
    min_area_px: float = 0.0


NO_AUGMENTATION = Augmentation(mirror=0, zoom_probability=0, hue=0, saturation=0, brightness=0)


def augment(
    rng: np.random.Generator, scene: LabelledImage, limits: Augmentation, size: tuple[int, int] | None = None
) -> LabelledImage:
    """An augmented copy. The same `rng` state gives the same change.

    `size` (width, height) of the copy; None: the scene's. A smaller copy shows the whole scene, letterboxed,
    or a part of it, zoomed up to `zoom_max` times the scene's pixels.
    """
    image, boxes, class_ids = scene
    if rng.random() < limits.mirror:
        image, boxes = mirrored(image, boxes)
    own = (image.shape[1], image.shape[0])
    zoomed = rng.random() < limits.zoom_probability
    if zoomed or size not in (None, own):
        image, boxes, class_ids = _zoomed(rng, image, boxes, class_ids, limits, size or own, zoomed)
    if limits.hue or limits.saturation or limits.brightness:
        image = _recoloured(rng, image, limits)
    return np.ascontiguousarray(image), boxes, class_ids


def mirrored(
    image: NDArray[np.uint8], boxes: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Mirror left and right. Box edges are continuous coordinates: 0 is the left edge, width the right."""
    width = image.shape[1]
    mirrored_boxes = boxes.copy()
    mirrored_boxes[:, 0], mirrored_boxes[:, 2] = width - boxes[:, 2], width - boxes[:, 0]
    return image[:, ::-1], mirrored_boxes


def _zoomed(
    rng: np.random.Generator,
    image: NDArray[np.uint8],
    boxes: NDArray[np.float32],
    class_ids: NDArray[np.int64],
    limits: Augmentation,
    size: tuple[int, int],
    zoomed: bool,
) -> LabelledImage:
    whole, window = np.array([image.shape[1], image.shape[0]]), np.array(size)
    zoom = float((window / whole).min())
    shift = (window - zoom * whole) / 2
    if zoomed:
        zoom = float(np.exp(rng.uniform(np.log(zoom * limits.zoom_min), np.log(limits.zoom_max))))
        # Zoomed in, the window is anywhere in the image; zoomed out, the image anywhere in the window.
        shift = rng.random(2) * (window - zoom * whole)
        if len(boxes) and (window < whole).any() and rng.random() < 0.7:
            # Most of a large scene is empty: prefer a window with an object.
            centre = boxes[int(rng.integers(len(boxes)))].reshape(2, 2).mean(axis=0) * zoom
            margin = window - zoom * whole
            shift = np.clip(
                rng.uniform(0.1, 0.9, 2) * window - centre, np.minimum(margin, 0), np.maximum(margin, 0)
            )
    # warpAffine counts from pixel centres, boxes from pixel edges: half a pixel each.
    centre_shift = shift + 0.5 * zoom - 0.5
    matrix = np.array([[zoom, 0, centre_shift[0]], [0, zoom, centre_shift[1]]])
    warped = cv2.warpAffine(
        np.ascontiguousarray(image),
        matrix,
        size,
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(PADDING_GREY, PADDING_GREY, PADDING_GREY),
    )
    moved = boxes * zoom + np.tile(shift, 2)
    clipped = np.clip(moved, 0, np.tile(window, 2)).astype(np.float32)
    area = (moved[:, 2:] - moved[:, :2]).prod(1)
    sides = clipped[:, 2:] - clipped[:, :2]
    visible_area = sides.prod(1)
    cut = visible_area < limits.visible_fraction * np.maximum(area, 1e-9)
    small = (sides.min(1, initial=np.inf) < limits.min_side_px) | (visible_area < limits.min_area_px)
    ids = np.where((cut | small) & (class_ids >= 0), ~class_ids, class_ids)
    shown = visible_area > 0
    return warped.astype(np.uint8, copy=False), clipped[shown], ids[shown]


def _recoloured(
    rng: np.random.Generator, image: NDArray[np.uint8], limits: Augmentation
) -> NDArray[np.uint8]:
    hue, saturation, brightness = rng.uniform(-1, 1, 3) * (limits.hue, limits.saturation, limits.brightness)
    levels = np.arange(256)
    # OpenCV's 8-bit hue is half degrees, 0..179.
    hue_table = ((levels + hue * 180) % 180).astype(np.uint8)
    saturation_table = np.clip(levels * (1 + saturation), 0, 255).astype(np.uint8)
    brightness_table = np.clip(levels * (1 + brightness), 0, 255).astype(np.uint8)
    table = np.stack([hue_table, saturation_table, brightness_table], -1)[None]
    coloured = cv2.LUT(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_BGR2HSV), table)
    return cv2.cvtColor(coloured, cv2.COLOR_HSV2BGR).astype(np.uint8, copy=False)


@dataclass(frozen=True, slots=True)
class SceneKey:
    """Identifies one training image: scene number `scene` of `seed`, with augmentation number `view`.

    The scene is drawn `width` by `height` pixels; `size` is the image's (width, height), None: the same.
    Its random numbers depend only on these values, not on the process that draws it or on what it drew
    before.
    """

    seed: int
    scene: int
    width: int
    height: int
    view: int = 0
    size: tuple[int, int] | None = None


def draw_scene(scenes: SceneSource, key: SceneKey, class_count: int) -> LabelledImage:
    """Draw and check a key's scene, without augmentation.

    Raises:
        ValueError: the source returned an image of another size or type, or inconsistent labels.
    """
    rng = np.random.default_rng([key.seed, key.scene])
    image, boxes, class_ids = scenes(rng, key.width, key.height)
    if image.shape != (key.height, key.width, 3) or image.dtype != np.uint8:
        raise ValueError(
            f"a scene must be ({key.height}, {key.width}, 3) uint8, "
            f"the source returned {image.shape} {image.dtype}"
        )
    boxes = np.asarray(boxes, np.float32).reshape(-1, 4)
    class_ids = np.asarray(class_ids, np.int64).reshape(-1)
    if len(boxes) != len(class_ids):
        raise ValueError(f"a scene has {len(boxes)} boxes but {len(class_ids)} class ids")
    if len(class_ids) and not (-class_count <= class_ids.min() and class_ids.max() < class_count):
        raise ValueError(
            f"class ids must be 0..{class_count - 1}, the source returned {np.unique(class_ids)}"
        )
    return image, boxes, class_ids


def collate(scenes: Sequence[LabelledImage]) -> tuple[Tensor, Truth]:
    """Images → (B, H, W, 3) uint8 RGB, boxes and classes padded to the largest number of objects."""
    images = torch.from_numpy(np.stack([image[:, :, ::-1] for image, _, _ in scenes]))
    most = max(len(class_ids) for _, _, class_ids in scenes)
    boxes = torch.zeros(len(scenes), most, 4)
    classes = torch.zeros(len(scenes), most, dtype=torch.int64)
    present = torch.zeros(len(scenes), most, dtype=torch.bool)
    ignored = torch.zeros(len(scenes), most, dtype=torch.bool)
    for row, (_, scene_boxes, class_ids) in enumerate(scenes):
        count = len(class_ids)
        boxes[row, :count] = torch.from_numpy(scene_boxes)
        classes[row, :count] = torch.from_numpy(np.where(class_ids < 0, ~class_ids, class_ids))
        present[row, :count] = torch.from_numpy(class_ids >= 0)
        ignored[row, :count] = torch.from_numpy(class_ids < 0)
    return images, Truth(boxes, classes, present, ignored)


def network_input(images: Tensor) -> Tensor:
    """(B, H, W, 3) uint8 RGB → (B, 3, H, W) float32 in 0..1, channels last in memory."""
    return images.permute(0, 3, 1, 2).float().div_(255.0)


class _Scenes(Dataset[LabelledImage]):
    """Map-style data set whose index is a `SceneKey`."""

    def __init__(
        self, scenes: SceneSource, class_count: int, augmentation: Augmentation, repeated: frozenset[SceneKey]
    ) -> None:
        self.scenes, self.class_count, self.augmentation = scenes, class_count, augmentation
        self.repeated = repeated
        self.drawn: dict[SceneKey, LabelledImage] = {}
        self.margin = KEPT_BYTES

    def __getitem__(self, key: SceneKey) -> LabelledImage:
        scene_key = replace(key, view=0)
        scene = self.drawn.get(scene_key)
        if scene is None:
            scene = draw_scene(self.scenes, scene_key, self.class_count)
            # No eviction: scenes repeat in order, so the oldest is the one needed next.
            if scene_key in self.repeated and scene[0].nbytes <= self.margin:
                self.drawn[scene_key] = scene
                self.margin -= scene[0].nbytes
        rng = np.random.default_rng([key.seed, key.scene, key.view])
        return augment(rng, scene, self.augmentation, key.size)


def _repeated(plan: Sequence[Sequence[SceneKey]]) -> frozenset[SceneKey]:
    """The scenes that are needed more than once."""
    times = Counter(replace(key, view=0) for keys in plan for key in keys)
    return frozenset(scene for scene, count in times.items() if count > 1)


def _single_threaded(_worker: int) -> None:
    cv2.setNumThreads(1)


def scene_batches(
    scenes: SceneSource,
    plan: Sequence[Sequence[SceneKey]],
    *,
    class_count: int,
    augmentation: Augmentation,
    workers: int,
) -> Iterator[tuple[Tensor, Truth]]:
    """The batches of a plan, in its order: (B, H, W, 3) uint8 RGB and their truth.

    Args:
        scenes: draws the images.
        plan: the keys of each batch; all of one size within a batch.
        class_count: number of classes.
        augmentation: applied after drawing, from the same random numbers.
        workers: processes that draw ahead; 0 draws in this one.
    """
    if not plan:
        return
    loader = DataLoader(
        _Scenes(scenes, class_count, augmentation, _repeated(plan)),
        batch_sampler=[list(keys) for keys in plan],
        num_workers=workers,
        collate_fn=collate,
        worker_init_fn=_single_threaded,
        # A process forked while native threads are busy may inherit a locked mutex.
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=4 if workers else None,
    )
    yield from loader
