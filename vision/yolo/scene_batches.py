"""Batches of scenes drawn on the fly; independent of the number of workers."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from vision.yolo.augmentation import Augmentation, LabelledImage, augment
from vision.yolo.losses import Truth

SceneSource = Callable[[np.random.Generator, int, int], LabelledImage]
"""`(rng, width, height) → (image (height, width, 3) uint8 BGR, boxes (N, 4) pixels xyxy, class ids (N,))`.

A class id ~class marks an object that is not to be learned (`LabelledImage`). All randomness must come from
`rng`. With workers it must be picklable: a module-level function, or a `functools.partial` of one.
"""

KEPT_BYTES = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 4
"""Cache of repeated scenes per drawing process, a quarter of the memory; others are drawn again."""


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
        self,
        scenes: SceneSource,
        class_count: int,
        augmentation: Augmentation,
        repeated: frozenset[SceneKey],
    ) -> None:
        self.scenes, self.class_count, self.augmentation = scenes, class_count, augmentation
        self.repeated = repeated
        self.drawn: dict[SceneKey, LabelledImage] = {}
        self.room = KEPT_BYTES

    def __getitem__(self, key: SceneKey) -> LabelledImage:
        scene_key = replace(key, view=0)
        scene = self.drawn.get(scene_key)
        if scene is None:
            scene = draw_scene(self.scenes, scene_key, self.class_count)
            # No eviction: scenes repeat in order, so the oldest is the one needed next.
            if scene_key in self.repeated and scene[0].nbytes <= self.room:
                self.drawn[scene_key] = scene
                self.room -= scene[0].nbytes
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
